# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of the residuals: the paper's Fig. 6 and Fig. 7, and how they scatter."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from ..typing import Bools, Floats
from ..unit.gravity import MICRO_G
from .evidence import RAW, Evidence, given
from .figures_thermal import plot_windows, shade_dynamic, shown_bag, time_axis
from .style import (
    AXIS_LINES,
    DYNAMIC_LINE,
    RUNG_LINES,
    STATIC_LINE,
    Line,
    Sheet,
    few_ticks,
    legend_above,
    new_figure,
    time_unit,
)
from .text import number


def draw_residuals(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw the residual of each axis, without and with the calibration (the paper's Fig. 6)."""
    shown, facts = shown_bag(evidence)
    unit, _ = time_unit(facts.duration_s)
    windows = given(evidence.windows)
    residuals = evidence.axis_residuals()
    rows = windows.bag == shown.index
    height = 1.25 if sheet.is_narrow else 1.05
    figure = new_figure(sheet, 0.5 + height * len(residuals))
    panels = np.atleast_1d(figure.subplots(len(residuals), sharex=True))
    for axes, (rung, residual) in zip(panels, residuals.items(), strict=True):
        shade_dynamic(axes, shown, unit)
        for i, axis in enumerate('xyz'):
            value = residual[:, i] / MICRO_G
            plot_windows(axes, windows, rows, value, unit, label=axis, **AXIS_LINES[i])
        axes.set_ylabel('µg')
        axes.axhline(0.0, color='black', linewidth=0.5)
        few_ticks(axes, 5)
        if rung != RAW:
            _symmetric(axes, residual[rows])
        title = f'{rung}: {_rms_text(residual[rows], windows.is_dynamic[rows])}'
        if axes is panels[0]:
            legend_above(axes, sheet, title=title, alignment='left')
        else:
            axes.set_title(title)
    time_axis(panels[-1], facts)
    figure.align_ylabels(panels)
    return figure


def draw_gravity(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw |f| over time, before and after, and after in detail (the paper's Fig. 7)."""
    shown, facts = shown_bag(evidence)
    unit, _ = time_unit(facts.duration_s)
    windows, gravity = given(evidence.windows), given(evidence.gravity)
    residuals = evidence.residuals
    rows = windows.bag == shown.index
    corrected = [rung for rung in residuals if rung != RAW]
    sets = [list(residuals), *([corrected] if corrected else [])]
    figure = new_figure(sheet, 0.4 + (2.1 if sheet.is_narrow else 1.6) * len(sets))
    panels = np.atleast_1d(figure.subplots(len(sets), sharex=True))
    for axes, drawn in zip(panels, sets, strict=True):
        shade_dynamic(axes, shown, unit)
        for rung in drawn:
            value = residuals[rung] / MICRO_G
            plot_windows(axes, windows, rows, value, unit, label=rung, **RUNG_LINES[rung])
        axes.axhline(0.0, color='black', linewidth=0.5)
        axes.set_ylabel('|f| − g, µg')
        _absolute_scale(axes, gravity)
        legend_above(axes, sheet)
    for rung in corrected:
        _symmetric(panels[-1], residuals[rung][rows])
    time_axis(panels[-1], facts)
    return figure


def draw_histograms(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw how what is left is distributed, by regime."""
    name, residual = list(evidence.residuals.items())[-1]
    dynamic = given(evidence.windows).is_dynamic
    parts = [
        (label, residual[rows] / MICRO_G, line)
        for label, rows, line in (
            ('static', ~dynamic, STATIC_LINE),
            ('dynamic', dynamic, DYNAMIC_LINE),
        )
        if rows.any()
    ]
    figure = new_figure(sheet, 2.0 * len(parts) if sheet.is_narrow else 2.0)
    shape = (len(parts), 1) if sheet.is_narrow else (1, len(parts))
    for axes, (label, values, line) in zip(
        np.atleast_1d(figure.subplots(*shape)), parts, strict=True
    ):
        _draw_signed(axes, values, line)
        axes.set_title(f'{name}, {label}: sd {number(float(values.std()))} µg')
        axes.set_xlabel('|f| − g, µg')
    return figure


def _draw_signed(axes: Axes, values: Floats, line: Line) -> None:
    limit = max(float(np.quantile(np.abs(values), 0.998)) * 1.1, 1e-3)
    n_bins = int(np.clip(np.sqrt(len(values)), 9, 33))
    edges = np.linspace(-limit, limit, n_bins + 1)
    share = np.histogram(values, edges)[0] / len(values) * 100.0
    axes.stairs(share, edges, fill=True, color='#CCCCCC')
    axes.stairs(share, edges, color='#666666', linewidth=0.7)
    sd, mean = float(values.std()), float(values.mean())
    if sd > 0.0:
        middle = np.linspace(-limit, limit, 121)
        bell = np.exp(-0.5 * ((middle - mean) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
        axes.plot(middle, bell * (edges[1] - edges[0]) * 100.0, **line)
    axes.axvline(0.0, color='black', linewidth=0.5)
    axes.set_xlim(-limit, limit)
    axes.set_ylim(0.0, None)
    axes.set_ylabel('windows, %')
    axes.xaxis.set_major_locator(MaxNLocator(6))
    few_ticks(axes, 4)


def _symmetric(axes: Axes, residual: Floats) -> None:
    """Put zero into the middle of a panel; single spikes may leave it."""
    limit = 1.15 * float(np.quantile(np.abs(residual), 0.998)) / MICRO_G
    if limit > 0.0:
        axes.set_ylim(-limit, limit)


def _rms_text(residual: Floats, is_dynamic: Bools) -> str:
    parts = []
    for label, rows in (('static', ~is_dynamic), ('dynamic', is_dynamic)):
        if rows.any():
            rms = float(np.sqrt(np.mean(residual[rows] ** 2))) / MICRO_G
            parts.append(f'{label} {number(rms)}')
    return f'RMS {", ".join(parts)} µg'


def _absolute_scale(axes: Axes, gravity: float) -> None:
    right = axes.secondary_yaxis(
        'right',
        functions=(
            lambda micro_g: np.asarray(micro_g) * MICRO_G + gravity,
            lambda value: (np.asarray(value) - gravity) / MICRO_G,
        ),
    )
    right.set_ylabel('|f|, m/s²')
    right.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
