# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the commands ``convert`` (logs to bags), ``export`` and ``import`` (calibrations)."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..errors import CalibrationError
from ..files import CALIBRATION, PARAMETERS, bag_kind, check_output, read_bounded, write_atomically
from ..topics import SAMPLES, thermometer
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from . import shared_options as options
from .output import Output, picked
from .shared_options import argument, option

if TYPE_CHECKING:
    from ..convert.log import ConversionReport, ForeignLog

Tool = Literal['px4', 'ardupilot', 'imu_tk', 'imu_calib', 'kalibr']

#: Texts of the findings of a conversion, printed in front of the number of rows concerned.
_FINDINGS = {
    'short_rows': 'rows left out, with fewer cells than the column map needs',
    'non_numeric': 'rows left out, with a time or a sample that is not a finite number',
    'out_of_range': 'rows left out, with a stamp before 1970 or after 2038',
    'clipped': 'rows with an axis at or beyond the limits `clip` of the column map, kept',
    'impossible': 'temperatures left out, below -90 or above 200 degC',
    'continued': 'rows at which a 32-bit time overflowed to 0, kept with increasing times',
    'backwards': 'rows with an earlier time than the row before, kept',
    'repeated': 'rows with the same time as the row before, kept',
}
# Largest accepted parameter file [bytes]; a file of all parameters of a vehicle has about 60 kB.
_LIMIT = 4 << 20


def convert(
    log: Path = argument(
        'Table (.csv, .tsv, .txt, .parquet), PX4 (.ulg) or ArduPilot log (.bin), or bag.',
        metavar='FILE',
    ),
    output: Path = option('Bag to write: a file *.mcap, or a folder.', ..., '-o'),
    columns: Path | None = option('Column map of a table (YAML): columns and their units.'),
    rate_hz: float | None = options.TABLE_RATE,
    imu: int | None = option('Number of the IMU in an autopilot log, counted from 0.'),
    baro: int | None = option(
        'Number of a barometer in an autopilot log, which gives the case temperature.'
    ),
    allow_compensated: bool = option(
        'Accept samples that the autopilot has corrected by INS_TCAL or TC_A parameters.', False
    ),
    names: dict[str, str] = options.named_topics,
    unit: Literal['m/s^2', 'g', 'mg'] = option('Unit of acceleration in an input bag.', 'm/s^2'),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Convert a table of numbers, an autopilot's log or a bag.

    A column map names the columns and their units; the magnitude of the samples
    at rest must be gravity in the stated unit. config/columns has examples.
    Without a map, convert guesses a map from the headings and prints the map; a
    table with the columns t ax ay az wx wy wz, in this order, or without t or
    wx wy wz, needs no headings. In a PX4 or ArduPilot log, the thermometer of
    the IMU gives the board temperature, the thermometer of the barometer the
    case temperature (without an IMU thermometer, the board temperature). In a
    bag, the thermometer whose topic has most namespaces in common with the Imu
    is the board thermometer.

    Example:
      thermo_comp convert log.csv --columns map.yaml -o unit42
      thermo_comp convert flight.ulg --imu 1 -o unit43
    """
    from ..convert.log import write_log
    from ..convert.readers import read_log

    inputs = [log] if columns is None else [log, columns]
    check_output(output, bag_kind(output), overwrite=force, others=inputs)
    given = {
        'columns': columns,
        'rate_hz': rate_hz,
        'imu': imu,
        'baro': baro,
        'allow_compensated': allow_compensated or None,
        'topic': names or None,
        'unit': None if unit == 'm/s^2' else unit,
    }
    with out.progress('converting') as done:
        with options.usage_of():
            read = read_log(log, **given)
        print_guess(out, read, {})
        report = write_log(read, output, force, done)
    _print_conversion(out, report, output)
    written, further = report.log, dict(report.messages)
    n_messages = {f'{name}_messages': further.pop(name) for name in ('accel', 'board', 'case')}
    out.end(
        output=output,
        **picked(report, 'rows rate_hz duration_s inferred_unit stillness'),
        **picked(written, 'input unit missing chosen hint not_used'),
        source=written.path,
        start_ns=int(written.stamp_ns[0]),
        **n_messages,
        further_messages=further,
        **report.findings,
    )


def _print_conversion(out: Output, report: 'ConversionReport', output: Path) -> None:
    from ..convert.log import SLOW_HZ

    log = report.log
    accel = SAMPLES[log.input].name
    out.line(
        f'{log.path}: {report.rows} rows, {report.duration_s:.1f} s at {report.rate_hz:.4g} Hz'
    )
    out.line(f'{output}:')
    for name, count in report.messages.items():
        out.line(f'  {count:8} {accel if name == "accel" else thermometer(name)}')
    out.line(f'unit: {log.unit}; {report.inferred_unit}')
    if report.rate_hz < SLOW_HZ:
        out.line(
            f'{report.rate_hz:.3g} Hz is sufficient for soaks of minutes; the rate is too low for '
            'rests of seconds, and to detect vibration or a knock between two samples'
        )
    if log.hint:
        out.line(log.hint)
    for name, finding in report.findings.items():
        if finding.count:
            more = ', ...' if finding.count > len(finding.lines) else ''
            where = f' (line {", ".join(map(str, finding.lines))}{more})' if finding.lines else ''
            out.line(f'{_FINDINGS[name]}: {finding.count}{where}')
    if report.stillness.moving_ns:
        out.line('times at which the unit was moved or shaken, from the first sample:')
        for stretch in report.stillness.moving_ns:
            begin, end = ((stamp_ns - int(log.stamp_ns[0])) * 1e-9 for stamp_ns in stretch)
            out.line(f'  {begin:9.1f} .. {end:.1f} s')
    out.sources([(log.path, log.chosen, log.missing)])


def print_guess(out: Output, log: 'ForeignLog', printed: dict[str, str]) -> None:
    """
    Print the guessed column map and the unused columns of a table. `printed`: texts printed so
    far, each with its first table; the name of this table replaces a repeated column map.
    """
    from ..convert.column_map import column_map_text
    from ..convert.headings import map_lines

    if log.guessed is not None and log.guessed.format is None:  # guessed from headings
        lines = map_lines(log.guessed)
        first = printed.setdefault('\n'.join(lines), log.path)
        if first == log.path:
            out.line(f'{log.path}: guessed column map; if the map is wrong, edit it for --columns')
            for line in lines:
                out.line(f'  {line}')
        else:
            out.line(f'{log.path}: same column map as {first}')
    elif log.guessed is not None:
        text = column_map_text(log.guessed)
        out.line(f'{log.path}: guessed {text}; if this guess is wrong, give --columns')
    not_used = f'columns not used: {", ".join(log.not_used)}'
    if log.not_used and printed.setdefault(not_used, log.path) == log.path:
        out.line(f'{log.path}: {not_used}')


def export(
    path: Path = argument('Calibration of the unit.', metavar='YAML'),
    to: Tool = option('Tool for which the file is written.', ...),
    output: Path = option('File to write.', ..., '-o'),
    number: int | None = option(
        'Number of the set of parameters: TC_A0.. of PX4 (default 0), INS_TCAL1.. of ArduPilot '
        '(1), imu0.. of Kalibr (0).',
        min=0,
    ),
    device_id: int = option(
        'Device id (TC_An_ID), by which PX4 finds the parameters of a sensor.', 0
    ),
    up: tuple[float, float, float] | None = option(
        'Unit vector of the specific force at rest in the sensor frame; the scale error times '
        'gravity in this attitude is added to the offset.',
        metavar='X Y Z',
    ),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Write a calibration as a file of another tool.

    PX4 and ArduPilot keep the offset of each axis as a cubic of temperature;
    imu_tk (.calib), imu_calib and Kalibr (YAML) keep bias, scale and misalignment
    at the reference temperature. Parts of the calibration that the file lacks are
    listed, most with the resulting error.

    Example:
      thermo_comp export unit42.yaml --to px4 -o unit42.params
      thermo_comp export unit42.yaml --to ardupilot --up 0 0 1 -o unit42.parm
      thermo_comp export unit42.yaml --to imu_tk -o unit42.calib
    """
    from ..convert.exchange import export_calibration
    from ..unit.calibration_file import load_calibration

    if device_id and to != 'px4':
        raise options.usage('--device-id needs --to px4')
    if number is not None and to in ('imu_tk', 'imu_calib'):
        raise options.usage('--number needs --to px4, ardupilot or kalibr')
    if up is not None and to not in ('px4', 'ardupilot'):
        raise options.usage('--up needs --to px4 or --to ardupilot')
    check_output(output, PARAMETERS, overwrite=force, others=[path])
    calibration = load_calibration(path)
    with options.usage_of():
        result = export_calibration(calibration, to, number=number, device_id=device_id, up=up)
    write_atomically(output, result.text.encode(), PARAMETERS, overwrite=force)
    out.line(f'{output}: parameters of {to} for unit {calibration.unit.serial}')
    out.points(result.notes)
    out.end(output=output, to=to, serial=calibration.unit.serial, notes=result.notes)


def import_(
    path: Path = argument(
        'Parameters of PX4 or ArduPilot, .calib of imu_tk, YAML of imu_calib or Kalibr.',
        metavar='FILE',
    ),
    output: Path = options.NEW_CALIBRATION,
    serial: str = option('Serial of the unit.', ..., callback=options.check_serial),
    number: int | None = option('Number of the set of parameters (TC_A0, INS_TCAL1, imu0).'),
    gravity: float = option('Local gravity in m/s^2.', STANDARD_GRAVITY, min=9.01, max=10.49),
    rate_hz: float | None = option(
        'Samples per second of the unit; default: as stated by a file of Kalibr, else 200.',
        min=0.1,
    ),
    full_scale_g: float = option('Full scale in g.', 16.0, min=0.1),
    noise_ug: float | None = option(
        'Noise density in ug/sqrt(Hz), for the covariance of samples; default: as stated by a '
        'file of Kalibr, else 200.',
        min=0.01,
    ),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Convert a file of another tool into a calibration.

    Thermal parameters of PX4 and ArduPilot give the bias over temperature; the
    files of imu_tk, imu_calib and Kalibr give bias, scale and misalignment. The
    static and the dynamic regime get the same coefficients. The calibration
    corrects samples in the unit of the file: m/s^2 (node: input:=imu), or counts.
    Only a fit to bags of a thermal test gives parameters that the file lacks.

    Example:
      thermo_comp import autopilot.params --serial 42 -o unit42.yaml
      thermo_comp import xsens_acc.calib --serial 42 -o unit42.yaml
    """
    from ..convert.exchange import import_calibration
    from ..unit.calibration_file import save_calibration

    check_output(output, CALIBRATION, overwrite=force, others=[path])
    try:
        calibration = import_calibration(
            read_bounded(path, _LIMIT).decode('utf-8', errors='replace'),
            serial=serial,
            number=number,
            gravity=gravity,
            cycle_time_s=None if rate_hz is None else 1.0 / rate_hz,
            full_scale=full_scale_g * 1e6 * MICRO_G,
            noise_density=None if noise_ug is None else noise_ug * MICRO_G,
        )
    except (CalibrationError, ValueError) as failure:
        raise CalibrationError(str(failure), path=path) from failure
    save_calibration(calibration, output, overwrite=force)
    lower, upper = calibration.static.temperature_range_c
    source = calibration.provenance.model
    out.line(f'{output}: unit {serial}, {source}, {lower:g} .. {upper:g} degC')
    out.points(calibration.provenance.notes)
    out.end(output=output, calibration=calibration)
