# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Draws the pictures of docs/regime.md from the results of benchmarks/regime.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from thermo_comp.typing import Bools, Floats

BLUE, RED, GREEN = '#0072b2', '#d55e00', '#009e73'


def plot_ramp(t: Floats, case: Floats, board: Floats, is_dynamic: Bools, folder: Path) -> None:
    """Draw temperatures, derivatives of the case temperature and flag in a ramp and after it."""
    minutes = t / 60.0
    rate = np.gradient(case, t) * 60.0
    bend = np.gradient(rate, t) * 60.0
    figure = Figure(figsize=(9.0, 5.6), dpi=110, layout='constrained')
    top, middle, low = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2.2, 0.5))
    top.plot(minutes, case, color=RED, lw=1.2, ls='--', label='T_case')
    top.plot(minutes, board, color='black', lw=1.4, label='T_board')
    top.set_ylabel('temperature, °C')
    top.legend(frameon=False, fontsize=8)
    middle.plot(minutes, rate, color=BLUE, lw=1.2, label='dT_case/dt, K/min')
    middle.plot(minutes, 10.0 * bend, color=GREEN, lw=1.2, ls=':', label='10 d²T_case/dt², K/min²')
    middle.set_ylabel('derivatives (true)')
    middle.legend(frameon=False, fontsize=8)
    low.fill_between(minutes, 0.0, 1.0, where=is_dynamic, color='black', lw=0, step='post')
    low.set(xlabel='time since the onset, min', ylim=(0.0, 1.0), yticks=())
    low.set_title('dynamic', loc='left', fontsize=10)
    for axes in (top, middle, low):
        axes.grid(visible=True, color='#e4e4e4')
        axes.set_axisbelow(True)
    save(figure, folder / 'regime_ramp.png')


def save(figure: Figure, path: Path) -> None:
    """Write a figure without date and version, so that equal figures give equal files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={'Software': None})
