# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the figures of the unit itself: bias and scale functions, and where its positions point.

"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..typing import Floats
from ..unit.calibration import AXES, AxisReference, AxisSet, Calibration, RegimeSet
from ..unit.gravity import MICRO_G
from .evidence import RAW, Evidence, Position
from .style import (
    DYNAMIC_LINE,
    GREY,
    STATIC_LINE,
    Line,
    Sheet,
    legend_above,
    log_axis,
    new_figure,
)
from .text import number

#: Two-sided 95 % of a normal distribution, in standard deviations.
BAND_SDS = 1.96
_N_CURVE = 61
# Number labels of a dot plot beyond this would overlap.
_MOST_LABELS = 24


def draw_functions(evidence: Evidence, sheet: Sheet) -> Figure:
    """
    Draw the bias and scale functions with their bands over the valid range, per regime.

    """
    calibration = evidence.calibration
    if calibration is None:
        raise ValueError('`evidence` has no calibration')
    rows, columns = (6, 1) if sheet.is_narrow else (2, 3)
    figure = new_figure(sheet, 9.6 if sheet.is_narrow else 4.2)
    panels = np.array(figure.subplots(rows, columns, sharex=True)).reshape(2, 3)
    widest: dict[Axes, float] = {}
    references = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    for i, axis in enumerate(AXES):
        for name, regime_set, line, hatch, marker in _sets(calibration):
            temperature = np.linspace(*regime_set.temperature_range_c, _N_CURVE)
            t = temperature - calibration.reference_temperature_c
            for axes, (value, sd) in zip(
                panels[:, i],
                (
                    bias_curve(regime_set.axes()[i], references[i], t),
                    scale_curve(regime_set.axes()[i], t),
                ),
                strict=True,
            ):
                if sd is not None:
                    _draw_band(axes, temperature, value, BAND_SDS * sd, line, hatch)
                    widest[axes] = max(widest.get(axes, 0.0), BAND_SDS * float(np.max(sd)))
                # The ends of the valid range are marked; a range of a few K stays visible so.
                ends = {'marker': marker, 'markersize': 3.5, 'markevery': [0, -1]}
                axes.plot(temperature, value, label=name, **line, **ends)
        for axes, name, unit in ((panels[0, i], 'bias', 'µg'), (panels[1, i], 'scale', 'ppm')):
            band = f': ±{number(widest[axes], 2)} {unit} at most' if axes in widest else ''
            axes.set_title(f'{name} {axis}{band}')
    for axes in panels.ravel():
        axes.axvline(calibration.reference_temperature_c, color=GREY, linewidth=0.8)
        axes.yaxis.set_major_locator(MaxNLocator(5))
    for axes in panels[0] if sheet.is_narrow else panels[0, :1]:
        axes.set_ylabel('change, µg')
    for axes in panels[1] if sheet.is_narrow else panels[1, :1]:
        axes.set_ylabel('change, ppm')
    bottom = panels[1, 2:] if sheet.is_narrow else panels[1]
    for axes in bottom:
        axes.set_xlabel('T board, °C')
    first = panels[0, 0]
    first.legend(loc='lower left', bbox_to_anchor=(0.0, 1.14), ncols=2)
    return figure


def _sets(calibration: Calibration) -> list[tuple[str, RegimeSet, Line, str, str]]:
    static, dynamic = calibration.regime_sets()
    if static == dynamic:
        return [('both regimes, 95 % band', static, STATIC_LINE, '////', 'o')]
    return [
        ('static, 95 % band', static, STATIC_LINE, '////', 'o'),
        ('dynamic, 95 % band', dynamic, DYNAMIC_LINE, '\\\\\\\\', 's'),
    ]


def _draw_band(
    axes: Axes, temperature: Floats, value: Floats, half: Floats, line: Line, hatch: str
) -> None:
    axes.fill_between(
        temperature,
        value - half,
        value + half,
        facecolor=line['color'],
        edgecolor=line['color'],
        alpha=0.25,
        hatch=hatch,
        linewidth=0,
    )


def bias_curve(
    axis_set: AxisSet, reference: AxisReference, t: Floats
) -> tuple[Floats, Floats | None]:
    """
    Bias of one set against the bias at the reference, at rest thermally.

    Parameters
    ----------
    axis_set : AxisSet
        One axis of one regime.
    reference : AxisReference
        The axis at the reference temperature.
    t : ndarray, shape (n,)
        ``T_board - T_ref`` [K].

    Returns
    -------
    value : ndarray, shape (n,)
        Micro-g.
    sd : ndarray, shape (n,), or None
        Its standard deviation from the parameter covariance; None when that is not known.

    """
    per_micro_g = abs(reference.scale_factor) * MICRO_G
    sign = np.sign(reference.scale_factor)
    value = (axis_set.delta + axis_set.bias_function.value(t)) / per_micro_g * sign
    columns = np.column_stack((np.ones(len(t)), *axis_set.bias_function.basis(t)))
    sd = _sd(axis_set, columns, 0)
    return value, None if sd is None else sd / per_micro_g


def scale_curve(axis_set: AxisSet, t: Floats) -> tuple[Floats, Floats | None]:
    """
    Scale of one set against the scale at the reference, at rest thermally.

    Parameters
    ----------
    axis_set : AxisSet
        One axis of one regime.
    t : ndarray, shape (n,)
        ``T_board - T_ref`` [K].

    Returns
    -------
    value : ndarray, shape (n,)
        Parts per million.
    sd : ndarray, shape (n,), or None
        Its standard deviation; None when that is not known.

    """
    value = (axis_set.scale_function.value(t) - 1.0) * 1e6
    columns = np.column_stack((np.ones(len(t)), *axis_set.scale_function.basis(t)))
    sd = _sd(axis_set, columns, axis_set.n_bias_parameters)
    return value, None if sd is None else sd * 1e6


def _sd(axis_set: AxisSet, columns: Floats, first: int) -> Floats | None:
    if not axis_set.covariance:
        return None
    n = columns.shape[1]
    block = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            block[i, j] = block[j, i] = axis_set.covariance[first + i][first + j]
    return np.asarray(np.sqrt(np.maximum(np.einsum('ni,ij,nj->n', columns, block, columns), 0.0)))


def draw_positions(evidence: Evidence, sheet: Sheet) -> Figure:
    """
    Draw where the positions point on the sphere, and what is left on each of them.

    """
    positions = evidence.positions
    if not positions:
        raise ValueError('`evidence` has no positions')
    if sheet.is_narrow:
        figure = new_figure(sheet, 4.6 + 0.5)
        grid = figure.add_gridspec(2, 2, height_ratios=[1.0, 1.5])
        places = (grid[0, 0], grid[0, 1], grid[1, :])
    else:
        figure = new_figure(sheet, 2.9)
        grid = figure.add_gridspec(1, 3, width_ratios=[1.0, 1.0, 1.25])
        places = (grid[0, 0], grid[0, 1], grid[0, 2])
    for side, place, name in ((1, places[0], 'z up'), (-1, places[1], 'z down')):
        axes = figure.add_subplot(place)
        _draw_hemisphere(axes, positions, side)
        axes.set_title(name, loc='center')
    dots = figure.add_subplot(places[2])
    if evidence.residuals:
        _draw_dots(dots, evidence, sheet)
    else:
        dots.set_axis_off()
    return figure


def equal_area(up: tuple[float, float, float], side: int) -> tuple[float, float]:
    """
    Map a direction of one hemisphere into the unit disc, equal areas to equal areas.

    Parameters
    ----------
    up : tuple of float
        Unit vector.
    side : int
        +1 for the hemisphere of +z, -1 for that of -z.

    Returns
    -------
    x, y : float
        In the disc; the pole is its centre, the equator its rim.

    """
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
    for position in positions:
        if side * position.up[2] >= 0.0 if side > 0 else position.up[2] < 0.0:
            x, y = equal_area(position.up, side)
            axes.plot(x, y, 'o', markersize=4.5, color='black')
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
    both = np.maximum(both, 1e-3)
    log_axis(axes, float(np.min(both)) / 1.4, float(np.max(both)) * 1.4)
    axes.set_ylim(len(positions) + 0.7, 0.3)
    if len(positions) <= _MOST_LABELS:
        axes.set_yticks(numbers)
    else:
        axes.yaxis.set_major_locator(MaxNLocator(12, integer=True))
    axes.set_xlabel('RMS of |g| − g, µg')
    axes.set_ylabel('position')
    legend_above(axes, sheet, share=1.0 if sheet.is_narrow else 0.4)
