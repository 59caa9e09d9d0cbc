# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of a fleet: what is left unit by unit, and who stands out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ..typing import Floats
from . import style

_SECTION_LINES: dict[str, style.Line] = {
    'raw': style.RUNG_LINES['raw'],
    'static': style.STATIC_LINE,
    'dynamic': style.DYNAMIC_LINE,
}


def draw_shares(curves: Mapping[str, Floats]) -> Figure:
    """Draw the share of units below each residual [micro-g], by section."""
    figure = style.new_figure(2.6)
    axes = figure.subplots()
    drawn = {name: np.sort(values[values > 0.0]) for name, values in curves.items()}
    drawn = {name: values for name, values in drawn.items() if len(values)}
    for name, values in drawn.items():
        share = np.arange(1, len(values) + 1) / len(values) * 100.0
        axes.step(values, share, where='post', label=name, **_SECTION_LINES[name])
    low = min((float(values[0]) for values in drawn.values()), default=1.0)
    high = max((float(values[-1]) for values in drawn.values()), default=1.0)
    style.log_axis(axes, low / 1.3, high * 1.3)
    axes.set_ylim(0.0, 103.0)
    axes.set_xlabel('|f| − g of a unit, RMS, µg')
    axes.set_ylabel('units, %')
    style.legend_above(axes)
    return figure


def draw_distances(labels: Sequence[str], distances: Sequence[Floats], limit: float) -> Figure:
    """Draw each unit's distance from the middle, by quantity; beyond `limit` as a diamond."""
    figure = style.new_figure(0.6 + 0.19 * len(labels))
    axes = figure.subplots()
    shown = min(max(1.15 * limit, 4.0), 12.0)
    for row, z in enumerate(distances):
        at = np.clip(z, -1.04 * shown, 1.04 * shown)
        is_far = np.abs(z) > limit
        marks = ((~is_far, '|', style.GREY, 6.0), (is_far, 'D', style.RED, 3.5))
        for rows, mark, color, size in marks:
            axes.plot(at[rows], np.full(int(rows.sum()), row), mark, color=color, ms=size)
    for edge in (-limit, limit):
        axes.axvline(edge, color=style.BLACK, linewidth=0.8, linestyle=(0, (5, 2)))
    axes.set_xlim(-1.1 * shown, 1.1 * shown)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.set_yticks(range(len(labels)), labels)
    axes.grid(visible=True, axis='x')
    axes.set_xlabel('distance from the median, standard deviations')
    return figure
