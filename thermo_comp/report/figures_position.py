# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of the positions: where they point, what is left in each, how it scatters."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..unit.gravity import MICRO_G, spoken
from . import style
from .evidence import LEFT_OUT, RAW, Evidence, Position, given
from .html import number

# Diameter of the ring of the position that the others tell the least of [pt].
_RING = 22.0
# More number labels of a dot plot would overlap, and more rows fill no page.
_MOST = 24


def draw_histograms(evidence: Evidence) -> Figure:
    """Draw how what is left is distributed, by regime, with the normal distribution beside it."""
    name, residual = list(evidence.residuals.items())[-1]
    dynamic = given(evidence.windows).is_dynamic
    parts = [
        (label, residual[rows] / MICRO_G, line)
        for label, rows, line in (
            ('static', ~dynamic, style.STATIC_LINE),
            ('dynamic', dynamic, style.DYNAMIC_LINE),
        )
        if rows.any()
    ]
    figure = style.new_figure(2.0)
    panels = figure.subplots(1, len(parts), squeeze=False)[0]
    for axes, (label, values, line) in zip(panels, parts, strict=True):
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
        style.few_ticks(axes, 4)
        axes.set_title(f'{name}, {label}: sd {number(sd)} µg')
        axes.set_xlabel('|f| − g, µg')
    return figure


def draw_every_position(evidence: Evidence) -> Figure:
    """Draw what is left of |f| over the time in every position, or in those with most of it."""
    windows = given(evidence.windows)
    judged, residual = list(evidence.residuals.items())[-1]
    worst = sorted(evidence.positions, key=lambda one: -one.residual_rms[judged])[:_MOST]
    shown = sorted(worst, key=lambda one: one.number)
    numbers = np.unique(windows.position)
    limit = float(np.quantile(np.abs(residual), 0.998)) * 1.15
    unit, name = style.time_unit(max(one.duration_s for one in shown))
    figure = style.new_figure(0.8 + 0.24 * len(shown))
    axes = figure.subplots()
    for row, one in enumerate(shown):
        rows = windows.position == numbers[one.number - 1]
        time = (windows.time[rows] - windows.time[rows][0]) / unit
        value = row - 0.5 * residual[rows] / limit
        dynamic = windows.is_dynamic[rows]
        axes.axhline(row, color='black', linewidth=0.4)
        # Dashes would hide what is noise: the regimes differ by width.
        for is_drawn, color, width in ((~dynamic, style.BLACK, 1.4), (dynamic, style.RED, 0.7)):
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


def draw_positions(evidence: Evidence) -> Figure:
    """Draw where the positions point on the sphere, and what is left on each of them."""
    figure = style.new_figure(2.9)
    *sides, dots = figure.subplots(1, 3, width_ratios=[1.0, 1.0, 1.25])
    least = evidence.least_known
    for side, axes, name in ((1, sides[0], 'z up'), (-1, sides[1], 'z down')):
        _draw_hemisphere(axes, evidence.positions, side)
        if least is not None and (least.up[2] >= 0.0) == (side > 0):
            place = equal_area(least.up, side)
            axes.plot(*place, 'x', markersize=7.0, color=style.RED, mew=1.6)
            said = '±' + spoken(least.sd_m_s2).replace('ug', 'µg')
            # Towards the middle: outside stand the names of the axes.
            by = (0.0, 6.0 if place[1] < 0.0 else -12.0)
            _note(axes, said, place, by, ha='center', color=style.RED)
        axes.set_title(name, loc='center')
    if evidence.residuals:
        _draw_dots(dots, evidence)
    else:
        dots.set_axis_off()
    return figure


def equal_area(up: tuple[float, ...], side: int) -> tuple[float, float]:
    """Map a direction of one hemisphere into the unit disc, the pole its centre, areas kept."""
    x, y, z = up
    factor = 1.0 / np.sqrt(1.0 + max(side * z, 0.0))
    return float(x * factor), float(y * factor)


def _note(
    axes: Axes, text: str, place: tuple[float, float], by: tuple[float, float], **look: Any
) -> None:
    axes.annotate(text, place, by, textcoords='offset points', fontsize=7.5, **look)


def _draw_hemisphere(axes: Axes, positions: tuple[Position, ...], side: int) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    axes.plot(np.cos(angle), np.sin(angle), color='black', linewidth=0.8)
    # 45 degrees of elevation, in the same projection.
    ring = np.sqrt(1.0 - np.sin(np.pi / 4.0))
    for line in (
        (ring * np.cos(angle), ring * np.sin(angle)),
        ([-1, 1], [0, 0]),
        ([0, 0], [-1, 1]),
    ):
        axes.plot(*line, color='#BBBBBB', linewidth=0.6)
    for label, x, y in (('+x', 1.2, 0), ('−x', -1.2, 0), ('+y', 0, 1.2), ('−y', 0, -1.2)):
        axes.text(x, y, label, ha='center', va='center', color='#555555', fontsize=7.5)
    largest = max((p.residual_rms.get(LEFT_OUT, 0.0) for p in positions), default=0.0)
    for position in positions:
        if (position.up[2] >= 0.0) == (side > 0):
            place = equal_area(position.up, side)
            axes.plot(*place, 'o', markersize=4.5, color='black')
            if LEFT_OUT in position.residual_rms and largest > 0.0:
                size = _RING * np.sqrt(position.residual_rms[LEFT_OUT] / largest)
                axes.plot(*place, 'o', markersize=size, mfc='none', mec=style.RED, mew=1.1)
            _note(axes, str(position.number), place, (3.5, 2.5))
    axes.set_xlim(-1.32, 1.32)
    axes.set_ylim(-1.32, 1.32)
    axes.set_aspect('equal')
    axes.set_axis_off()


def _draw_dots(axes: Axes, evidence: Evidence) -> None:
    """Draw a dot for each position and rung."""
    positions = evidence.positions
    judged = list(evidence.residuals)[-1]
    looks: dict[str, style.Line] = {
        RAW: {'marker': 'o', 'mfc': 'white', 'mec': 'black', 'ms': 4.5},
        judged: {'marker': 'o', 'color': 'black', 'ms': 4.5},
        LEFT_OUT: {'marker': 'D', 'mfc': 'none', 'mec': style.RED, 'ms': 5.5},
    }
    drawn = []
    for rung, look in looks.items():
        found = [(p.number, p.residual_rms[rung]) for p in positions if rung in p.residual_rms]
        if found:
            numbers, rms = np.array(found).T
            drawn.append(rms / MICRO_G)
            axes.plot(drawn[-1], numbers, linestyle='none', label=rung, **look)
    if len(evidence.residuals) > 1:
        axes.hlines([p.number for p in positions], *drawn[:2], color='#BBBBBB', lw=0.7, zorder=1)
    both = np.maximum(np.concatenate(drawn), 1e-3)
    style.log_axis(axes, float(np.min(both)) / 1.4, float(np.max(both)) * 1.4)
    axes.set_ylim(len(positions) + 0.7, 0.3)
    if len(positions) <= _MOST:
        axes.set_yticks([p.number for p in positions])
    else:
        axes.yaxis.set_major_locator(MaxNLocator(12, integer=True))
    axes.set_xlabel('RMS of |f| − g, µg')
    axes.set_ylabel('position')
    style.legend_above(axes, share=0.4)
