# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp simulate``: bags of a thermal test with known truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..unit.gravity import STANDARD_GRAVITY
from . import options
from .output import Output

if TYPE_CHECKING:
    from ..recording import ImuColumns
    from ..simulation import Cyclogram, SimulatedRun, UnitModel
    from ..typing import Bools

_BLOCK = 65536


def simulate(
    output: Annotated[
        Path,
        typer.Option(
            '--output', '-o', help='Bag to write; with several positions a directory of them.'
        ),
    ],
    unit: Annotated[
        str,
        typer.Option(
            help='Kind of unit: thermostatted, bare-quartz, mems; or with one kind of physics: '
            'own-lags, between, products, hysteresis, even, convection, switched-load, paper, '
            'slow-noise, plain, demo.'
        ),
    ] = 'thermostatted',
    unit_seed: Annotated[int, typer.Option(help='Which specimen of that kind.', min=0)] = 1,
    sibling: Annotated[
        int | None, typer.Option(help='Another unit of its type, +-15 % in everything.', min=0)
    ] = None,
    plan: Annotated[
        str | None,
        typer.Option(
            help='A whole test, instead of --profile and --positions: chamber-18, chamber-9, '
            'tumble, tumble-3, tumble-1 or held-out.'
        ),
    ] = None,
    profile: Annotated[
        str, typer.Option(help="Chamber program: a name, or like '20 30min, 35@0.5 1h, 5@1 1h'.")
    ] = 'chamber',
    positions: Annotated[
        int, typer.Option(help='Number of positions, one bag each.', min=1, max=999)
    ] = 1,
    position_seed: Annotated[int, typer.Option(help='Which set of positions.', min=0)] = 0,
    rate_hz: Annotated[float, typer.Option(help='Conversion cycles per second.', min=0.1)] = 100.0,
    temperature_rate_hz: Annotated[
        float | None, typer.Option(help="Temperature readings per second, else the sensors' own.")
    ] = None,
    seed: Annotated[int, typer.Option(help='Seed of the noise.', min=0)] = 0,
    gravity: Annotated[float, typer.Option(help='Local gravity in m/s^2.')] = STANDARD_GRAVITY,
    cold_start: Annotated[
        bool, typer.Option('--cold-start', help='Switch the unit on when the recording starts.')
    ] = False,
    imu: Annotated[
        bool,
        typer.Option(
            '--imu', help='Write sensor_msgs/Imu, with the angular rate of a unit that has one.'
        ),
    ] = False,
    level: Annotated[int, typer.Option(help='zstd level, 1 fast to 19 small.', min=1, max=19)] = 3,
    force: options.Force = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Make bags of a thermal test whose truth is known.

    The unit is simulated from its physics (heat flow, parts with
    temperature coefficients, noise, converter); the truth stands in each
    bag's metadata.

    Example:
      thermo_comp simulate --rate-hz 2 --positions 12 -o bags/sim
    """
    from .. import simulation
    from ..files import bag_kind, check_output

    out = Output(as_json, quiet)
    with options.usage_of():
        specimen = simulation.unit_preset(unit, unit_seed)
        if plan is None:
            program = simulation.parse_cyclogram(profile)
            ups = simulation.positions(positions, position_seed)
            stations = tuple(simulation.Position(profile, program, up) for up in ups)
        else:
            stations = simulation.plan(plan, position_seed)
    if sibling is not None:
        specimen = specimen.sibling(sibling)
    n = len(stations)
    names = [output] if n == 1 else [output / f'{i:02d}.mcap' for i in range(1, n + 1)]
    for name in names:
        check_output(name, bag_kind(name), overwrite=force)
    written: list[dict[str, Any]] = []
    with out.progress('simulating', total=n) as done:
        for i, (name, station) in enumerate(zip(names, stations, strict=True)):
            cyclogram = station.program
            facts = {
                'unit': unit,
                'unit_seed': unit_seed,
                'profile': profile if plan is None else plan,
                'position': i + 1,
                'positions': n,
                'position_seed': position_seed,
                'seed': seed + i,
                'rate_hz': rate_hz,
                'gravity': gravity,
                'up': station.up.tolist(),
            }
            runs = simulation.simulate_blocks(
                specimen,
                cyclogram,
                station.up,
                block_size=_BLOCK,
                rate_hz=rate_hz,
                temperature_rate_hz=temperature_rate_hz,
                seed=seed + i,
                gravity=gravity,
                warm=not cold_start,
            )
            count = _write(
                name, runs, specimen, facts, imu, level, force, _part(done, i, cyclogram, rate_hz)
            )
            written.append({'bag': str(name), **count})
    out.table(
        ('bag', 'counts', 'board', 'case'),
        [(row['bag'], row['counts'], row['board'], row['case']) for row in written],
    )
    seconds = max(station.program.duration_s for station in stations)
    out.json({'serial': specimen.serial, 'duration_s': seconds, 'bags': written})


def _part(
    done: Callable[[float], None], before: int, cyclogram: Cyclogram, rate_hz: float
) -> Callable[[int], None]:
    total = cyclogram.duration_s * rate_hz
    return lambda n: done(before + n / total)


def _write(
    path: Path,
    runs: Any,
    unit: UnitModel,
    facts: dict[str, Any],
    is_imu: bool,
    level: int,
    force: bool,
    tell: Callable[[int], None],
) -> dict[str, int]:
    """Write one run; the recording starts with the first temperatures, as a recorder would."""
    import numpy as np

    from .. import __version__
    from ..recording import BagWriter, Topics

    topics = Topics()
    truth = {
        **facts,
        'scale_factor': list(unit.scale_factor),
        'bias_at_reference': list(unit.bias_at_reference),
        'misalignment': [list(row) for row in unit.M],
    }
    metadata = {
        'serial': unit.serial,
        'simulated_by': f'thermo_comp {__version__}',
        'truth': json.dumps(truth),
    }
    count = {'counts': 0, 'board': 0, 'case': 0}
    start_ns: int | None = None
    with BagWriter(path, metadata=metadata, level=level, overwrite=force) as writer:
        for run in runs:
            if start_ns is None:
                start_ns = _first_stamp(run)
            keep = run.accel_stamp_ns >= start_ns
            # Temperatures first: of equal stamps the reading comes before the sample.
            writer.write_temperature(topics.board, run.board_stamp_ns, run.board)
            writer.write_temperature(topics.case, run.case_stamp_ns, run.case)
            stamp_ns, counts = run.accel_stamp_ns[keep], run.counts[keep]
            if is_imu:
                # As a driver reports it: scaled by what the data sheet says.
                force, rest = counts / np.mean(unit.scale_factor), _beside(run, keep)
                writer.write_imu(topics.imu, stamp_ns, force, np.zeros(9), 'imu_link', rest)
            else:
                writer.write_counts(topics.counts, stamp_ns, counts, 'imu_link')
            writer.flush()
            count['counts'] += int(keep.sum())
            count['board'] += len(run.board)
            count['case'] += len(run.case)
            tell(count['counts'])
    return count


def _beside(run: SimulatedRun, keep: Bools) -> ImuColumns | None:
    """Give what an Imu holds beside the force: no orientation, a rate of unknown covariance."""
    import numpy as np

    from ..recording import ImuColumns

    if run.angular_rate is None:
        return None
    n = int(keep.sum())
    nothing, unknown = np.zeros((n, 9)), np.zeros((n, 9))
    unknown[:, 0] = -1.0
    level = np.tile((0.0, 0.0, 0.0, 1.0), (n, 1))
    return ImuColumns(level, unknown, run.angular_rate[keep], nothing, nothing)


def _first_stamp(run: SimulatedRun) -> int:
    if not len(run.board_stamp_ns) or not len(run.case_stamp_ns):
        return 0
    return int(max(run.board_stamp_ns[0], run.case_stamp_ns[0]))
