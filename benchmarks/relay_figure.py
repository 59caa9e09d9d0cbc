# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Draws the results of `node_relay.py --json`: CPU time per sample and latency over the rate.

python benchmarks/relay_figure.py relay.json relay.png

Files of several runs at different rates are drawn in one figure.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use('Agg')
import matplotlib.pyplot as plt

COLOURS = {'node': '#0b6e99', 'naive': '#b5542b'}
NAMES = {'node': 'thermo_comp', 'naive': 'naive relay'}
STYLES = {'reliable': ('-', 'o'), 'best_effort': ('--', 's')}


def draw(measured: list[dict[str, Any]], path: Path) -> None:
    """Draw CPU time per sample and 99th percentile of the latency over the sample rate."""
    figure, (cpu, latency) = plt.subplots(1, 2, figsize=(9.0, 3.8), layout='constrained')
    for reliability, (line, marker) in STYLES.items():
        cases = [case for case in measured if case['reliability'] == reliability]
        rates = [case['rate'] for case in cases]
        for relay, colour in COLOURS.items():
            look = {'color': colour, 'linestyle': line, 'marker': marker, 'markersize': 4}
            label = f'{NAMES[relay]}, {reliability.replace("_", " ")}'
            cpu.plot(rates, [case[relay]['cpu_us'] for case in cases], label=label, **look)
            latency.plot(rates, [case[relay]['p99_ms'] for case in cases], **look)
    goal = latency.axhline(1.0, color='0.6', linewidth=0.8, label='goal: 1 ms')
    latency.legend(handles=[goal], loc='upper left', fontsize=8, frameon=False)
    cpu.set(ylabel='CPU time per sample [µs]', ylim=(10.0, None))
    latency.set(ylabel='99th percentile of the latency [ms]')
    for axes in (cpu, latency):
        axes.set(xlabel='sample rate [Hz]', xscale='log', yscale='log')
        ticks = sorted({case['rate'] for case in measured})
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.grid(visible=True, which='major', color='0.9')
    handles, _ = cpu.get_legend_handles_labels()
    look = {'fontsize': 8, 'frameon': False, 'handlelength': 3.5}
    figure.legend(handles=handles, loc='outside upper center', ncols=4, **look)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Read the results of `node_relay.py` and draw the figure."""
    parser = argparse.ArgumentParser(description='Draw the figures of node_relay.py.')
    parser.add_argument('figures', type=Path, nargs='+', help='files of `node_relay.py --json`')
    parser.add_argument('picture', type=Path, help='PNG file to write')
    options = parser.parse_args()
    documents = [json.loads(path.read_text(encoding='utf-8')) for path in options.figures]
    cases = [case for document in documents for case in document['cases']]
    draw(sorted(cases, key=lambda case: case['rate']), options.picture)


if __name__ == '__main__':
    main()
