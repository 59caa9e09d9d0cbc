# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the list of figures: what each asks, how its answer is read, and when it can be drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from .evidence import Evidence
from .figures_residual import draw_gravity, draw_histograms, draw_residuals
from .figures_thermal import draw_dynamics, draw_temperatures
from .figures_unit import draw_functions, draw_history, draw_hysteresis, draw_positions, draw_step
from .style import NARROW, WIDE, Sheet, drawing, png, svg
from .text import label_text

Draw = Callable[[Sheet], Figure]
_GREY = 'Grey: the time in which the flag says dynamic.'


@dataclass(frozen=True)
class Plate:
    """One figure of the report; `reading` says how its answer is read."""

    name: str
    question: str
    reading: Callable[[Evidence], str]
    draw: Callable[[Evidence, Sheet], Figure]
    is_possible: Callable[[Evidence], bool]


@dataclass(frozen=True)
class DrawnPlate:
    """A figure ready for the page: as SVG for paper and desk, and narrow for a phone."""

    number: int
    name: str
    question: str
    reading: str
    wide: str
    narrow: str


def draw_plates(plates: Sequence[tuple[str, str, str, Draw]]) -> list[DrawnPlate]:
    """Draw figures, given by name, question, reading and way to draw, and number them."""
    with drawing():
        return [
            DrawnPlate(
                number,
                name,
                question,
                reading,
                wide=svg(draw(WIDE), f'f{number}w', question),
                narrow=svg(draw(NARROW), f'f{number}n', question),
            )
            for number, (name, question, reading, draw) in enumerate(plates, 1)
        ]


def drawn_plates(evidence: Evidence) -> list[DrawnPlate]:
    """Draw all figures that the evidence allows, in order."""
    return draw_plates(
        [
            (one.name, one.question, one.reading(evidence), _drawer(one, evidence))
            for one in possible_plates(evidence)
        ]
    )


def png_files(evidence: Evidence) -> dict[str, bytes]:
    """Draw all figures as PNG: their content by file name, like ``1_temperatures.png``."""
    with drawing():
        return {
            f'{number}_{plate.name}.png': png(plate.draw(evidence, WIDE))
            for number, plate in enumerate(possible_plates(evidence), 1)
        }


def possible_plates(evidence: Evidence) -> list[Plate]:
    """List the figures that the evidence allows, in order."""
    return [plate for plate in PLATES if plate.is_possible(evidence)]


def _drawer(plate: Plate, evidence: Evidence) -> Draw:
    return lambda sheet: plate.draw(evidence, sheet)


def _bag(evidence: Evidence) -> str:
    if evidence.shown is None:
        return ''
    return f'Bag {label_text(evidence.bags[evidence.shown.index].name, 60)}.'


def _temperatures(evidence: Evidence) -> str:
    shown = evidence.shown
    program = ' against the chamber’s program' if shown and shown.cyclogram else ''
    return (
        f'Readings of both thermometers{program}. The board lags behind the case, so the case '
        f'is the first to tell that a ramp has begun. {_GREY} {_bag(evidence)} '
        'After Fig. 3 of the paper.'
    )


def _dynamics(evidence: Evidence) -> str:
    sensor = 'case' if evidence.shown and evidence.shown.trace.is_case_leading else 'board'
    window_s = 0.0 if evidence.windows is None else evidence.windows.window_s
    return (
        f'(a) change of each axis’ reading, means over {window_s:g} s at rest; (b) estimated '
        f'rates of the temperatures and, below, the second derivative of the {sensor} '
        'temperature, whose pulses open and close the dynamic state; (c) the state that follows, '
        'with its direction; before the detector has seen enough it is unknown. '
        f'{_GREY} {_bag(evidence)} After Fig. 4 of the paper.'
    )


def _residuals(evidence: Evidence) -> str:
    return (
        'Residual of each axis in the output frame. The attitude of a position is not known: '
        'the mean direction seen there stands for it. Each panel has a scale of its own. '
        f'{_GREY} {_bag(evidence)} After Fig. 6 of the paper.'
    )


def _gravity(evidence: Evidence) -> str:
    return (
        f'|g| from the three axes, less local gravity {evidence.gravity or 0.0:.6g} m/s²; '
        'a unit at rest must show zero whatever the temperature does. Above: before and after '
        f'the correction; below: after it, in detail. {_GREY} {_bag(evidence)} '
        'After Fig. 7 of the paper.'
    )


def _functions(evidence: Evidence) -> str:
    calibration = evidence.calibration
    reference = 20.0 if calibration is None else calibration.reference_temperature_c
    return (
        f'Bias and scale factor against their values at {reference:g} °C (grey line): in a soak, '
        'and in ramps through the whole range, which begin in a soak at its end. Hatched: 95 % '
        'band of all that was fitted; where it is wider than the curves are apart, the bags do '
        'not tell.'
    )


def _positions(evidence: Evidence) -> str:
    rings = (
        ' Rings and diamonds: what the other positions alone leave on it, which is what a new '
        'attitude will see; the area of a ring is in proportion.'
        if evidence.left_out
        else ''
    )
    return (
        'Direction of the specific force in the unit’s frame, position by position, in an '
        'equal-area map of both halves of the sphere, seen from +z; the inner circle is 45° of '
        'elevation. Beside it, where gravity is known, what is left in each position: one that '
        f'stands out was moved, or is not of this unit.{rings}'
    )


def _has_residuals_of_shown(evidence: Evidence) -> bool:
    shown, windows = evidence.shown, evidence.windows
    if shown is None or windows is None or not evidence.residuals:
        return False
    return bool((windows.bag == shown.index).any())


PLATES = (
    Plate(
        'temperatures',
        'How did the unit follow the chamber?',
        _temperatures,
        draw_temperatures,
        lambda evidence: evidence.shown is not None,
    ),
    Plate(
        'dynamics',
        'When do the readings drift, and does the flag mark it?',
        _dynamics,
        draw_dynamics,
        lambda evidence: evidence.shown is not None,
    ),
    Plate(
        'residuals',
        'What does the correction leave on each axis?',
        _residuals,
        draw_residuals,
        _has_residuals_of_shown,
    ),
    Plate(
        'gravity',
        'Does |g| stay constant over the whole program?',
        _gravity,
        draw_gravity,
        _has_residuals_of_shown,
    ),
    Plate(
        'functions',
        'What is corrected, and how well is it known?',
        _functions,
        draw_functions,
        lambda evidence: evidence.calibration is not None,
    ),
    Plate(
        'step',
        'For how long does the unit remember a change of temperature?',
        lambda _: (
            'What is still to come of the change of bias and scale when board and case have '
            'jumped by 1 K together: what a line leaves, the curve over temperature does not '
            'know. Where it meets zero, the unit has settled.'
        ),
        draw_step,
        lambda evidence: (
            evidence.calibration is not None
            and any(term.lag for term in evidence.calibration.response)
        ),
    ),
    Plate(
        'hysteresis',
        'Does the bias come back on another way than it went?',
        lambda _: (
            'Slow run through the whole range and back: bias of each axis less the middle of both '
            'ways. The width of the loop is what no curve over temperature can correct.'
        ),
        draw_hysteresis,
        lambda evidence: (
            evidence.calibration is not None
            and any(term.kind == 'play' for term in evidence.calibration.response)
        ),
    ),
    Plate(
        'history',
        'What has drifted between the calibrations of this unit?',
        lambda _: (
            'Bias and scale in a soak at the reference temperature, by the date of each '
            'calibration, less those of the first; bars: 95 % of what each leaves open.'
        ),
        draw_history,
        lambda evidence: len(evidence.history) > 1,
    ),
    Plate(
        'histograms',
        'Is what is left noise, or is there something to model?',
        lambda _: (
            '|g| − g over all windows of all positions. Bars: by regime, with the normal '
            'distribution of the same mean and spread; where they follow the line, what is left '
            'is noise. Steps: the size of the residual without and with the correction, on a '
            'logarithmic axis; the further left, the better.'
        ),
        draw_histograms,
        _has_residuals_of_shown,
    ),
    Plate(
        'positions',
        'Are the positions well spread, and does one stand out?',
        _positions,
        draw_positions,
        lambda evidence: bool(evidence.positions),
    ),
)
