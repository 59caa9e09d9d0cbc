# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp demo``: the main job on the sample bags, end to end, over real DDS.

Fit on nine bags; the tenth is played onto live topics, compensated by the node in a process of
its own, and recorded. What comes out is held against the offline run, bit for bit, and gravity.
"""

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from ..errors import ThermoCompError
from ..unit.gravity import STANDARD_GRAVITY
from . import options
from .options import option
from .output import Cell, Output, micro_g

if TYPE_CHECKING:
    from ..judging import Evaluation
    from ..unit.calibration import Calibration

_OUTPUT = 'imu/data_raw'
# Groups of the fit by column headings: a curve for all regimes; that and its difference in the
# dynamic regime; all that the evidence wants, which is what the node runs.
_MODELS = {'one set': ('curve',), 'two sets': ('curve', 'set'), 'node': None}


def demo(
    bags: Path | None = option('Folder of the sample bags.', None, metavar='DIR'),
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
    from ..arrays import fit
    from ..judging import evaluate
    from ..recording import inspect_recording
    from ..report import evidence_of_bags, write_report
    from ..ros.round_trip import round_trip
    from ..unit.calibration_file import save_calibration

    folder = _sample_bags(bags)
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
    _say(out, result)
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
        judgements={name: one.facts() for name, one in result.judgements.items()},
        recorded=recorded,
        figure=figure,
    )
    if not is_same or n_out != n_in:
        raise ThermoCompError('the node lost messages or differs from the offline replay')


def _sample_bags(given: Path | None) -> Path:
    """Find the sample bags: where the user says, here, or in the source tree."""
    places = [given] if given else [Path('bags'), Path(__file__).parents[2] / 'bags']
    for place in places:
        if (place / 'held_out.mcap').is_file():
            return place
    raise ThermoCompError(
        f'no sample bags in {places[0]}: run it in a clone of the repository, or give --bags'
    )


def _equals_offline(recorded: Path, bag: Path, calibration: 'Calibration') -> bool:
    """Compare the node's recorded output with the offline run, bit for bit."""
    import numpy as np

    from ..recording import Topics, read_recording
    from ..replay import replay

    def columns(path: Path) -> tuple[Any, ...]:
        found = read_recording(path, Topics(imu=_OUTPUT), 'imu', require=['accel']).columns
        beside = found.imu and found.imu.linear_acceleration_covariance
        return found.accel_stamp_ns, found.accel, beside

    with TemporaryDirectory(prefix='thermo_comp-') as folder:
        offline = columns(replay(bag, calibration, Path(folder) / 'offline.mcap').output)
    return all(map(np.array_equal, columns(recorded), offline))


def _say(out: Output, result: 'Evaluation') -> None:
    from ..judging import SECTIONS

    rows: list[tuple[Cell, ...]] = []
    for section in SECTIONS:
        parts = [result.judgements[name].sections[section] for name in _MODELS]
        if parts[0].n:
            raw = result.judgements['node'].sections[section]
            pairs = [(raw.raw_rms, raw.raw_peak), *((one.rms, one.peak) for one in parts)]
            cells = [f'{micro_g(rms):>4} / {micro_g(peak):>4}' for rms, peak in pairs]
            rows.append((section, parts[0].n, *cells))
    window_s = result.judgements['node'].windows.window_s
    out.table(
        ('section', 'windows', 'raw', *_MODELS),
        rows,
        title=f'|f| error in ug over {window_s:g} s, RMS / max',
    )
    out.line('one set: one cubic for all; two sets: another one in the dynamic regime, as in the')
    out.line('paper; node: two sets and the thermal response that the evidence wants')
