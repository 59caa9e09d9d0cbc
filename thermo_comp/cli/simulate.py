# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``simulate``, bags of a test with known truth; ``demo``, the main job on sample bags."""

import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from ..errors import ThermoCompError
from ..files import bag_kind, check_output
from ..unit.gravity import STANDARD_GRAVITY
from . import shared_options as options
from .judge import tell_sections
from .output import Output, picked
from .shared_options import option

if TYPE_CHECKING:
    from ..recording.writer import BagWriter
    from ..simulation.run import SimulatedRun
    from ..simulation.unit import UnitModel
    from ..unit.calibration import Calibration

_OUTPUT = 'imu/data_raw'
# Groups of the fit by column headings: a curve for all regimes; that and its difference in the
# dynamic regime; all that the evidence wants, which is what the node runs.
_MODELS = {'one set': ('curve',), 'two sets': ('curve', 'set'), 'node': None}


def simulate(
    output: Path = option(
        'Bag to write; with several positions a directory of them.', ..., '--output', '-o'
    ),
    unit: str = option(
        'Kind of unit: thermostatted, bare-quartz, mems; or with one kind of physics: '
        'own-lags, between, products, hysteresis, even, convection, switched-load, paper, '
        'slow-noise, plain, demo.',
        'thermostatted',
    ),
    unit_seed: int = option('Which specimen of that kind.', 1, min=0),
    sibling: int | None = option('Another unit of its type, +-15 % in everything.', min=0),
    plan: str | None = option(
        'A whole test, instead of --profile and --positions: chamber-18, chamber-9, '
        'tumble, tumble-3, tumble-1 or held-out.'
    ),
    profile: str | None = option(
        "Chamber program: a name (else chamber), or like '20 30min, 35@0.5 1h, 5@1 1h'."
    ),
    positions: int | None = option('Number of positions, one bag each; else 1.', min=1, max=999),
    position_seed: int = option('Which set of positions.', 0, min=0),
    rate_hz: float = option('Conversion cycles per second.', 100.0, min=0.1, max=1e5),
    temperature_rate_hz: float | None = option(
        "Temperature readings per second, else the sensors' own.", min=1e-4, max=100.0
    ),
    seed: int = option('Seed of the noise.', 0, min=0),
    gravity: float = option('Local gravity in m/s^2.', STANDARD_GRAVITY),
    imu: bool = option(
        'Write sensor_msgs/Imu, with the angular rate of a unit that has one.', False, '--imu'
    ),
    level: int = option('zstd level, 1 fast to 19 small.', 3, min=1, max=19),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Make bags of a thermal test whose truth is known.

    The unit is simulated from its physics (heat flow, parts with
    temperature coefficients, noise, converter); the truth stands in each
    bag's metadata.

    Example:
      thermo_comp simulate --rate-hz 2 --positions 12 -o bags/sim
    """
    from .. import __version__
    from ..recording.writer import BagWriter
    from ..simulation import campaign, presets, run

    with options.usage_of():
        specimen = presets.unit_preset(unit, unit_seed)
        if plan is None:
            profile = profile or 'chamber'
            program = campaign.parse_cyclogram(profile)
            ups = campaign.positions(positions or 1, position_seed)
            stations = tuple(campaign.Position(program, up) for up in ups)
        elif profile or positions:
            raise options.usage('--plan is a whole test: leave out --profile and --positions')
        else:
            stations = campaign.plan(plan, position_seed)
    if sibling is not None:
        specimen = specimen.sibling(sibling)
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
                'up': station.up.tolist(),
                **picked(specimen, 'scale_factor bias_at_reference'),
                'misalignment': specimen.M.tolist(),
            }
            metadata = {
                'serial': specimen.serial,
                'simulated_by': f'thermo_comp {__version__}',
                'truth': json.dumps(truth),
            }
            with options.usage_of():
                runs = run.simulate_blocks(
                    specimen,
                    station.program,
                    station.up,
                    temperature_rate_hz=temperature_rate_hz,
                    **settings,
                )
            n_cycles = station.program.duration_s * rate_hz
            count = Counter(counts=0, board=0, case=0)
            with BagWriter(name, metadata=metadata, level=level, overwrite=force) as writer:
                for more in _write(writer, runs, specimen, imu):
                    count.update(more)
                    done(i + count['counts'] / n_cycles)
            written.append({'bag': str(name), **count})
    out.table(('bag', 'counts', 'board', 'case'), [tuple(row.values()) for row in written])
    seconds = max(station.program.duration_s for station in stations)
    out.end(serial=specimen.serial, duration_s=seconds, bags=written)


def _write(
    writer: 'BagWriter', runs: Iterator['SimulatedRun'], unit: 'UnitModel', is_imu: bool
) -> Iterator[dict[str, int]]:
    """Write a run by blocks, from its first temperatures on, as a recorder would; count them."""
    import numpy as np

    from ..recording.blocks import ImuColumns
    from ..recording.topics import Topics

    topics = Topics()
    start_ns: int | None = None
    for run in runs:
        if start_ns is None:
            first = [one[0] for one in (run.board_stamp_ns, run.case_stamp_ns) if len(one)]
            start_ns = max(first) if len(first) == 2 else 0
        keep = run.accel_stamp_ns >= start_ns
        # Temperatures first: of equal stamps the reading comes before the sample.
        writer.write_temperature(topics.board, run.board_stamp_ns, run.board)
        writer.write_temperature(topics.case, run.case_stamp_ns, run.case)
        stamp_ns, counts = run.accel_stamp_ns[keep], run.counts[keep]
        if is_imu:
            # As a driver reports it: scaled by what the data sheet says.
            force, rate = counts / np.mean(unit.scale_factor), run.angular_rate
            rest = None if rate is None else ImuColumns.of_rate(rate[keep])
            writer.write_imu(topics.imu, stamp_ns, force, np.zeros(9), 'imu_link', rest)
        else:
            writer.write_counts(topics.counts, stamp_ns, counts, 'imu_link')
        writer.flush()
        yield {'counts': len(stamp_ns), 'board': len(run.board), 'case': len(run.case)}


def demo(
    bags: Path | None = option('Folder of the sample bags.', metavar='DIR'),
    output: Path = option(
        'Folder for what the demo makes.', Path('out'), '--out', '-o', metavar='DIR'
    ),
    out: Output = options.out,
) -> None:
    """
    Run the main job on the sample bags, end to end.

    The bag that the fit has not seen goes through the real path: player,
    DDS, the node in a process of its own, DDS, recorder.

    Example:
      thermo_comp demo --out out
    """
    options.require_ros()
    # Before the first import of ROS: on this machine only.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    from ..api import fit
    from ..judging.evaluation import evaluate
    from ..recording.reader import inspect_recording
    from ..report.evidence import evidence_of_bags
    from ..report.page import write_report
    from ..ros.round_trip import round_trip
    from ..unit.calibration_file import save_calibration

    # Where the user says, here, or in the source tree.
    places = [bags] if bags else [Path('bags'), Path(__file__).parents[2] / 'bags']
    folder = next((one for one in places if (one / 'held_out.mcap').is_file()), None)
    if folder is None:
        raise ThermoCompError(
            f'no sample bags in {places[0]}: run it in a clone of the repository, or give --bags'
        )
    output.mkdir(parents=True, exist_ok=True)
    held_out, recorded, unit = folder / 'held_out.mcap', output / 'out.mcap', output / 'unit.yaml'
    fit_bags = sorted((folder / 'fit').glob('*.mcap'))

    calibrations = {}
    with out.progress('fitting', total=len(_MODELS)) as done:
        for name, groups in _MODELS.items():
            calibrations[name] = fit(fit_bags, gravity=STANDARD_GRAVITY, groups=groups)
            done(len(calibrations))
    save_calibration(calibrations['node'], unit)
    out.line(f'fitted {unit} from {len(fit_bags)} bags of {folder / "fit"}')
    info = inspect_recording(held_out)
    bag_s = (info.end_ns - info.start_ns) * 1e-9
    with out.progress('playing') as done:
        # Two hours in eight seconds.
        played, n_recorded = round_trip(
            held_out, unit, recorded, rate=1e3, overwrite=recorded.exists(), progress=done
        )
    (n_in,) = (n for name, n in played.n_messages.items() if name.endswith('accel/counts'))
    n_out, wall_s = n_recorded[_OUTPUT], played.duration_s
    out.line(
        f'played {held_out} through the node: {bag_s / 60.0:.0f} min in {wall_s:.1f} s, '
        f'{bag_s / wall_s:.0f} times real time'
    )
    out.line(
        f'messages in {n_in}, messages out {n_out}; '
        f'regime flags {n_recorded["regime/dynamic"]}; recorded {recorded}'
    )
    is_same = _equals_offline(recorded, held_out, calibrations['node'])
    out.line(f'node = offline replay, bit for bit: {"yes" if is_same else "NO"}')
    models = [(name, calibrations[name]) for name in reversed(_MODELS)]
    result = evaluate([held_out], models, gravity=STANDARD_GRAVITY)
    out.line()
    judged = result.judgements
    tell_sections(out, judged)
    out.line('one set: one cubic for all; two sets: another one in the dynamic regime, as in the')
    out.line('paper; node: two sets and the thermal response that the evidence wants')
    page, figures = output / 'report.html', output / 'figures'
    with out.progress('drawing', total=None):
        node = calibrations['node']
        evidence = evidence_of_bags(result.bags, node, gravity=STANDARD_GRAVITY)
        write_report(evidence, page, figures=figures)
    figure = next(figures.glob('*gravity.png'))
    out.line()
    out.line(f'figure {figure}, certificate {page}')
    out.end(
        messages_in=n_in,
        messages_out=n_out,
        is_equal_to_offline=is_same,
        bag_s=bag_s,
        wall_s=wall_s,
        judgements={name: one.facts() for name, one in judged.items()},
        recorded=recorded,
        figure=figure,
    )
    if not is_same or n_out != n_in:
        raise ThermoCompError('the node lost messages or differs from the offline replay')


def _equals_offline(recorded: Path, bag: Path, calibration: 'Calibration') -> bool:
    """Compare the node's recorded output with the offline run, bit for bit."""
    import numpy as np

    from ..recording.reader import read_recording
    from ..recording.topics import Topics
    from ..replay import replay

    def columns(path: Path) -> tuple[Any, ...]:
        found = read_recording(path, Topics(imu=_OUTPUT, input='imu'), require=['accel']).columns
        beside = found.imu and found.imu.linear_acceleration_covariance
        return found.accel_stamp_ns, found.accel, beside

    with TemporaryDirectory(prefix='thermo_comp-') as folder:
        offline = columns(replay(bag, calibration, Path(folder) / 'offline.mcap').output)
    return all(map(np.array_equal, columns(recorded), offline))
