# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of the unit itself: bias, scale, answer to a step, and its positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..thermal.state import Layout as StateLayout
from ..typing import Floats
from ..unit.calibration import AXES, Calibration
from ..unit.correction import Correction
from ..unit.gravity import MICRO_G
from ..unit.prediction import bias_and_scale, ramp_states, sd_of_states, step_states
from .evidence import LEFT_OUT, RAW, Evidence, Position
from .style import (
    AXIS_LINES,
    DYNAMIC_LINE,
    GREY,
    RED,
    STATIC_LINE,
    Line,
    Sheet,
    legend_above,
    log_axis,
    new_figure,
)
from .text import label_text, number

#: Two-sided 95 % of a normal distribution, in standard deviations.
BAND_SDS = 1.96
_N_CURVE = 61
#: From a few readings to where the longest lag of the bank has forgotten.
_STEP_MINUTES = (0.2, 500.0)
# Diameter of the ring of the position that the others tell the least of [pt].
_RING = 22.0
# Number labels of a dot plot beyond this would overlap.
_MOST_LABELS = 24


def _calibration(evidence: Evidence) -> Calibration:
    if evidence.calibration is None:
        raise ValueError('`evidence` has no calibration')
    return evidence.calibration


def draw_functions(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw bias and scale over temperature in a soak and in ramps, with their bands."""
    calibration = _calibration(evidence)
    rows, columns = (6, 1) if sheet.is_narrow else (2, 3)
    figure = new_figure(sheet, 9.6 if sheet.is_narrow else 4.2)
    panels = np.array(figure.subplots(rows, columns, sharex=True)).reshape(2, 3)
    widest = np.zeros((2, 3))
    for curve in curves(calibration):
        for part, (value, sd) in enumerate(
            ((curve.bias, curve.sd_bias), (curve.scale, curve.sd_scale))
        ):
            for i, axes in enumerate(panels[part]):
                if calibration.posterior is not None:
                    _draw_band(axes, curve, value[:, i], BAND_SDS * sd[:, i])
                    widest[part, i] = max(widest[part, i], BAND_SDS * float(sd[:, i].max()))
                # The ends of the valid range are marked; a range of a few K stays visible so.
                axes.plot(
                    curve.temperature,
                    value[:, i],
                    label=curve.name,
                    markersize=3.5,
                    markevery=[0, -1],
                    marker=curve.marker,
                    **curve.line,
                )
    for part, (name, unit) in enumerate((('bias', 'µg'), ('scale', 'ppm'))):
        for i, axes in enumerate(panels[part]):
            band = f': ±{number(widest[part, i], 2)} {unit} at most' if widest[part, i] else ''
            axes.set_title(f'{name} {AXES[i]}{band}')
            axes.axvline(calibration.reference_temperature_c, color=GREY, linewidth=0.8)
            axes.yaxis.set_major_locator(MaxNLocator(5))
            if sheet.is_narrow or not i:
                axes.set_ylabel(f'change, {unit}')
            if part and (i == 2 or not sheet.is_narrow):
                axes.set_xlabel('T board, °C')
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper left', ncols=1 if sheet.is_narrow else 3)
    return figure


@dataclass(frozen=True)
class Curve:
    """
    Bias [micro-g] and scale [ppm] over the board temperature in one thermal state, against a soak
    at the reference, shapes (n, 3); line, hatch and marker are how it is drawn.
    """

    name: str
    line: Line
    hatch: str
    marker: str
    temperature: Floats
    bias: Floats
    sd_bias: Floats
    scale: Floats
    sd_scale: Floats


def curves(calibration: Calibration) -> list[Curve]:
    """
    Evaluate a calibration in a soak, and in ramps through its range at half of the fastest rate.

    The soak alone where ramps make no difference.
    """
    static, dynamic = calibration.regime_sets()
    looks = [('soak', static, 0.0, STATIC_LINE, '////', 'o')]
    cooling, heating = (round(edge / 2.0, 1) for edge in dynamic.rate_range_k_min)
    if calibration.response or static != dynamic:
        for word, rate, line, hatch, marker in (
            ('heating', heating, DYNAMIC_LINE, '\\\\\\\\', '^'),
            ('cooling', cooling, AXIS_LINES[2], '....', 'v'),
        ):
            if rate:
                name = f'{word} at {abs(rate):g} K/min'
                looks.append((name, dynamic, rate / 60.0, line, hatch, marker))
    reference = np.array([calibration.reference_temperature_c])
    bias_0, scale_0 = bias_and_scale(calibration, ramp_states(calibration, reference, 0.0, 0.0))
    found = []
    for name, part, rate, line, hatch, marker in looks:
        lower, upper = part.temperature_range_c
        temperature = np.linspace(lower, upper, _N_CURVE)
        begun = lower if rate > 0.0 else upper
        lasted_s = (temperature - begun) / rate if rate else 0.0
        states = ramp_states(calibration, temperature, rate, lasted_s)
        bias, scale = bias_and_scale(calibration, states)
        sd = sd_of_states(calibration, states)
        found.append(
            Curve(
                name,
                line,
                hatch,
                marker,
                temperature,
                (bias - bias_0) / MICRO_G,
                sd.bias / MICRO_G,
                (scale / scale_0 - 1.0) * 1e6,
                sd.scale * 1e6,
            )
        )
    return found


def _draw_band(axes: Axes, curve: Curve, value: Floats, half: Floats) -> None:
    axes.fill_between(
        curve.temperature,
        value - half,
        value + half,
        facecolor=curve.line['color'],
        edgecolor=curve.line['color'],
        alpha=0.25,
        hatch=curve.hatch,
        linewidth=0,
    )


def draw_step(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw what a step of the temperature does to each axis over time."""
    calibration = _calibration(evidence)
    minutes, bias, scale = step_answer(calibration)
    figure = new_figure(sheet, 4.4 if sheet.is_narrow else 2.5)
    panels = figure.subplots(*((2, 1) if sheet.is_narrow else (1, 2)))
    for axes, value, unit in ((panels[0], bias, 'µg'), (panels[1], scale, 'ppm')):
        for i, axis in enumerate(AXES):
            axes.plot(minutes, value[:, i], label=axis, **AXIS_LINES[i])
        axes.axhline(0.0, color='black', linewidth=0.5)
        log_axis(axes, float(minutes[0]), float(minutes[-1]))
        axes.set_ylabel(f'per K, {unit}')
        axes.set_xlabel('time since the step, min')
        title = 'bias' if axes is panels[0] else 'scale'
        legend_above(axes, sheet, share=0.5, title=title, alignment='left')
    return figure


def step_answer(calibration: Calibration) -> tuple[Floats, Floats, Floats]:
    """
    Evaluate what a step of board and case by 1 K, up to the reference, leaves to come.

    Returns the minutes since the step, and bias [micro-g] and scale [ppm] less those of the soak
    at the end, shapes (n, 3).
    """
    minutes = np.geomspace(*_STEP_MINUTES, _N_CURVE)
    since_s = np.append(minutes * 60.0, np.inf)
    states = step_states(calibration, calibration.reference_temperature_c, since_s)
    bias, scale = bias_and_scale(calibration, states)
    return minutes, (bias[:-1] - bias[-1]) / MICRO_G, (scale[:-1] / scale[-1] - 1.0) * 1e6


def draw_hysteresis(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw the loop of each axis' bias in a slow run through the range and back."""
    temperature, heating, cooling = hysteresis_loop(_calibration(evidence))
    figure = new_figure(sheet, 5.6 if sheet.is_narrow else 2.5)
    panels = figure.subplots(*((3, 1) if sheet.is_narrow else (1, 3)), sharex=True, sharey=True)
    for i, axes in enumerate(panels):
        middle = (heating[:, i] + cooling[:, i]) / 2.0
        for name, bias, line, marker in (
            ('heating', heating, DYNAMIC_LINE, '^'),
            ('cooling', cooling, AXIS_LINES[2], 'v'),
        ):
            loop = bias[:, i] - middle
            axes.plot(
                temperature, loop, label=name, marker=marker, markevery=12, markersize=3.5, **line
            )
        axes.set_title(f'bias {AXES[i]}')
        axes.axhline(0.0, color='black', linewidth=0.5)
        if sheet.is_narrow or not i:
            axes.set_ylabel('loop, µg')
        if i == 2 or not sheet.is_narrow:
            axes.set_xlabel('T board, °C')
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper left', ncols=2)
    return figure


def hysteresis_loop(calibration: Calibration) -> tuple[Floats, Floats, Floats]:
    """
    Evaluate the bias in a run through the static range and back that is too slow for any lag.

    Returns the temperatures, and the bias on the way up and down [micro-g], shapes (n, 3). Each
    play begins at the end that the way before has pushed it to.
    """
    lower, upper = calibration.static.temperature_range_c
    temperature = np.linspace(lower, upper, _N_CURVE)
    plays = StateLayout(Correction(calibration).memory).plays
    ways = []
    for sign, travelled in ((1.0, temperature - lower), (-1.0, upper - temperature)):
        states = ramp_states(calibration, temperature, 0.0, 0.0)
        for (_, width), place in plays.items():
            states[:, place] = sign * np.maximum(width - travelled, -width)
        ways.append(bias_and_scale(calibration, states)[0] / MICRO_G)
    return temperature, ways[0], ways[1]


def draw_history(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw bias and scale of each calibration of the unit against the first one, by date."""
    history = evidence.history
    figure = new_figure(sheet, 4.8 if sheet.is_narrow else 2.6)
    panels = figure.subplots(*((2, 1) if sheet.is_narrow else (1, 2)))
    places = np.arange(len(history))
    for axes, name, unit in ((panels[0], 'bias', 'µg'), (panels[1], 'scale', 'ppm')):
        value, sd = (
            np.array([getattr(one, key) for one in history]) for key in (name, f'{name}_sd')
        )
        for i, (axis, marker) in enumerate(zip(AXES, 'os^', strict=True)):
            axes.errorbar(
                places + 0.08 * (i - 1),
                value[:, i] - value[0, i],
                yerr=BAND_SDS * np.nan_to_num(sd[:, i]),
                marker=marker,
                markersize=3.5,
                capsize=2.0,
                label=axis,
                **AXIS_LINES[i],
            )
        axes.axhline(0.0, color='black', linewidth=0.5)
        axes.set_xticks(places, [label_text(one.created[:10]) for one in history])
        axes.set_ylabel(f'change, {unit}')
        legend_above(axes, sheet, share=0.5, title=name, alignment='left')
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
    Map a direction of one hemisphere (side +1 of +z, -1 of -z) into the unit disc, equal areas to
    equal areas: the pole is its centre, the equator its rim.
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
    if len(positions) <= _MOST_LABELS:
        axes.set_yticks(numbers)
    else:
        axes.yaxis.set_major_locator(MaxNLocator(12, integer=True))
    axes.set_xlabel('RMS of |g| − g, µg')
    axes.set_ylabel('position')
    legend_above(axes, sheet, share=1.0 if sheet.is_narrow else 0.4)
