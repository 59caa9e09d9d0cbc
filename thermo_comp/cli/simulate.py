# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the command ``simulate``: writes bags of a thermal test of a unit with known parameters."""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files import bag_kind, check_output
from ..unit.gravity import STANDARD_GRAVITY
from . import shared_options as options
from .output import Output, picked
from .shared_options import option

if TYPE_CHECKING:
    from ..recording.writer import BagWriter
    from ..simulation.campaign import Position, Spin
    from ..simulation.run import SimulatedRun
    from ..simulation.unit import UnitModel

#: Rate table: topic of the rotation rate, interval between two messages [s], sd of the radius [m].
_RATE_TOPIC, _RATE_STEP_S, _RADIUS_SD_M = 'table/angular_velocity', 0.5, 1e-3


def simulate(
    output: Path = option('Bag to write; with several positions, folder of the bags.', ..., '-o'),
    unit: str = option(
        'Kind of unit: thermostatted, bare-quartz, mems, or demo (the unit of the sample bags).',
        'thermostatted',
    ),
    unit_seed: int = option('Seed of the random parameters of the unit.', 1, min=0),
    plan: str | None = option(
        'Plan of a whole test, instead of --profile and --positions: chamber-18, chamber-9, '
        'tumble, tumble-3, tumble-1, held-out, or with rotation: centrifuge, rate-table.'
    ),
    profile: str | None = option(
        'Chamber program: a name (default: chamber), or steps, each of a temperature in degC, @ a '
        "rate in K/min, and the time of a soak, as '20 30min, 35@0.5 1h, 5@1 1h'."
    ),
    positions: int | None = option('Number of positions, a bag each; default: 1.', min=1, max=999),
    position_seed: int = option('Seed of the random positions.', 0, min=0),
    rate_hz: float = option('Conversion cycles per second.', 100.0, min=0.1, max=1e5),
    temperature_rate_hz: float | None = option(
        "Temperature readings per second; default: the sensors' rate.", min=1e-4, max=100.0
    ),
    seed: int = option('Seed of the noise.', 0, min=0),
    gravity: float = option('Local gravity in m/s^2.', STANDARD_GRAVITY),
    imu: bool = option(
        'Write sensor_msgs/Imu instead of counts, with the angular rate if the unit has a '
        'gyroscope.',
        False,
    ),
    level: int = option(
        'Compression of the bags (zstd level): 1 is fast, 19 gives the smallest files.',
        3,
        min=1,
        max=19,
    ),
    k2: float = option(
        'Quadratic nonlinearity K2 of all axes in ug/g^2; K2 changes by 1 %/K.', 0.0
    ),
    k3: float = option('Cubic nonlinearity K3 of all axes in ug/g^3; K3 changes by 1 %/K.', 0.0),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Simulate bags of a thermal test of a unit with known parameters.

    The unit is simulated from its physics (heat flow, parts with
    temperature coefficients, noise, converter); the metadata of each bag
    contain the true parameters.

    Example:
      thermo_comp simulate --rate-hz 2 --positions 12 -o bags/sim
    """
    from ..recording.writer import BagWriter
    from ..simulation import campaign, presets, run
    from ..simulation.unit import Bend

    with options.usage_of(name='--unit'):
        specimen = presets.unit_preset(unit, unit_seed)
    with options.usage_of(name='--plan'):
        if plan is None:
            profile = profile or 'chamber'
            with options.usage_of('--profile: '):
                program = campaign.parse_cyclogram(profile)
            ups = campaign.positions(positions or 1, position_seed)
            stations = tuple(campaign.Position(program, up) for up in ups)
        elif profile or positions:
            raise options.usage('--plan is a whole test: leave out --profile and --positions')
        else:
            stations = campaign.plan(plan, position_seed)
    if k2 or k3:
        specimen = replace(specimen, bend=Bend((k2,) * 3, (k3,) * 3, 0.01))
    n = len(stations)
    names = [output] if n == 1 else [output / f'{i:02d}.mcap' for i in range(1, n + 1)]
    for name in names:
        check_output(name, bag_kind(name), overwrite=force)
    written: list[dict[str, Any]] = []
    with out.progress('simulating', total=n) as done:
        for i, (name, station) in enumerate(zip(names, stations, strict=True)):
            settings: dict[str, Any] = {'seed': seed + i, 'rate_hz': rate_hz, 'gravity': gravity}
            truth = {
                'unit': unit,
                'unit_seed': unit_seed,
                'profile': profile if plan is None else plan,
                'position': i + 1,
                'positions': n,
                'position_seed': position_seed,
                **settings,
                **({'k2_ug_g2': k2, 'k3_ug_g3': k3} if k2 or k3 else {}),
            }
            metadata = _metadata(specimen, station, truth, gravity, plan == 'centrifuge')
            with options.usage_of():
                runs = run.simulate_blocks(
                    specimen,
                    station.program,
                    station.up,
                    temperature_rate_hz=temperature_rate_hz,
                    spin=station.spin,
                    **settings,
                )
            n_cycles = station.program.duration_s * rate_hz
            count = Counter(counts=0, board=0, case=0)
            with BagWriter(name, metadata=metadata, level=level, overwrite=force) as writer:
                if station.spin is not None:
                    _write_rate(writer, station.spin, station.program.duration_s)
                for more in _write(writer, runs, specimen, imu):
                    count.update(more)
                    done(i + count['counts'] / n_cycles)
            written.append({'bag': str(name), **count})
    out.table(('bag', 'counts', 'board', 'case'), [tuple(row.values()) for row in written])
    seconds = max(station.program.duration_s for station in stations)
    out.end(serial=specimen.serial, duration_s=seconds, bags=written)


def _metadata(
    unit: 'UnitModel', station: 'Position', truth: dict[str, Any], gravity: float, is_known: bool
) -> dict[str, str]:
    """Return a bag's metadata: serial, true parameters and, with rotation, |f| or its source."""
    from .. import __version__
    from ..fitting import sources

    of_unit = picked(unit, 'scale_factor bias_at_reference')
    truth |= {'up': station.up.tolist(), **of_unit, 'misalignment': unit.M.tolist()}
    metadata = {
        'serial': unit.serial,
        'simulated_by': f'thermo_comp {__version__}',
        'truth': json.dumps(truth),
    }
    spin = station.spin
    if spin is None:
        return metadata
    if not is_known:
        return metadata | {
            sources.ROTATION: _RATE_TOPIC,
            sources.RADIUS: f'{spin.radius:g}',
            sources.RADIUS_SD: f'{_RADIUS_SD_M:g}',
        }
    end_s = station.program.duration_s
    rows = [section for section in spin.sections(gravity) if section[0] < end_s]
    lines = [f'{begin:g} {min(end, end_s):g} {size:.9g}' for begin, end, size in rows]
    return metadata | {sources.MAGNITUDE: '; '.join(lines)}


def _write_rate(writer: 'BagWriter', spin: 'Spin', duration_s: float) -> None:
    """Write the rotation rate of the rate table, about the vertical axis z [rad/s]."""
    import numpy as np

    from ..simulation.run import START_NS

    time = np.arange(0.0, duration_s, _RATE_STEP_S)
    rate = np.zeros((len(time), 3))
    rate[:, 2] = spin.rate_at(time)
    stamps = START_NS + np.rint(time * 1e9).astype(np.int64)
    writer.write_counts(_RATE_TOPIC, stamps, rate, 'table')


def _write(
    writer: 'BagWriter', runs: Iterator['SimulatedRun'], unit: 'UnitModel', is_imu: bool
) -> Iterator[dict[str, int]]:
    """Write the blocks of a simulated bag; yield the numbers of messages of each block."""
    import numpy as np

    from ..recording.blocks import ImuColumns
    from ..recording.topics import Topics

    topics = Topics()
    start_ns: int | None = None
    for run in runs:
        if start_ns is None:
            # With two thermometers the samples begin once both thermometers have a reading.
            board_ns, case_ns = run.board_stamp_ns, run.case_stamp_ns
            start_ns = max(board_ns[0], case_ns[0]) if len(board_ns) and len(case_ns) else 0
        keep = run.accel_stamp_ns >= start_ns
        # Write temperatures first, so that at equal stamps a temperature precedes the sample.
        writer.write_temperature(topics.board, run.board_stamp_ns, run.board)
        writer.write_temperature(topics.case, run.case_stamp_ns, run.case)
        stamp_ns, counts = run.accel_stamp_ns[keep], run.counts[keep]
        if is_imu:
            # Divide the counts by the nominal scale factor, as a driver does.
            force, rate = counts / np.mean(unit.scale_factor), run.angular_rate
            rest = None if rate is None else ImuColumns.of_rate(rate[keep])
            writer.write_imu(topics.imu, stamp_ns, force, np.zeros(9), 'imu_link', rest)
        else:
            writer.write_counts(topics.counts, stamp_ns, counts, 'imu_link')
        writer.flush()
        yield {'counts': len(stamp_ns), 'board': len(run.board), 'case': len(run.case)}
