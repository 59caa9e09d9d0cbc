# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the list of figures: what each asks, how its answer is read, and when it can be drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.figure import Figure

from .evidence import Evidence
from .figures_residual import draw_gravity, draw_histograms, draw_residuals
from .figures_thermal import draw_dynamics, draw_temperatures
from .figures_unit import draw_functions, draw_positions, draw_step
from .style import NARROW, WIDE, Sheet, drawing, png, svg
from .text import label_text

_GREY = 'Grey: the time in which the flag says dynamic.'


@dataclass(frozen=True)
class Plate:
    """
    One figure of the report.

    Parameters
    ----------
    name : str
        Its file's name.
    question : str
        What it answers.
    reading : callable
        How the answer is read, as a text, from the evidence.
    draw : callable
        Draws it on a sheet.
    is_possible : callable
        Whether the evidence suffices.

    """

    name: str
    question: str
    reading: Callable[[Evidence], str]
    draw: Callable[[Evidence, Sheet], Figure]
    is_possible: Callable[[Evidence], bool]


@dataclass(frozen=True)
class DrawnPlate:
    """
    A figure ready for the page.

    Parameters
    ----------
    number : int
        Counted from 1.
    name, question, reading : str
        As in `Plate`.
    wide, narrow : str
        SVG elements, for paper and desk, and for a phone.

    """

    number: int
    name: str
    question: str
    reading: str
    wide: str
    narrow: str


def possible_plates(evidence: Evidence) -> list[Plate]:
    """List the figures that the evidence allows, in order."""
    return [plate for plate in PLATES if plate.is_possible(evidence)]


def drawn_plates(evidence: Evidence) -> list[DrawnPlate]:
    """
    Draw all figures for the page.

    Parameters
    ----------
    evidence : Evidence
        What they show.

    Returns
    -------
    list of DrawnPlate
        In order.

    """
    result = []
    with drawing():
        for number, plate in enumerate(possible_plates(evidence), 1):
            result.append(
                DrawnPlate(
                    number=number,
                    name=plate.name,
                    question=plate.question,
                    reading=plate.reading(evidence),
                    wide=svg(plate.draw(evidence, WIDE), f'f{number}w', plate.question),
                    narrow=svg(plate.draw(evidence, NARROW), f'f{number}n', plate.question),
                )
            )
    return result


def png_files(evidence: Evidence) -> dict[str, bytes]:
    """
    Draw all figures as PNG files.

    Parameters
    ----------
    evidence : Evidence
        What they show.

    Returns
    -------
    dict of {str: bytes}
        Content by file name, e.g. ``1_temperatures.png``.

    """
    with drawing():
        return {
            f'{number}_{plate.name}.png': png(plate.draw(evidence, WIDE))
            for number, plate in enumerate(possible_plates(evidence), 1)
        }


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
        'rates of the '
        f'temperatures and, below, the second derivative of the {sensor} temperature, whose '
        'pulses open and close the dynamic state; (c) the state that follows, with its '
        f'direction; before the detector has seen enough it is unknown. {_GREY} '
        f'{_bag(evidence)} After Fig. 4 of the paper.'
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


def _step(_evidence: Evidence) -> str:
    return (
        'What is still to come of the change of bias and scale when board and case have jumped '
        'by 1 K together: what a line leaves, the curve over temperature does not know. Where '
        'it meets zero, the unit has settled.'
    )


def _histograms(_evidence: Evidence) -> str:
    return (
        '|g| − g over all windows of all positions. Bars: by regime, with the normal '
        'distribution of the same mean and spread; where they follow the line, what is left '
        'is noise. Steps: the size of the residual without and with the correction, on a '
        'logarithmic axis; the further left, the better.'
    )


def _positions(_evidence: Evidence) -> str:
    return (
        'Direction of the specific force in the unit’s frame, position by position, in an '
        'equal-area map of both halves of the sphere, seen from +z; the inner circle is 45° of '
        'elevation. Beside it, where gravity is known, what is left in each position: one that '
        'stands out was moved, or is not of this unit. Diamonds: what the other positions alone '
        'leave on it.'
    )


def _has_windows_of_shown(evidence: Evidence) -> bool:
    shown, windows = evidence.shown, evidence.windows
    return shown is not None and windows is not None and bool((windows.bag == shown.index).any())


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
        lambda evidence: _has_windows_of_shown(evidence) and bool(evidence.residuals),
    ),
    Plate(
        'gravity',
        'Does |g| stay constant over the whole program?',
        _gravity,
        draw_gravity,
        lambda evidence: _has_windows_of_shown(evidence) and bool(evidence.residuals),
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
        _step,
        draw_step,
        lambda evidence: (
            evidence.calibration is not None
            and any(term.lag for term in evidence.calibration.response)
        ),
    ),
    Plate(
        'histograms',
        'Is what is left noise, or is there something to model?',
        _histograms,
        draw_histograms,
        lambda evidence: bool(evidence.residuals) and _has_windows_of_shown(evidence),
    ),
    Plate(
        'positions',
        'Are the positions well spread, and does one stand out?',
        _positions,
        draw_positions,
        lambda evidence: bool(evidence.positions),
    ),
)
