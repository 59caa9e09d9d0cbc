# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of a calibration over temperature, and the figures of a fleet."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..typing import Floats
from ..unit.calibration import AXES, Calibration, rate_triad
from ..unit.gravity import MICRO_G
from ..unit.metrics import means_by
from ..unit.rate_bias import MILLIDEGREE
from . import style
from .certificate import Curve, curves, slopes
from .evidence import CHOSEN, Evidence, required
from .style import minus, number

#: Two-sided 95 % of a normal distribution, in standard deviations.
BAND_SDS = 1.96
_BOARD = 'T board, °C'
# Line, hatch and marker of a soak and of temperature ramps.
_LOOKS: dict[str, tuple[style.Line, str, str]] = {
    'soak': (style.STATIC_LINE, '////', 'o'),
    'heating': (style.DYNAMIC_LINE, '\\\\\\\\', '^'),
    'cooling': (style.AXIS_LINES[2], '....', 'v'),
}
_POINT: style.Line = {'color': style.BLACK, 'ms': 3.0, 'mfc': 'none', 'mew': 0.8}


def draw_functions(evidence: Evidence) -> Figure:
    """Draw bias and scale over temperature, less a straight line, with bands and measurements."""
    calibration = required(evidence.calibration)
    figure = style.new_figure(4.4)
    panels = figure.subplots(2, 3, sharex=True)
    drawn = curves(calibration)
    temperature, errors = soak_measurements(evidence)
    level = errors - np.outer(temperature - calibration.reference_temperature_c, slopes(drawn[0]))
    for k, axes in enumerate(panels.flat):
        _draw_less_line(axes, calibration, drawn, k, 'µg' if k < 3 else 'ppm')
        if np.isfinite(errors[:, k]).any():
            soak = np.interp(temperature, drawn[0].temperature, drawn[0].value[:, k])
            axes.plot(temperature, soak + level[:, k], 'o', label='measured in a soak', **_POINT)
    panels[0, 0].set_ylabel('bias less the line, µg')
    panels[1, 0].set_ylabel('scale less the line, ppm')
    for axes in panels[1]:
        axes.set_xlabel(_BOARD)
    style.shared_legend(figure, panels[0, 0], 4)
    return figure


def draw_rates(evidence: Evidence) -> Figure:
    """Draw the bias of the angular rate over temperature, less a straight line, with bands."""
    triad = rate_triad(required(evidence.calibration))
    figure = style.new_figure(2.5)
    panels = figure.subplots(1, 3, sharex=True)
    panels[0].set_ylabel('bias less the line, mdeg/s')
    # In the triad of a gyroscope m/s^2 stands for rad/s.
    factor = MICRO_G / MILLIDEGREE
    drawn = [c._replace(value=factor * c.value, sd=factor * c.sd) for c in curves(triad)]
    for i, axes in enumerate(panels):
        axes.set_xlabel(_BOARD)
        _draw_less_line(axes, triad, drawn, i, 'mdeg/s')
    style.shared_legend(figure, panels[0], 3)
    return figure


def _draw_less_line(
    axes: Axes, calibration: Calibration, drawn: list[Curve], k: int, unit: str
) -> None:
    """Draw column `k` of the curves, with bands, less the straight line through the soak."""
    reference, slope = calibration.reference_temperature_c, slopes(drawn[0])[k]
    widest = 0.0
    for curve in drawn:
        line, hatch, marker = _LOOKS[curve.program.name]
        at, color = curve.temperature, line['color']
        value = curve.value[:, k] - slope * (at - reference)
        if calibration.posterior is not None:
            half = BAND_SDS * curve.sd[:, k]
            look: style.Line = {'facecolor': color, 'edgecolor': color, 'hatch': hatch}
            axes.fill_between(at, value - half, value + half, alpha=0.25, linewidth=0, **look)
            widest = max(widest, float(half.max()))
        # Mark the ends of the valid range, so that a range of a few K stays visible.
        look = {'marker': marker, 'markersize': 3.5, 'markevery': [0, -1]}
        axes.plot(at, value, label=curve.program.label, **look, **line)
    title = f'{AXES[k % 3]}: slope {minus(f"{slope:+.3g}")} {unit}/K'
    axes.set_title(f'{title}\n95 % band within ±{number(widest, 2)} {unit}' if widest else title)
    axes.axvline(reference, color=style.GREY, linewidth=0.8)
    axes.locator_params(axis='y', nbins=5)


def soak_measurements(evidence: Evidence) -> tuple[Floats, Floats]:
    """
    Average the residual in each soak of each position. Return temperatures (n,), and the residual
    as an error of the bias [micro-g] and of the scale [ppm], (n, 6). The error of the scale is NaN
    if the force along the axis is below half of gravity.
    """
    windows, residual = evidence.windows, evidence.axis_residuals().get(CHOSEN)
    if windows is None or residual is None:
        return np.zeros(0), np.zeros((0, 6))
    changes = (np.diff(windows.position) != 0) | (np.diff(windows.is_dynamic) != 0)
    soak = np.concatenate(([0], np.cumsum(changes)))[~windows.is_dynamic]
    values = np.column_stack((windows.board, residual, windows.force - residual))
    mean = means_by(soak, values[~windows.is_dynamic])
    error, force = mean[:, 1:4], mean[:, 4:]
    known = np.abs(force) >= 0.5 * windows.gravity
    scale = np.divide(error, force, out=np.full(error.shape, np.nan), where=known)
    return mean[:, 0], np.hstack((error / MICRO_G, scale * 1e6))


def draw_shares(curves: Mapping[str, Floats]) -> Figure:
    """Draw the percentage of units up to each RMS residual [micro-g], for each section."""
    figure = style.new_figure(2.6)
    axes = figure.subplots()
    drawn = {name: np.sort(values[values > 0.0]) for name, values in curves.items()}
    drawn = {name: values for name, values in drawn.items() if len(values)}
    lines = {'raw': style.CORRECTION_LINES['raw'], 'static': style.STATIC_LINE}
    for name, values in drawn.items():
        share = np.arange(1, len(values) + 1) / len(values) * 100.0
        line = lines.get(name, style.DYNAMIC_LINE)
        axes.step(values, share, where='post', label=name, **line)
    low = min((float(values[0]) for values in drawn.values()), default=1.0)
    high = max((float(values[-1]) for values in drawn.values()), default=1.0)
    style.log_axis(axes, low / 1.3, high * 1.3)
    axes.set(ylim=(0.0, 103.0), xlabel='|f| − g of a unit, RMS, µg', ylabel='units, %')
    style.legend_above(axes)
    return figure


def draw_distances(
    labels: Sequence[str], distances: Sequence[Floats], limits: Sequence[float]
) -> Figure:
    """Draw each unit's distance from the fleet's median, by quantity; outliers are diamonds."""
    figure = style.new_figure(0.6 + 0.19 * len(labels))
    axes = figure.subplots()
    known = [limit for limit in limits if np.isfinite(limit)]
    shown = min(max(1.15 * max(known, default=0.0), 4.0), 12.0)
    for row, (z, limit) in enumerate(zip(distances, limits, strict=True)):
        at = np.clip(z, -1.04 * shown, 1.04 * shown)
        is_far = np.abs(z) > limit
        marks = ((~is_far, '|', style.GREY, 6.0), (is_far, 'D', style.RED, 3.5))
        for rows, mark, color, size in marks:
            axes.plot(at[rows], np.full(int(rows.sum()), row), mark, color=color, ms=size)
        for edge in (-limit, limit):
            if abs(edge) < 1.1 * shown:
                axes.plot([edge, edge], [row - 0.5, row + 0.5], color=style.BLACK, linewidth=0.8)
    axes.set_yticks(range(len(labels)), labels)
    axes.set(xlim=(-1.1 * shown, 1.1 * shown), ylim=(len(labels) - 0.4, -0.6))
    axes.set_xlabel('distance from the median, standard deviations')
    return figure
