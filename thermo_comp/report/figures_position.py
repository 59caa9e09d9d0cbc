# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of the positions: where they point, and what is left in each of them."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..unit.gravity import MICRO_G, spoken
from .evidence import LEFT_OUT, RAW, Evidence, Position, given
from .style import BLACK, RED, Line, Sheet, legend_above, log_axis, new_figure, time_unit
from .text import number

# Diameter of the ring of the position that the others tell the least of [pt].
_RING = 22.0
# More number labels of a dot plot would overlap, and more rows fill no page.
_MOST = 24


def draw_every_position(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw what is left of |f| over the time in every position, or in those with most of it."""
    windows = given(evidence.windows)
    judged, residual = list(evidence.residuals.items())[-1]
    worst = sorted(evidence.positions, key=lambda one: -one.residual_rms[judged])[:_MOST]
    shown = sorted(worst, key=lambda one: one.number)
    numbers = np.unique(windows.position)
    limit = float(np.quantile(np.abs(residual), 0.998)) * 1.15
    unit, name = time_unit(max(one.duration_s for one in shown))
    figure = new_figure(sheet, 0.8 + 0.24 * len(shown))
    axes = figure.subplots()
    for row, one in enumerate(shown):
        rows = windows.position == numbers[one.number - 1]
        time = (windows.time[rows] - windows.time[rows][0]) / unit
        value = row - 0.5 * residual[rows] / limit
        dynamic = windows.is_dynamic[rows]
        axes.axhline(row, color='black', linewidth=0.4)
        # Dashes would hide what is noise: the regimes differ by width.
        for is_drawn, color, width in ((~dynamic, BLACK, 1.4), (dynamic, RED, 0.7)):
            axes.plot(time, np.where(is_drawn, value, np.nan), color=color, linewidth=width)
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.set_yticks(range(len(shown)), [str(one.number) for one in shown])
    right = axes.secondary_yaxis('right')
    right.set_yticks(
        range(len(shown)), [number(one.residual_rms[judged] / MICRO_G) for one in shown]
    )
    right.set_ylabel('RMS, µg')
    axes.set_ylabel('position')
    axes.set_xlabel(name)
    axes.set_xlim(0.0, None)
    part = f'; the {_MOST} largest' if len(evidence.positions) > _MOST else ''
    axes.set_title(f'{judged}: a row is ±{number(limit / MICRO_G, 2)} µg high{part}')
    return figure


def draw_positions(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw where the positions point on the sphere, and what is left on each of them."""
    positions = evidence.positions
    if sheet.is_narrow:
        figure = new_figure(sheet, 4.6 + 0.5)
        grid = figure.add_gridspec(2, 2, height_ratios=[1.0, 1.5])
        places = (grid[0, 0], grid[0, 1], grid[1, :])
    else:
        figure = new_figure(sheet, 2.9)
        grid = figure.add_gridspec(1, 3, width_ratios=[1.0, 1.0, 1.25])
        places = (grid[0, 0], grid[0, 1], grid[0, 2])
    least = evidence.least_known
    for side, place, name in ((1, places[0], 'z up'), (-1, places[1], 'z down')):
        axes = figure.add_subplot(place)
        _draw_hemisphere(axes, positions, side)
        if least is not None and (least.up[2] >= 0.0) == (side > 0):
            x, y = equal_area(least.up, side)
            axes.plot(x, y, 'x', markersize=7.0, color=RED, mew=1.6)
            axes.annotate(
                '±' + spoken(least.sd_m_s2).replace('ug', 'µg'),
                (x, y),
                xytext=(0.0, -9.0),
                textcoords='offset points',
                ha='center',
                color=RED,
                fontsize=7.5,
            )
        axes.set_title(name, loc='center')
    dots = figure.add_subplot(places[2])
    if evidence.residuals:
        _draw_dots(dots, evidence, sheet)
    else:
        dots.set_axis_off()
    return figure


def equal_area(up: tuple[float, float, float], side: int) -> tuple[float, float]:
    """Map a direction of one hemisphere into the unit disc, the pole its centre, areas kept."""
    x, y, z = up
    factor = 1.0 / np.sqrt(1.0 + max(side * z, 0.0))
    return float(x * factor), float(y * factor)


def _draw_hemisphere(axes: Axes, positions: tuple[Position, ...], side: int) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    axes.plot(np.cos(angle), np.sin(angle), color='black', linewidth=0.8)
    # 45 degrees of elevation, in the same projection.
    ring = np.sqrt(1.0 - np.sin(np.pi / 4.0))
    axes.plot(ring * np.cos(angle), ring * np.sin(angle), color='#BBBBBB', linewidth=0.6)
    axes.plot([-1, 1], [0, 0], color='#BBBBBB', linewidth=0.6)
    axes.plot([0, 0], [-1, 1], color='#BBBBBB', linewidth=0.6)
    for label, x, y in (('+x', 1.2, 0), ('−x', -1.2, 0), ('+y', 0, 1.2), ('−y', 0, -1.2)):
        axes.text(x, y, label, ha='center', va='center', color='#555555', fontsize=7.5)
    largest = max((p.residual_rms.get(LEFT_OUT, 0.0) for p in positions), default=0.0)
    for position in positions:
        if (position.up[2] >= 0.0) == (side > 0):
            x, y = equal_area(position.up, side)
            axes.plot(x, y, 'o', markersize=4.5, color='black')
            if LEFT_OUT in position.residual_rms and largest > 0.0:
                size = _RING * np.sqrt(position.residual_rms[LEFT_OUT] / largest)
                axes.plot(x, y, 'o', markersize=size, mfc='none', mec=RED, mew=1.1)
            axes.annotate(
                str(position.number),
                (x, y),
                xytext=(3.5, 2.5),
                textcoords='offset points',
                fontsize=7.5,
            )
    axes.set_xlim(-1.32, 1.32)
    axes.set_ylim(-1.32, 1.32)
    axes.set_aspect('equal')
    axes.set_axis_off()


def _draw_dots(axes: Axes, evidence: Evidence, sheet: Sheet) -> None:
    positions = evidence.positions
    numbers = np.array([position.number for position in positions])
    rungs = list(evidence.residuals)
    judged = rungs[-1]
    after = np.array([p.residual_rms[judged] for p in positions]) / MICRO_G
    if len(rungs) > 1:
        before = np.array([p.residual_rms[RAW] for p in positions]) / MICRO_G
        axes.hlines(numbers, after, before, color='#BBBBBB', linewidth=0.7)
        axes.plot(before, numbers, 'o', mfc='white', mec='black', ms=4.5, label='raw')
    axes.plot(after, numbers, 'o', color='black', ms=4.5, label=judged)
    both = np.concatenate((after, before)) if len(rungs) > 1 else after
    without = [
        (p.residual_rms[LEFT_OUT], p.number) for p in positions if LEFT_OUT in p.residual_rms
    ]
    if without:
        left_out = np.array(without)[:, 0] / MICRO_G
        style: Line = {'mfc': 'none', 'mec': RED, 'ms': 5.5}
        axes.plot(left_out, np.array(without)[:, 1], 'D', label=LEFT_OUT, **style)
        both = np.concatenate((both, left_out))
    both = np.maximum(both, 1e-3)
    log_axis(axes, float(np.min(both)) / 1.4, float(np.max(both)) * 1.4)
    axes.set_ylim(len(positions) + 0.7, 0.3)
    if len(positions) <= _MOST:
        axes.set_yticks(numbers)
    else:
        axes.yaxis.set_major_locator(MaxNLocator(12, integer=True))
    axes.set_xlabel('RMS of |f| − g, µg')
    axes.set_ylabel('position')
    legend_above(axes, sheet, share=1.0 if sheet.is_narrow else 0.4)
