# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of the calibration itself: bias and scale, answer to a step, loop, history."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..judging.windows import means_by
from ..thermal.state import Layout as StateLayout
from ..typing import Floats
from ..unit.calibration import AXES, Calibration
from ..unit.correction import Correction
from ..unit.gravity import MICRO_G
from ..unit.gyroscope import MILLIDEGREE
from ..unit.prediction import bias_and_scale, ramp_states, sd_of_states, step_states
from ..unit.rate_triad import rate_triad
from .evidence import CHOSEN, Evidence, given
from .style import (
    AXIS_LINES,
    BLACK,
    DYNAMIC_LINE,
    GREY,
    STATIC_LINE,
    Line,
    Sheet,
    legend_above,
    log_axis,
    new_figure,
    shared_legend,
)
from .text import label_text, minus, number

#: Two-sided 95 % of a normal distribution, in standard deviations.
BAND_SDS = 1.96
_N_CURVE = 61
#: From a few readings to where the longest lag of the bank has forgotten.
_STEP_MINUTES = (0.2, 500.0)
_POINT: Line = {'color': BLACK, 'ms': 3.0, 'mfc': 'none', 'mew': 0.8}


def draw_functions(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw bias and scale over temperature, less a line, with bands and measurements."""
    calibration = given(evidence.calibration)
    rows, columns = (6, 1) if sheet.is_narrow else (2, 3)
    figure = new_figure(sheet, 10.2 if sheet.is_narrow else 4.4)
    panels = np.array(figure.subplots(rows, columns, sharex=True)).reshape(2, 3)
    drawn = curves(calibration)
    soak = drawn[0]
    measured = soak_measurements(evidence)
    for part, (name, unit) in enumerate((('bias', 'µg'), ('scale', 'ppm'))):
        for i, axes in enumerate(panels[part]):
            slope = _draw_less_line(axes, calibration, drawn, (name, i), unit)
            temperature, error = measured.temperature, getattr(measured, name)[:, i]
            if np.isfinite(error).any():
                level = np.interp(temperature, soak.temperature, getattr(soak, name)[:, i])
                line = slope * (temperature - calibration.reference_temperature_c)
                axes.plot(
                    temperature, level - line + error, 'o', label='measured in a soak', **_POINT
                )
            if sheet.is_narrow or not i:
                axes.set_ylabel(f'{name} less the line, {unit}')
            if part and (i == 2 or not sheet.is_narrow):
                axes.set_xlabel('T board, °C')
    shared_legend(figure, panels[0, 0], 1 if sheet.is_narrow else 4)
    return figure


def draw_rates(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw the bias of the angular rate over temperature, less a line, with bands."""
    triad = rate_triad(given(evidence.calibration))
    figure = new_figure(sheet, 5.6 if sheet.is_narrow else 2.5)
    panels = figure.subplots(*((3, 1) if sheet.is_narrow else (1, 3)), sharex=True)
    drawn = curves(triad)
    for i, axes in enumerate(panels):
        # What is said in m/s^2 of a triad is rad/s of this one.
        _draw_less_line(axes, triad, drawn, ('bias', i), 'mdeg/s', MICRO_G / MILLIDEGREE)
        if sheet.is_narrow or not i:
            axes.set_ylabel('bias less the line, mdeg/s')
        if i == 2 or not sheet.is_narrow:
            axes.set_xlabel('T board, °C')
    shared_legend(figure, panels[0], 1 if sheet.is_narrow else 3)
    return figure


def _draw_less_line(
    axes: Axes,
    calibration: Calibration,
    drawn: list[Curve],
    part: tuple[str, int],
    unit: str,
    factor: float = 1.0,
) -> float:
    """Draw the curves of one axis, with bands, less the line of the soak; give its slope."""
    name, i = part
    reference = calibration.reference_temperature_c
    # All curves are 0 in a soak at the reference, and so is the line.
    soak = factor * getattr(drawn[0], name)[:, i]
    slope = float(np.polyfit(drawn[0].temperature, soak, 1)[0])
    widest = 0.0
    for curve in drawn:
        value = factor * getattr(curve, name)[:, i] - slope * (curve.temperature - reference)
        if calibration.posterior is not None:
            half = BAND_SDS * factor * getattr(curve, f'sd_{name}')[:, i]
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
            widest = max(widest, float(half.max()))
        # The ends of the valid range are marked; a range of a few K stays visible so.
        look: Line = {'marker': curve.marker, 'markersize': 3.5, 'markevery': [0, -1]}
        axes.plot(curve.temperature, value, label=curve.name, **look, **curve.line)
    title = f'{AXES[i]}: {minus(f"{slope:+.3g}")} {unit}/K'
    axes.set_title(f'{title}, ±{number(widest, 2)} {unit}' if widest else title)
    axes.axvline(reference, color=GREY, linewidth=0.8)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    return slope


@dataclass(frozen=True)
class SoakMeasurements:
    """
    What each soak of each position measured against the calibration, shapes (n,) and (n, 3).

    Bias [micro-g] and scale [ppm] as if all of the residual were one of them; the scale is NaN of
    an axis that has less than half of gravity.
    """

    temperature: Floats
    bias: Floats
    scale: Floats


def soak_measurements(evidence: Evidence) -> SoakMeasurements:
    """Average what is left over each soak of each position: its windows in the static regime."""
    windows, residual = evidence.windows, evidence.axis_residuals().get(CHOSEN)
    if windows is None or residual is None:
        return SoakMeasurements(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    changes = (np.diff(windows.position) != 0) | (np.diff(windows.is_dynamic) != 0)
    soak = np.concatenate(([0], np.cumsum(changes)))[~windows.is_dynamic]
    values = np.column_stack((windows.board, residual, windows.force - residual))
    mean = means_by(soak, values[~windows.is_dynamic])
    error, force = mean[:, 1:4], mean[:, 4:]
    known = np.abs(force) >= 0.5 * windows.gravity
    scale = np.divide(error, force, out=np.full(error.shape, np.nan), where=known)
    return SoakMeasurements(mean[:, 0], error / MICRO_G, scale * 1e6)


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
    """Evaluate a soak and, where they differ, ramps at half of the fastest rate."""
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


def draw_step(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw what a step of the temperature does to each axis over time."""
    calibration = given(evidence.calibration)
    minutes, bias, scale = step_answer(calibration)
    figure = new_figure(sheet, 4.4 if sheet.is_narrow else 2.5)
    panels = figure.subplots(*((2, 1) if sheet.is_narrow else (1, 2)))
    for axes, value, unit in ((panels[0], bias, 'µg'), (panels[1], scale, 'ppm')):
        for i, axis in enumerate(AXES):
            axes.plot(minutes, value[:, i], label=axis, **AXIS_LINES[i])
        axes.axhline(0.0, color='black', linewidth=0.5)
        log_axis(axes, float(minutes[0]), float(minutes[-1]))
        axes.set_ylabel(f'still to come, {unit}/K')
        axes.set_xlabel('time since the step, min')
        title = 'bias' if axes is panels[0] else 'scale'
        legend_above(axes, sheet, share=0.5, title=title, alignment='left')
    return figure


def step_answer(calibration: Calibration) -> tuple[Floats, Floats, Floats]:
    """
    Evaluate what is still to come of bias and scale after a step by 1 K up to the reference.

    Returns the minutes since the step, bias [micro-g] and scale [ppm], shapes (n, 3).
    """
    minutes = np.geomspace(*_STEP_MINUTES, _N_CURVE)
    since_s = np.append(minutes * 60.0, np.inf)
    states = step_states(calibration, calibration.reference_temperature_c, since_s)
    bias, scale = bias_and_scale(calibration, states)
    return minutes, (bias[:-1] - bias[-1]) / MICRO_G, (scale[:-1] / scale[-1] - 1.0) * 1e6


def draw_hysteresis(evidence: Evidence, sheet: Sheet) -> Figure:
    """Draw the loop of each axis' bias in a slow run through the range and back."""
    temperature, heating, cooling = hysteresis_loop(given(evidence.calibration))
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
    shared_legend(figure, panels[0], 2)
    return figure


def hysteresis_loop(calibration: Calibration) -> tuple[Floats, Floats, Floats]:
    """
    Evaluate the bias in a run through the range and back that is too slow for any lag.

    Returns the temperatures, and the bias on the way up and down [micro-g], shapes (n, 3).
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
