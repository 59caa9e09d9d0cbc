# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fits the sample bags, plays a held-out bag through the live node, and judges the node's output.

    python benchmarks/demo.py [--bags bags] [--out out]

The player publishes the held-out bag over DDS, and a recorder receives the node's output over DDS.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

# Restrict discovery to this machine before ROS is imported for the first time.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

from live_node import through_the_node

from thermo_comp.api import fit
from thermo_comp.cli.judge import print_sections
from thermo_comp.cli.output import Output
from thermo_comp.judging.evaluation import evaluate
from thermo_comp.recording.reader import open_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.replay import replay
from thermo_comp.report.evidence import evidence_of_bags
from thermo_comp.report.page import write_report
from thermo_comp.topics import IMU_OUT, REGIME
from thermo_comp.unit.calibration_file import save_calibration
from thermo_comp.unit.gravity import STANDARD_GRAVITY

# Sd of the sample unit's bias from turn-on to turn-on [m/s^2]. |f| in nine positions does not
# determine this sd, so the fit gets the sd as an option.
MOUNTING_SD = 1e-6 * STANDARD_GRAVITY

# Groups of columns of each fit in the printed table: one curve for both regimes; one curve per
# regime; None (the fit selects the groups) for the calibration of the node.
MODELS = {'one set': ('curve',), 'two sets': ('curve', 'set'), 'node': None}


def demo(folder: Path, output: Path) -> bool:
    """Run all steps; return whether the node lost no message and its output equals `replay`'s."""
    out = Output()
    output.mkdir(parents=True, exist_ok=True)
    held_out, recorded, unit = folder / 'held_out.mcap', output / 'out.mcap', output / 'unit.yaml'
    fit_bags = sorted((folder / 'fit').glob('*.mcap'))
    models = {}
    with out.progress('fitting', total=len(MODELS)) as done:
        for name, groups in MODELS.items():
            models[name] = fit(
                fit_bags, gravity=STANDARD_GRAVITY, groups=groups, mounting_sd=MOUNTING_SD
            )
            done(len(models))
    save_calibration(models['node'], unit)
    out.line(f'fitted {unit} from {len(fit_bags)} bags of {folder / "fit"}')
    with out.progress('playing') as done:
        played, counts = through_the_node(held_out, unit, recorded, progress=done)
    info, wall_s = played.info, played.duration_s
    bag_s, n_in = (info.end_ns - info.start_ns) * 1e-9, max(played.n_messages.values())
    n_out, n_flags = counts[IMU_OUT.name], counts[REGIME.name]
    out.line(
        f'played {held_out} through the node: {bag_s / 60.0:.0f} min in {wall_s:.1f} s, '
        f'{bag_s / wall_s:.0f} times real time'
    )
    out.line(
        f'messages in {n_in}, messages out {n_out}; regime flags {n_flags}; recorded {recorded}'
    )
    offline = replay(held_out, models['node'], output / 'offline.mcap', overwrite=True).output
    is_same = messages(recorded) == messages(offline)
    offline.unlink()
    out.line(f'node = offline replay, bit for bit: {"yes" if is_same else "NO"}')
    judged = [(name, models[name]) for name in reversed(MODELS)]
    result = evaluate([held_out], judged, gravity=STANDARD_GRAVITY)
    out.line()
    print_sections(out, result.judgements)
    out.line('one set: a cubic for both regimes; two sets: a cubic for each regime, as in')
    out.line("Golovach's paper; node: two sets and the thermal response that the fit selects")
    page, figures = output / 'report.html', output / 'figures'
    with out.progress('drawing', total=None):
        evidence = evidence_of_bags(result.bags, models['node'], gravity=STANDARD_GRAVITY)
        write_report(evidence, page, figures=figures)
    out.line()
    out.line(f'figure {next(figures.glob("*gravity.png"))}, certificate {page}')
    return is_same and n_out == n_in


def messages(path: Path) -> list[tuple[int, bytes]]:
    """Return the log time [ns] and the bytes of each Imu message in a bag."""
    with open_recording(path, Topics(imu=IMU_OUT.name, input='imu'), require=['accel']) as bag:
        return [
            pair
            for block in bag.blocks(raw=True)
            for pair in zip(block.log_ns['accel'].tolist(), block.raw['accel'], strict=True)
        ]


def main() -> int:
    """Run the demonstration; return 1 if a message is lost or node and `replay` differ."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--bags', default='bags', help='folder of the sample bags')
    parser.add_argument('--out', default='out', help='folder for the results')
    arguments = parser.parse_args()
    if not Path(arguments.bags, 'held_out.mcap').is_file():
        parser.error(f'no sample bags in {arguments.bags}: start in a clone of the repository')
    return 0 if demo(Path(arguments.bags), Path(arguments.out)) else 1


if __name__ == '__main__':
    sys.exit(main())
