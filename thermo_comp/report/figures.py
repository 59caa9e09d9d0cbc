# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the figures of bags over time (like Fig. 3, 4, 6 and 7 of Golovach's paper) and by position,
of a calibration over temperature, and of a fleet.
"""

from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from ..thermal.regime import Regime
from ..typing import Bools, Floats
from ..unit.calibration import AXES, Calibration, rate_triad
from ..unit.gravity import MICRO_G, ug_text
from ..unit.metrics import means_by, statistics_by_regime
from ..unit.rate_bias import MILLIDEGREE
from . import style
from .certificate import Curve, curves, slopes
from .evidence import CHOSEN, LEFT_OUT, RAW, Evidence, Position, ShownBag, required
from .style import minus, number

# Duration from the start of a position [s]; drift is a reading less the mean reading in it.
_ZERO_S = 120.0
_SHADE = '#E9E9E9'
# Diameter of the ring of the position with the largest residual [pt].
_RING = 22.0
# Largest number of rows, one for each position, in `draw_every_position`.
_MOST = 24
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
_LABEL: style.Line = {'textcoords': 'offset points', 'fontsize': 7.5}


def draw_temperatures(evidence: Evidence) -> Figure:
    """Draw the readings of case and board thermometer (Fig. 3 of Golovach's paper)."""
    figure, (axes,), shown, unit = _panels(evidence, [2.5])
    for label, readings, line in (
        ('T case', shown.bag.case, style.CASE_LINE),
        ('T board', shown.bag.board, style.BOARD_LINE),
    ):
        if len(readings.value):
            seconds = (readings.stamp_ns - shown.start_ns) * 1e-9
            axes.plot(seconds / unit, readings.value, label=label, **line)
    axes.set_ylabel('temperature, °C')
    style.legend_above(axes)
    return figure


def draw_dynamics(evidence: Evidence) -> Figure:
    """Draw drift, derivatives of the temperatures, and regime flag (Golovach's Fig. 4 a, b, c)."""
    drift, name = _drift(evidence)
    heights = [1.725] * bool(len(drift)) + [1.495, 1.15, 0.8625]
    figure, panels, shown, unit = _panels(evidence, heights, is_flagged=True)
    if len(drift):
        panels[0].set_prop_cycle(style.AXIS_CYCLE)
        _plot(panels[0], evidence, drift, unit, label=AXES)
        panels[0].set_ylabel(name)
        style.legend_above(panels[0], 'a  drift of the readings in each position')
    rates, second, flag = panels[-3:]
    for label, rate, line in (
        ('dT case/dt', shown.case_rate, style.CASE_LINE),
        ('dT board/dt', shown.board_rate, style.BOARD_LINE),
    ):
        if np.isfinite(rate).any():
            rates.plot(shown.time / unit, rate * 60.0, label=label, **line)
    rates.set_ylabel('K/min')
    style.legend_above(rates, 'b  first derivatives')
    line = style.CASE_LINE if shown.leader == 'case' else style.BOARD_LINE
    second.plot(shown.time / unit, shown.acceleration * 3600.0, **line)
    second.set(ylabel='K/min²', title=f'second derivative of T {shown.leader}')
    second.locator_params(axis='y', nbins=4)
    _draw_flag(flag, shown, unit)
    figure.align_ylabels(panels[:-1])
    return figure


def draw_residuals(evidence: Evidence) -> Figure:
    """Draw the residual of each axis, without and with the calibration (Golovach's Fig. 6)."""
    residuals = evidence.axis_residuals()
    rows = _rows(evidence)
    dynamic = required(evidence.windows).is_dynamic[rows]
    figure, panels, _, unit = _panels(evidence, [1.05] * len(residuals), more=0.5)
    for axes, (name, residual) in zip(panels, residuals.items(), strict=True):
        axes.set_prop_cycle(style.AXIS_CYCLE)
        _plot(axes, evidence, residual / MICRO_G, unit, label=AXES)
        axes.set_ylabel('µg')
        axes.axhline(0.0, color='black', linewidth=0.5)
        axes.locator_params(axis='y', nbins=5)
        if name != RAW:
            _symmetric(axes, residual[rows])
        stats = statistics_by_regime(residual[rows], dynamic)
        del stats['all']
        parts = [f'{name} {number(stat.rms / MICRO_G)}' for name, stat in stats.items() if stat.n]
        title = f'{name}: RMS {", ".join(parts)} µg'
        if axes is panels[0]:
            style.legend_above(axes, title)
        else:
            axes.set_title(title)
    figure.align_ylabels(panels)
    return figure


def draw_gravity(evidence: Evidence) -> Figure:
    """Draw |f| - g over time: raw and corrected, then corrected alone (Golovach's Fig. 7)."""
    residuals = evidence.residuals
    corrected = [name for name in residuals if name != RAW]
    sets = [forces for forces in (list(residuals), corrected) if forces]
    figure, panels, _, unit = _panels(evidence, [1.6] * len(sets), more=0.4)
    for axes, drawn in zip(panels, sets, strict=True):
        for name in drawn:
            value = residuals[name] / MICRO_G
            _plot(axes, evidence, value, unit, label=name, **style.CORRECTION_LINES[name])
        axes.axhline(0.0, color='black', linewidth=0.5)
        axes.set_ylabel('|f| − g, µg')
        style.legend_above(axes)
    for name in corrected:
        _symmetric(panels[-1], residuals[name][_rows(evidence)])
    return figure


def _panels(
    evidence: Evidence, heights: Sequence[float], *, more: float = 0.0, is_flagged: bool = False
) -> tuple[Figure, list[Axes], ShownBag, float]:
    """
    Return a figure, its panels over time, the bag that they show, and the unit of time [s].
    `more`: height besides the panels [in]; `is_flagged`: the last panel has the flag, not shaded.
    """
    shown = required(evidence.shown)
    unit, name = style.time_unit(shown.duration_s)
    figure = style.new_figure(more + sum(heights))
    panels = figure.subplots(len(heights), sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    # Shade adjoining heating and cooling as one span, without a bright line between.
    for regime, run in groupby(shown.stretches, key=attrgetter('regime')):
        start, *_, stop = (edge / unit for stretch in run for edge in stretch[:2])
        if regime == Regime.DYNAMIC:
            for axes in panels[:-1] if is_flagged else panels:
                axes.axvspan(start, stop, color=_SHADE, lw=0, zorder=0)
    panels[-1].set(xlabel=name, xlim=(0.0, shown.duration_s / unit))
    return figure, list(panels), shown, unit


def _rows(evidence: Evidence) -> Bools:
    """Select the windows of the shown bag."""
    return np.asarray(required(evidence.windows).bag == required(evidence.shown).index)


def _plot(axes: Axes, evidence: Evidence, value: Floats, unit: float, **line: Any) -> None:
    """Draw one value per window of the shown bag over time, with gaps between positions."""
    windows, rows = required(evidence.windows), _rows(evidence)
    time, value = style.broken(windows.time[rows], value[rows], windows.position[rows])
    axes.plot(time / unit, value, **line)


def _drift(evidence: Evidence) -> tuple[Floats, str]:
    """Return the drift of the readings from each position's start, shape (n, 3), and its unit."""
    windows = evidence.windows
    if windows is None or not _rows(evidence).any():
        return np.zeros((0, 3)), ''
    _, first, place = np.unique(windows.position, return_index=True, return_inverse=True)
    begin = windows.time <= windows.time[first][place] + _ZERO_S
    drift = windows.mean - means_by(place[begin], windows.mean[begin])[place]
    if evidence.calibration is not None:
        K = [axis.scale_factor for axis in evidence.calibration.axes]
        return drift / K / MICRO_G, 'µg'
    return (drift / MICRO_G, 'µg') if evidence.is_imu else (drift, 'counts')


def _draw_flag(axes: Axes, shown: ShownBag, unit: float) -> None:
    times: list[float] = []
    levels: list[float] = []
    for stretch in shown.stretches:
        span = [stretch.start / unit, stretch.stop / unit]
        if stretch.regime == Regime.UNKNOWN:
            axes.axvspan(*span, fill=False, hatch='---', edgecolor='#999999', lw=0)
            continue
        level = float(stretch.direction)  # +1 heating, -1 cooling, 0 static regime
        times += span
        levels += [level, level]
        if level:
            hatch = '////' if level > 0.0 else '\\\\\\\\'
            look: Any = {'facecolor': _SHADE, 'edgecolor': '#777777', 'hatch': hatch, 'lw': 0}
            axes.fill_between(span, [level, level], **look)
    axes.plot(times, levels, color='black', linewidth=1.3)
    axes.set(ylim=(-1.35, 1.35), title='c  regime flag S')
    axes.set_yticks([-1, 0, 1], ['S = 1, cooling', 'S = 0, static', 'S = 1, heating'])
    axes.grid(visible=False, axis='x')


def _symmetric(axes: Axes, residual: Floats) -> None:
    """Centre a panel on zero; isolated spikes may be cut off."""
    limit = 1.15 * float(np.quantile(np.abs(residual), 0.998)) / MICRO_G
    if limit > 0.0:
        axes.set_ylim(-limit, limit)


def draw_every_position(evidence: Evidence) -> Figure:
    """Draw |f| - g over time in every position, or in the positions with the largest residuals."""
    windows = required(evidence.windows)
    judged, residual = list(evidence.residuals.items())[-1]
    worst = sorted(evidence.positions, key=lambda place: -place.residual_rms[judged])[:_MOST]
    shown = sorted(worst, key=lambda place: place.number)
    numbers = np.unique(windows.position)
    limit = float(np.quantile(np.abs(residual), 0.998)) * 1.15
    unit, name = style.time_unit(max(position.duration_s for position in shown))
    figure = style.new_figure(0.8 + 0.24 * len(shown))
    axes = figure.subplots()
    for row, position in enumerate(shown):
        rows = windows.position == numbers[position.number - 1]
        time = (windows.time[rows] - windows.time[rows][0]) / unit
        value = row - 0.5 * residual[rows] / limit
        dynamic = windows.is_dynamic[rows]
        axes.axhline(row, color='black', linewidth=0.4)
        # The lines of the regimes differ in width, because dashes would hide noise.
        for is_drawn, color, width in ((~dynamic, style.BLACK, 1.4), (dynamic, style.RED, 0.7)):
            axes.plot(time, np.where(is_drawn, value, np.nan), color=color, linewidth=width)
    axes.set_yticks(range(len(shown)), [str(position.number) for position in shown])
    right = axes.secondary_yaxis('right')
    right.set_yticks(
        range(len(shown)), [number(position.residual_rms[judged] / MICRO_G) for position in shown]
    )
    right.set_ylabel('RMS, µg')
    axes.set(xlabel=name, ylabel='position', xlim=(0.0, None), ylim=(len(shown) - 0.4, -0.6))
    part = f'; the {_MOST} with the largest RMS' if len(evidence.positions) > _MOST else ''
    axes.set_title(f'{judged}: a row is ±{number(limit / MICRO_G, 2)} µg high{part}')
    return figure


def draw_positions(evidence: Evidence) -> Figure:
    """Draw the directions of the positions on the sphere, and the residual of each position."""
    figure = style.new_figure(3.0)
    up, down = figure.subplots(1, 2)
    axis = evidence.least_known
    judged = LEFT_OUT if evidence.left_out else next(reversed(evidence.residuals), RAW)
    for side, axes, name in ((1, up, 'z up'), (-1, down, 'z down')):
        _draw_hemisphere(axes, evidence.positions, side, judged)
        if axis is not None and (axis.up[2] >= 0.0) == (side > 0):
            place = equal_area(axis.up, side)
            axes.plot(*place, 'x', markersize=7.0, color=style.RED, mew=1.6)
            text = '±' + ug_text(axis.sd_m_s2).replace('ug', 'µg')
            # Shift the label towards the centre of the disc, as axis names are outside the disc.
            by = (0.0, 6.0 if place[1] < 0.0 else -12.0)
            axes.annotate(text, place, by, ha='center', color=style.RED, **_LABEL)
        axes.set_title(name, loc='center')
    return figure


def equal_area(up: tuple[float, ...], side: int) -> tuple[float, float]:
    """Map a direction of a hemisphere into the unit disc around the pole, preserving areas."""
    x, y, z = up
    factor = 1.0 / np.sqrt(1.0 + max(side * z, 0.0))
    return float(x * factor), float(y * factor)


def _draw_hemisphere(axes: Axes, positions: tuple[Position, ...], side: int, judged: str) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    axes.plot(np.cos(angle), np.sin(angle), color='black', linewidth=0.8)
    # Radius of the circle at an elevation of 45 degrees, in the projection of `equal_area`.
    ring = np.sqrt(1.0 - np.sin(np.pi / 4.0))
    lines = (ring * np.cos(angle), ring * np.sin(angle)), ([-1, 1], [0, 0]), ([0, 0], [-1, 1])
    for line in lines:
        axes.plot(*line, color='#BBBBBB', linewidth=0.6)
    for label, x, y in (('+x', 1.2, 0), ('−x', -1.2, 0), ('+y', 0, 1.2), ('−y', 0, -1.2)):
        axes.text(x, y, label, ha='center', va='center', color='#555555', fontsize=7.5)
    largest = max((p.residual_rms.get(judged, 0.0) for p in positions), default=0.0)
    for position in positions:
        if (position.up[2] >= 0.0) == (side > 0):
            place = equal_area(position.up, side)
            axes.plot(*place, 'o', markersize=4.5, color='black')
            if largest > 0.0:
                size = _RING * np.sqrt(position.residual_rms.get(judged, 0.0) / largest)
                axes.plot(*place, 'o', markersize=size, mfc='none', mec=style.RED, mew=1.1)
            axes.annotate(str(position.number), place, (3.5, 2.5), **_LABEL)
    axes.set(xlim=(-1.32, 1.32), ylim=(-1.32, 1.32), aspect='equal')
    axes.set_axis_off()


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
    """Draw column `k` of the curves, with bands, less the line fitted to the curve of the soak."""
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
    as an error of the bias [micro-g] and as an error of the scale [ppm], (n, 6). The error of the
    scale is NaN if the force along the axis is below half of gravity.
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
    """Draw the cumulative distribution of the units' RMS residual [micro-g], for each section."""
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
    axes.set(xscale='log', xlim=(low / 1.3, high * 1.3))
    subs = (1.0, 2.0, 5.0) if high * 1.3 < 50.0 * (low / 1.3) else (1.0,)
    axes.xaxis.set_major_locator(LogLocator(subs=subs))
    axes.xaxis.set_major_formatter(lambda value, _: f'{value:g}')
    axes.xaxis.set_minor_formatter('')
    axes.set(ylim=(0.0, 103.0), xlabel='|f| − g of a unit, RMS, µg', ylabel='units, %')
    style.legend_above(axes)
    return figure


def draw_distances(
    labels: Sequence[str], distances: Sequence[Floats], limits: Sequence[float]
) -> Figure:
    """Draw each unit's distance from the fleet's median, by quantity; outliers are diamonds."""
    figure = style.new_figure(0.6 + 0.19 * len(labels))
    axes = figure.subplots()
    finite = [limit for limit in limits if np.isfinite(limit)]
    shown = min(max(1.15 * max(finite, default=0.0), 4.0), 12.0)
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
