# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp export`` and ``import``: a calibration to and from another tool's file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ..errors import CalibrationError
from ..unit.gravity import STANDARD_GRAVITY
from . import options
from .output import Output

# Bytes; all parameters of a vehicle are some 60 kB.
_LIMIT = 4 << 20


Tool = Literal['px4', 'ardupilot', 'imu_tk', 'imu_calib', 'kalibr']


def export(
    path: Annotated[Path, typer.Argument(help='Calibration of the unit.', metavar='YAML')],
    to: Annotated[Tool, typer.Option('--to', help='Whose file to write.')],
    output: Annotated[Path, typer.Option('--output', '-o', help='File to write.')],
    number: Annotated[
        int | None,
        typer.Option(
            help='Which set: TC_A0.. of PX4 (default 0), INS_TCAL1.. of ArduPilot (1), imu0.. of '
            'Kalibr (0).',
            min=0,
        ),
    ] = None,
    device_id: Annotated[
        int, typer.Option(help="PX4's id of the sensor (TC_An_ID), which it matches by.")
    ] = 0,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help='Direction of +g in the sensor frame, at which the drift of the scale is folded '
            'into the offset.',
            metavar='X Y Z',
        ),
    ] = None,
    force: options.Force = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Write a calibration as a file of another tool.

    PX4 and ArduPilot keep a cubic of temperature per axis' offset; imu_tk
    (.calib), imu_calib and Kalibr (YAML) keep bias, scale and misalignment at
    one temperature, the reference. What the calibration holds beyond that is
    lost, and said with what it costs.

    Example:
      thermo_comp export unit42.yaml --to px4 -o unit42.params
      thermo_comp export unit42.yaml --to ardupilot --up 0 0 1 -o unit42.parm
      thermo_comp export unit42.yaml --to imu_tk -o unit42.calib
    """
    from ..convert.exchange import export_calibration
    from ..files import PARAMETERS, check_output, write_atomically
    from ..unit.calibration_file import load_calibration

    out = Output(as_json, quiet)
    if device_id and to != 'px4':
        raise options.usage('--device-id is for PX4')
    if up is not None and to not in ('px4', 'ardupilot'):
        raise options.usage('--up is for PX4 and ArduPilot')
    check_output(output, PARAMETERS, overwrite=force, others=[path])
    calibration = load_calibration(path)
    with options.usage_of():
        result = export_calibration(calibration, to, number=number, device_id=device_id, up=up)
    write_atomically(output, result.text.encode(), PARAMETERS, overwrite=force)
    out.line(f'{output}: parameters of {to} for unit {calibration.unit.serial}')
    for note in result.notes:
        out.line(f'- {note}')
    out.json(
        {'output': output, 'to': to, 'serial': calibration.unit.serial, 'notes': result.notes}
    )


def import_(
    path: Annotated[
        Path,
        typer.Argument(
            help='Parameters of PX4 or ArduPilot, .calib of imu_tk, YAML of imu_calib or Kalibr.',
            metavar='FILE',
        ),
    ],
    output: Annotated[Path, typer.Option('--output', '-o', help='Calibration to write (YAML).')],
    serial: Annotated[
        str, typer.Option(help='Serial to give the unit.', callback=options.check_serial)
    ],
    number: Annotated[
        int | None,
        typer.Option(help='Which set, where there are several (TC_A0, INS_TCAL1, imu0).'),
    ] = None,
    gravity: Annotated[float, typer.Option(help='Local gravity in m/s^2.')] = STANDARD_GRAVITY,
    rate_hz: Annotated[float, typer.Option(help='Samples per second of the unit.', min=0.1)] = 200,
    full_scale_g: Annotated[float, typer.Option(help='Full scale in g.', min=0.1)] = 16.0,
    noise_ug: Annotated[
        float, typer.Option(help='Noise density in ug/sqrt(Hz); it sets the covariance.', min=0.01)
    ] = 200.0,
    force: options.Force = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Make a calibration of a file of another tool.

    Thermal parameters of PX4 and ArduPilot give the bias over temperature;
    the files of imu_tk, imu_calib and Kalibr give bias, scale and
    misalignment. One set stands for both regimes. It is for the readings that
    the file is for: m/s^2 (node: input:=imu), or counts. Fit bags of a
    thermal test to get the rest.

    Example:
      thermo_comp import autopilot.params --serial 42 -o unit42.yaml
      thermo_comp import xsens_acc.calib --serial 42 -o unit42.yaml
    """
    from ..convert.exchange import import_calibration
    from ..files import CALIBRATION, check_output, read_bounded
    from ..unit.calibration_file import save_calibration
    from ..unit.gravity import MICRO_G

    out = Output(as_json, quiet)
    check_output(output, CALIBRATION, overwrite=force, others=[path])
    try:
        calibration = import_calibration(
            read_bounded(path, _LIMIT).decode('utf-8', errors='replace'),
            serial=serial,
            number=number,
            gravity=gravity,
            cycle_time_s=1.0 / rate_hz,
            full_scale=full_scale_g * 1e6 * MICRO_G,
            noise_density=noise_ug * MICRO_G,
        )
    except (CalibrationError, ValueError) as failure:
        raise CalibrationError(str(failure), path=path) from failure
    save_calibration(calibration, output, overwrite=force)
    lower, upper = calibration.static.temperature_range_c
    source = calibration.provenance.model
    out.line(f'{output}: unit {serial}, {source}, {lower:g} .. {upper:g} degC')
    for note in calibration.provenance.notes:
        out.line(f'- {note}')
    out.json({'output': output, 'calibration': calibration})
