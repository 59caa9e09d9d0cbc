# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the list of figures: what each asks, how its answer is read, and when it can be drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from . import figures_bags as of_bags
from . import figures_unit as of_unit
from .evidence import Evidence
from .html import label_text
from .style import drawing, svg


class ReportFigure(NamedTuple):
    """One figure: its file's name, the question it answers, how that is read, the drawing."""

    name: str
    question: str
    reading: str
    draw: Callable[[], Figure]


def drawn_figures(figures: Sequence[ReportFigure]) -> list[tuple[ReportFigure, str]]:
    """Draw figures for a page, as SVG."""
    with drawing():
        return [
            (one, svg(one.draw(), f'f{number}', one.question))
            for number, one in enumerate(figures, 1)
        ]


def figures_of(evidence: Evidence) -> list[ReportFigure]:
    """List the figures that the evidence allows, in order."""
    return [
        ReportFigure(
            draw.__name__.removeprefix('draw_'),
            question,
            ' '.join(filter(None, reading)),
            partial(draw, evidence),
        )
        for of in (_of_time, _of_unit, _of_positions)
        for question, draw, *reading in of(evidence)
    ]


def _of_time(evidence: Evidence) -> Iterator[tuple[Any, ...]]:
    """Give the figures of the bag that is shown."""
    shown, windows = evidence.shown, evidence.windows
    if shown is None:
        return
    bag = f'Bag {label_text(shown.bag.source.name, 60)}.'
    read = f'Grey: the time in which the flag says dynamic. {bag} After Fig.'
    yield (
        'How did the unit follow the chamber?',
        of_bags.draw_temperatures,
        'Readings of both thermometers. The board lags behind the case, so the case '
        f'is the first to tell that a ramp has begun. {read} 3 of the paper.',
    )
    window_s = 0.0 if windows is None else windows.window_s
    yield (
        'When do the readings drift, and does the flag mark it?',
        of_bags.draw_dynamics,
        f'(a) change of each axis’ reading, means over {window_s:g} s at rest; (b) estimated '
        f'rates of the temperatures and, below, the second derivative of the {shown.leader} '
        'temperature, whose pulses open and close the dynamic state; (c) the state that follows, '
        'with its direction; before the detector has seen enough it is unknown. '
        f'{read} 4 of the paper.',
    )
    if windows is None or not evidence.residuals or not (windows.bag == shown.index).any():
        return
    yield (
        'What does the correction leave on each axis?',
        of_bags.draw_residuals,
        'Residual of each axis in the output frame. The attitude in a position is not known: '
        'the mean direction seen there stands for it. Each panel has a scale of its own. '
        f'{read} 6 of the paper.',
    )
    yield (
        'Does |f| stay constant over the whole program?',
        of_bags.draw_gravity,
        f'|f| from the three axes, less local gravity {evidence.gravity or 0.0:.6g} m/s²; '
        'a unit at rest must show zero whatever the temperature does. Above: before and after '
        'the correction; below: after it, in a scale of its own. '
        f'{read} 7 of the paper.',
    )


def _of_unit(evidence: Evidence) -> Iterator[tuple[Any, ...]]:
    """Give the figures of the calibration."""
    calibration = evidence.calibration
    if calibration is None:
        return
    has_band = calibration.posterior is not None
    yield (
        'What is corrected, and how well is it known?',
        of_unit.draw_functions,
        'Bias and scale factor over temperature, in a soak and in ramps through the whole range '
        'that begin in a soak at its end, less the value at '
        f'{calibration.reference_temperature_c:g} °C (grey line) and less a straight line, whose '
        'slope stands above each panel.',
        'Hatched: 95 % band of all that was fitted, with its largest half width above the panel; '
        'where it is wider than the curves are apart, the bags do not tell.'
        if has_band
        else '',
        'Circles: what was measured in each soak of each position, all of the residual taken for '
        'one of bias or of scale; of scale only where the axis has half of gravity or more.'
        if evidence.windows is not None and evidence.residuals
        else '',
    )
    if calibration.gyroscope is not None:
        judged = None if evidence.judgement is None else evidence.judgement.rate
        yield (
            'What is corrected of the angular rate?',
            of_unit.draw_rates,
            'Bias of the gyroscope over temperature, in a soak and in ramps as above, less the '
            'value at the reference temperature and less a straight line, whose slope stands '
            'above each panel. Hatched: 95 % band, of the constant as well, which the Earth’s '
            'rate and the turn-on blur.',
            '' if judged is None else f'Judged on these bags, {judged}.',
        )
    if any(term.lag for term in calibration.response):
        yield (
            'For how long does the unit remember a change of temperature?',
            of_unit.draw_step,
            'Board and case jump by 1 K together: how far bias and scale are from where they '
            'will settle. Where a line meets zero, the unit has settled.',
        )
    if any(term.kind == 'play' for term in calibration.response):
        yield (
            'Does the bias come back on another way than it went?',
            of_unit.draw_hysteresis,
            'A run through the whole range and back, too slow for any lag: bias of each axis less '
            'the middle of both ways. No curve over temperature can correct the width of the '
            'loop.',
        )
    if len(evidence.history) > 1:
        yield (
            'What has drifted between the calibrations of this unit?',
            of_unit.draw_history,
            'Bias and scale in a soak at the reference temperature, by the date of each '
            'calibration, less those of the first; bars: 95 % of what each leaves open.',
        )


def _of_positions(evidence: Evidence) -> Iterator[tuple[Any, ...]]:
    """Give the figures of all positions."""
    if evidence.residuals and len(evidence.positions) > 1:
        yield (
            'Does the correction hold in every position?',
            of_bags.draw_every_position,
            'A row for each position: |f| − g after the correction, over the time since the '
            'position began; all rows have the scale that is written above. Black and wide in '
            'the static, red and thin in the dynamic regime. On the right the RMS.',
        )
    if evidence.positions:
        yield (
            'Are the positions well spread, and does one stand out?',
            of_bags.draw_positions,
            'Direction of the specific force in the output frame, position by position, in an '
            'equal-area map of both halves of the sphere, seen from +z; the inner circle is 45° '
            'of elevation. A position that stands out was moved, or is not of this unit.',
            'The area of a red ring is in proportion to what is left there by a fit of the other '
            'positions alone, which is what a new attitude will see.'
            if evidence.left_out
            else 'The area of a red ring is in proportion to what is left there.'
            if evidence.residuals
            else '',
            'Red cross: the direction of which the calibration knows least, and the standard '
            'deviation of |f| there: a position would tell most.'
            if evidence.least_known
            else '',
        )
