# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of docs/regime.md, drawn from what benchmarks/regime.py has computed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from thermo_comp.typing import Bools, Floats

BLUE, RED, GREEN, GREY = '#0072b2', '#d55e00', '#009e73', '#808080'


def plot_rules(
    t: Floats, case: Floats, board: Floats, flags: Mapping[str, Bools], folder: Path
) -> None:
    """
    Draw one ramp and its relaxation: temperatures, derivatives of the case, the flag of each rule.
    """
    minutes = t / 60.0
    rate = np.gradient(case, t) * 60.0
    bend = np.gradient(rate, t) * 60.0
    figure = Figure(figsize=(9.0, 6.6), dpi=110, layout='constrained')
    top, middle, low = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2.2, 2.2))
    top.plot(minutes, case, color=RED, lw=1.2, ls='--', label='T_case')
    top.plot(minutes, board, color='black', lw=1.4, label='T_board')
    top.set_ylabel('temperature, °C')
    top.legend(frameon=False, fontsize=8)
    middle.plot(minutes, rate, color=BLUE, lw=1.2, label='dT_case/dt, K/min')
    middle.plot(minutes, 10.0 * bend, color=GREEN, lw=1.2, ls=':', label='10 d²T_case/dt², K/min²')
    middle.set_ylabel('derivatives (true)')
    middle.legend(frameon=False, fontsize=8)
    for row, flag in enumerate(flags.values()):
        at = len(flags) - 1 - row
        colour = GREY if row else 'black'
        low.fill_between(minutes, at, at + 0.8, where=flag, color=colour, lw=0, step='post')
    low.set_yticks([len(flags) - 0.6 - row for row in range(len(flags))], list(flags))
    low.set(xlabel='time since the onset, min', ylim=(-0.1, len(flags)))
    low.set_title('dynamic according to', loc='left', fontsize=10)
    for axes in (top, middle, low):
        axes.grid(visible=True, color='#e4e4e4')
        axes.set_axisbelow(True)
    save(figure, folder / 'regime_rules.png')


def save(figure: Figure, path: Path) -> None:
    """Write a figure; the same numbers give the same file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={'Software': None})
