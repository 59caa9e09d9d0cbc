# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the figures of the calibration itself: bias and scale, answer to a step, loop, history."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..judging.windows import means_by
from ..thermal.state import Layout as StateLayout
from ..typing import Floats
from ..unit.calibration import AXES, Calibration
from ..unit.correction import Correction
from ..unit.gravity import MICRO_G
from ..unit.gyroscope import MILLIDEGREE
from ..unit.prediction import bias_and_scale, ramp_states, sd_of_states, step_states
from ..unit.rate_triad import rate_triad
from . import style
from .evidence import CHOSEN, Evidence, given
from .html import label_text, minus, number

#: Two-sided 95 % of a normal distribution, in standard deviations.
BAND_SDS = 1.96
_N_CURVE = 61
#: From a few readings to where the longest lag of the bank has forgotten.
_STEP_MINUTES = (0.2, 500.0)
_POINT: style.Line = {'color': style.BLACK, 'ms': 3.0, 'mfc': 'none', 'mew': 0.8}


def draw_functions(evidence: Evidence) -> Figure:
    """Draw bias and scale over temperature, less a line, with bands and measurements."""
    calibration = given(evidence.calibration)
    figure = style.new_figure(4.4)
    panels = figure.subplots(2, 3, sharex=True)
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
                left = level - line + error
                axes.plot(temperature, left, 'o', label='measured in a soak', **_POINT)
        panels[part, 0].set_ylabel(f'{name} less the line, {unit}')
    for axes in panels[1]:
        axes.set_xlabel('T board, °C')
    style.shared_legend(figure, panels[0, 0], 4)
    return figure


def draw_rates(evidence: Evidence) -> Figure:
    """Draw the bias of the angular rate over temperature, less a line, with bands."""
    triad = rate_triad(given(evidence.calibration))
    figure, panels = _axis_panels('bias less the line, mdeg/s')
    drawn = curves(triad)
    for i, axes in enumerate(panels):
        # What is said in m/s^2 of a triad is rad/s of this one.
        _draw_less_line(axes, triad, drawn, ('bias', i), 'mdeg/s', MICRO_G / MILLIDEGREE)
    style.shared_legend(figure, panels[0], 3)
    return figure


def _axis_panels(name: str, *, sharey: bool = False) -> tuple[Figure, list[Axes]]:
    """Make a panel for each axis, over the board temperature."""
    figure = style.new_figure(2.5)
    panels = list(figure.subplots(1, 3, sharex=True, sharey=sharey))
    panels[0].set_ylabel(name)
    for axes in panels:
        axes.set_xlabel('T board, °C')
    return figure, panels


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
        at, color = curve.temperature, curve.line['color']
        value = factor * getattr(curve, name)[:, i] - slope * (at - reference)
        if calibration.posterior is not None:
            half = BAND_SDS * factor * getattr(curve, f'sd_{name}')[:, i]
            look: style.Line = {'facecolor': color, 'edgecolor': color, 'hatch': curve.hatch}
            axes.fill_between(at, value - half, value + half, alpha=0.25, linewidth=0, **look)
            widest = max(widest, float(half.max()))
        # The ends of the valid range are marked; a range of a few K stays visible so.
        look = {'marker': curve.marker, 'markersize': 3.5, 'markevery': [0, -1]}
        axes.plot(at, value, label=curve.name, **look, **curve.line)
    title = f'{AXES[i]}: {minus(f"{slope:+.3g}")} {unit}/K'
    axes.set_title(f'{title}, ±{number(widest, 2)} {unit}' if widest else title)
    axes.axvline(reference, color=style.GREY, linewidth=0.8)
    style.few_ticks(axes)
    return slope


class SoakMeasurements(NamedTuple):
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


class Curve(NamedTuple):
    """
    Bias [micro-g] and scale [ppm] over the board temperature in one thermal state, against a soak
    at the reference, shapes (n, 3); line, hatch and marker are how it is drawn.
    """

    name: str
    line: style.Line
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
    looks = [('soak', static, 0.0, style.STATIC_LINE, '////', 'o')]
    cooling, heating = (round(edge / 2.0, 1) for edge in dynamic.rate_range_k_min)
    if calibration.response or static != dynamic:
        for word, rate, line, hatch, marker in (
            ('heating', heating, style.DYNAMIC_LINE, '\\\\\\\\', '^'),
            ('cooling', cooling, style.AXIS_LINES[2], '....', 'v'),
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
        sd_bias, sd_scale = sd_of_states(calibration, states)
        bias, sd_bias = (bias - bias_0) / MICRO_G, sd_bias / MICRO_G
        look, scale = (line, hatch, marker), (scale / scale_0 - 1.0) * 1e6
        found.append(Curve(name, *look, temperature, bias, sd_bias, scale, sd_scale * 1e6))
    return found


def draw_step(evidence: Evidence) -> Figure:
    """Draw what a step of the temperature does to each axis over time."""
    minutes, bias, scale = step_answer(given(evidence.calibration))
    figure = style.new_figure(2.5)
    for axes, title, value, unit in zip(
        figure.subplots(1, 2), ('bias', 'scale'), (bias, scale), ('µg', 'ppm'), strict=True
    ):
        for i, axis in enumerate(AXES):
            axes.plot(minutes, value[:, i], label=axis, **style.AXIS_LINES[i])
        axes.axhline(0.0, color='black', linewidth=0.5)
        style.log_axis(axes, float(minutes[0]), float(minutes[-1]))
        axes.set_ylabel(f'still to come, {unit}/K')
        axes.set_xlabel('time since the step, min')
        style.legend_above(axes, share=0.5, title=title, alignment='left')
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


def draw_hysteresis(evidence: Evidence) -> Figure:
    """Draw the loop of each axis' bias in a slow run through the range and back."""
    temperature, heating, cooling = hysteresis_loop(given(evidence.calibration))
    figure, panels = _axis_panels('loop, µg', sharey=True)
    for i, axes in enumerate(panels):
        middle = (heating[:, i] + cooling[:, i]) / 2.0
        for name, bias, line, marker in (
            ('heating', heating, style.DYNAMIC_LINE, '^'),
            ('cooling', cooling, style.AXIS_LINES[2], 'v'),
        ):
            look: style.Line = {'marker': marker, 'markevery': 12, 'markersize': 3.5}
            axes.plot(temperature, bias[:, i] - middle, label=name, **look, **line)
        axes.set_title(f'bias {AXES[i]}')
        axes.axhline(0.0, color='black', linewidth=0.5)
    style.shared_legend(figure, panels[0], 2)
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


def draw_history(evidence: Evidence) -> Figure:
    """Draw bias and scale of each calibration of the unit against the first one, by date."""
    history = evidence.history
    figure = style.new_figure(2.6)
    places = np.arange(len(history))
    for axes, name, unit in zip(
        figure.subplots(1, 2), ('bias', 'scale'), ('µg', 'ppm'), strict=True
    ):
        value, sd = (
            np.array([getattr(one, key) for one in history]) for key in (name, f'{name}_sd')
        )
        for i, (axis, marker) in enumerate(zip(AXES, 'os^', strict=True)):
            change, half = value[:, i] - value[0, i], BAND_SDS * np.nan_to_num(sd[:, i])
            look: style.Line = {
                'marker': marker,
                'markersize': 3.5,
                'capsize': 2.0,
                **style.AXIS_LINES[i],
            }
            axes.errorbar(places + 0.08 * (i - 1), change, yerr=half, label=axis, **look)
        axes.axhline(0.0, color='black', linewidth=0.5)
        axes.set_xticks(places, [label_text(one.created[:10]) for one in history])
        axes.set_ylabel(f'change, {unit}')
        style.legend_above(axes, share=0.5, title=name, alignment='left')
    return figure
