# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of the thermal side: the paper's Fig. 3 and Fig. 4 from the user's bag."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..judging import Windows
from ..thermal.regime import Regime
from ..typing import Bools, Floats
from ..unit.gravity import MICRO_G
from .evidence import BagFacts, Evidence, ShownBag, given
from .style import (
    AXIS_LINES,
    BOARD_LINE,
    CASE_LINE,
    Sheet,
    broken,
    few_ticks,
    legend_above,
    new_figure,
    time_unit,
)

_PER_MINUTE = 60.0
_PER_MINUTE2 = 3600.0
# Where the drift's zero is taken: long enough for the windows' noise, short against any ramp.
_ZERO_S = 120.0
_SHADE = '#E9E9E9'


def shown_bag(evidence: Evidence) -> tuple[ShownBag, BagFacts]:
    """Return the bag of the time figures and its facts."""
    shown = given(evidence.shown)
    return shown, evidence.bags[shown.index]


def shade_dynamic(axes: Axes, shown: ShownBag, unit: float) -> None:
    """Shade the time in which the flag says dynamic."""
    spans: list[tuple[float, float]] = []
    for stretch in shown.trace.stretches:
        if stretch.regime == Regime.DYNAMIC:
            # Heating into cooling is one span: no bright seam between two of them.
            start = spans.pop()[0] if spans and spans[-1][1] == stretch.start else stretch.start
            spans.append((start, stretch.stop))
    for start, stop in spans:
        axes.axvspan(start / unit, stop / unit, color=_SHADE, lw=0, zorder=0)


def plot_windows(
    axes: Axes, windows: Windows, rows: Bools, value: Floats, unit: float, **line: Any
) -> None:
    """Draw a value of some windows over time, with a gap between positions."""
    time, value = broken(windows.time[rows], value[rows], windows.position[rows])
    axes.plot(time / unit, value, **line)


def time_axis(axes: Axes, facts: BagFacts) -> None:
    """Make the x axis that of a bag's time."""
    unit, name = time_unit(facts.duration_s)
    axes.set_xlabel(name)
    axes.set_xlim(0.0, facts.duration_s / unit)


def draw_temperatures(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw the readings of both sensors (the paper's Fig. 3)."""
    shown, facts = shown_bag(evidence)
    unit, _ = time_unit(facts.duration_s)
    figure = new_figure(sheet, 3.2 if sheet.is_narrow else 2.5)
    axes = figure.subplots()
    shade_dynamic(axes, shown, unit)
    for label, readings, line in (
        ('T case', shown.case, CASE_LINE),
        ('T board', shown.board, BOARD_LINE),
    ):
        if len(readings.value):
            seconds: Floats = np.asarray((readings.stamp_ns - shown.start_ns) * 1e-9, np.float64)
            axes.plot(seconds / unit, readings.value, label=label, **line)
    time_axis(axes, facts)
    axes.set_ylabel('temperature, °C')
    legend_above(axes, sheet)
    return figure


def draw_dynamics(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw the readings' drift, the temperatures' derivatives and the flag (Fig. 4 a, b, c)."""
    shown, facts = shown_bag(evidence)
    unit, _ = time_unit(facts.duration_s)
    has_drift = evidence.windows is not None and bool(np.any(evidence.windows.bag == shown.index))
    ratios = ([1.5] if has_drift else []) + [1.3, 1.0, 0.75]
    figure = new_figure(sheet, (1.5 if sheet.is_narrow else 1.15) * sum(ratios))
    panels = list(np.atleast_1d(figure.subplots(len(ratios), sharex=True, height_ratios=ratios)))
    if has_drift:
        _draw_drift(panels[0], evidence, shown, sheet, unit)
    rates, bend, flag = panels[-3:]
    trace = shown.trace
    for axes in panels[:-1]:
        shade_dynamic(axes, shown, unit)
    time = trace.time / unit
    for label, rate, line in (
        ('dT case/dt', trace.case_rate, CASE_LINE),
        ('dT board/dt', trace.board_rate, BOARD_LINE),
    ):
        if np.isfinite(rate).any():
            rates.plot(time, rate * _PER_MINUTE, label=label, **line)
    rates.set_ylabel('K/min')
    legend_above(rates, sheet, title='b  first derivatives', alignment='left')
    sensor = 'case' if trace.is_case_leading else 'board'
    line = CASE_LINE if trace.is_case_leading else BOARD_LINE
    bend.plot(time, trace.case_acceleration * _PER_MINUTE2, **line)
    bend.set_ylabel('K/min²')
    bend.set_title(f'second derivative of T {sensor}')
    few_ticks(bend, 4)
    _draw_flag(flag, shown, unit)
    time_axis(flag, facts)
    figure.align_ylabels(panels[:-1])
    return figure


def _draw_drift(
    axes: Axes, evidence: Evidence, shown: ShownBag, sheet: Sheet, unit: float
) -> None:
    drift, unit_name = reading_drift(evidence)
    windows = given(evidence.windows)
    rows = windows.bag == shown.index
    for i, axis in enumerate('xyz'):
        plot_windows(axes, windows, rows, drift[:, i], unit, label=axis, **AXIS_LINES[i])
    axes.set_ylabel(unit_name)
    legend_above(axes, sheet, title='a  drift of the readings since the start', alignment='left')


def reading_drift(evidence: Evidence) -> tuple[Floats, str]:
    """Give what the readings change by in each position, shape (n, 3), and its unit."""
    windows = given(evidence.windows)
    drift = windows.mean.copy()
    for p in np.unique(windows.position):
        rows = windows.position == p
        begin = windows.time[rows] <= windows.time[rows][0] + _ZERO_S
        drift[rows] -= windows.mean[rows][begin].mean(axis=0)
    calibration = evidence.calibration
    if calibration is not None:
        axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
        return drift / np.array([axis.scale_factor for axis in axes]) / MICRO_G, 'µg'
    if evidence.unit == 'm/s^2':
        return drift / MICRO_G, 'µg'
    return drift, 'counts'


def _draw_flag(axes: Axes, shown: ShownBag, unit: float) -> None:
    for stretch in shown.trace.stretches:
        start, stop = stretch.start / unit, stretch.stop / unit
        if stretch.regime == Regime.UNKNOWN:
            axes.axvspan(start, stop, fill=False, hatch='---', edgecolor='#999999', lw=0)
        elif stretch.regime == Regime.DYNAMIC:
            hatch = {1: '////', -1: '\\\\\\\\', 0: 'xxxx'}[stretch.direction]
            axes.fill_between(
                [start, stop],
                [stretch.direction or 1.0] * 2,
                facecolor=_SHADE,
                edgecolor='#777777',
                hatch=hatch,
                lw=0,
            )
    times: list[float] = []
    levels: list[float] = []
    for stretch in shown.trace.stretches:
        if stretch.regime != Regime.UNKNOWN:
            level = float(stretch.direction if stretch.regime == Regime.DYNAMIC else 0)
            times += [stretch.start / unit, stretch.stop / unit]
            levels += [level, level]
    axes.plot(times, levels, color='black', linewidth=1.3)
    axes.set_ylim(-1.35, 1.35)
    axes.set_yticks([-1, 0, 1], ['S = 1, cooling', 'S = 0, static', 'S = 1, heating'])
    axes.set_title('c  regime flag S')
    axes.grid(visible=False, axis='x')
