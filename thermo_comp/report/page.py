# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the report as an HTML page and PNG files, and the list of its figures with their texts."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ..files import PAGE, PICTURE, write_atomically
from ..fitting.reduction import ReducedBag
from ..fitting.windows import CURVE, SET
from ..judging.evaluation import drifts_of
from ..thermal.regime import Regime
from ..unit.gravity import STANDARD_GRAVITY
from ..unit.terms import GROUPS
from . import certificate
from . import figures_bags as of_bags
from . import figures_unit as of_unit
from .evidence import LEFT_OUT, Evidence, span_of
from .statements import CertificateInfo
from .style import drawing, label_text, png, render, svg, utc

# Mean radius of the Earth [m]: GRS 80.
_EARTH_RADIUS = 6.371e6


class ReportFigure(NamedTuple):
    """A figure: file name, question that it answers, how to read it, drawing function."""

    name: str
    question: str
    reading: str
    draw: Callable[[], Figure]


def write_report(
    evidence: Evidence,
    path: str | Path,
    *,
    info: CertificateInfo | None = None,
    figures: str | Path | None = None,
    overwrite: bool = True,
) -> None:
    """
    Write a certificate as one self-contained HTML page.

    Statements missing in `info` stay blank. The folder `figures` gets the figures as PNG files,
    like ``1_temperatures.png``. Raises OutputError if a file may not or cannot be written.
    """
    page = render_report(evidence, info)
    if figures is not None:
        with drawing():
            for number, figure in enumerate(figures_of(evidence), 1):
                name = Path(figures) / f'{number}_{figure.name}.png'
                write_atomically(name, png(figure.draw()), PICTURE, overwrite=overwrite)
    write_atomically(path, page.encode(), PAGE, overwrite=overwrite)


def render_report(
    evidence: Evidence,
    info: CertificateInfo | None = None,
    *,
    figures: Sequence[tuple[ReportFigure, str]] | None = None,
) -> str:
    """Return the page with the given figures, by default all for which `evidence` has data."""
    if figures is None:
        figures = drawn_figures(figures_of(evidence))
    info = info or CertificateInfo()
    title = 'Thermal calibration certificate' if evidence.calibration else 'Thermal test record'
    contributions = certificate.budget(evidence, info)
    corrections = [*evidence.residuals, *([LEFT_OUT] if evidence.left_out else [])]
    return render(
        'certificate.html',
        title=f'{evidence.serial}: {title}',
        heading=title,
        margin=f'{title} {info.number}, unit {evidence.serial}'.replace(' ,', ','),
        is_simulated=evidence.is_simulated,
        info=info,
        evidence=evidence,
        bags=[(bag, *span_of(bag), remarks_of(bag)) for bag in evidence.bags],
        judged_bags=_judged_bags(evidence),
        tested=info.dates.test or _test_dates(evidence),
        results=certificate.results(evidence, info, contributions),
        budget=contributions,
        combined=certificate.combined(contributions),
        conformity=certificate.conformity(evidence),
        over_temperature=certificate.over_temperature(evidence, info),
        programs=certificate.programs(evidence.calibration) if evidence.calibration else (),
        groups={CURVE: 'curve over temperature', SET: 'difference of the sets', **GROUPS},
        withheld=certificate.withheld_because(evidence, info),
        own_heat=certificate.own_heat(evidence.calibration),
        is_gravity_known=certificate.unclaimed_gravity_sd(evidence, info) is not None,
        error=position_error,
        schuler=schuler_peak,
        figures=figures,
        drifts=drifts_of(evidence.history),
        corrections=corrections,
        correction_headings=[f'{name}, µg RMS' for name in corrections],
    )


def position_error(bias: float, time: float) -> float:
    """Return the position error [m] of a constant horizontal error [m/s^2] after a time [s]."""
    return 0.5 * bias * time * time


def schuler_peak(bias: float) -> float:
    """Return the largest position error [m] of a constant bias, 2 R b / g, after 42 minutes."""
    return 2.0 * _EARTH_RADIUS * bias / STANDARD_GRAVITY


def remarks_of(bag: ReducedBag) -> list[str]:
    """Return remarks on a bag, such as lost samples or a missing case temperature."""
    n = len(bag.intervals)
    return [
        text
        for text, is_so in (
            (bag.info.truncated or '', bag.info.truncated),
            (f'{bag.n_saturated} samples saturated, left out', bag.n_saturated),
            (f'{bag.n_dropped} samples not finite or out of order, left out', bag.n_dropped),
            ('no accelerometer samples', not bag.n_samples),
            ('never at rest', bag.n_samples and not n),
            (f'{n} still intervals', n > 1),
            ('no case temperature', not len(bag.case.value)),
        )
        if is_so
    ]


def _judged_bags(evidence: Evidence) -> list[str]:
    """Return sentences on the judged bags and on a shown bag in which no regime was found."""
    collected = []
    if evidence.judgement is not None:
        board = evidence.judgement.windows.board
        which = 'bags of the fit' if evidence.is_seen else 'bags that the fit did not use'
        collected.append(
            f'{evidence.positions_text} in {which}, {np.min(board):.1f} to {np.max(board):.1f} °C.'
        )
    shown = evidence.shown
    if shown is not None and all(stretch.regime == Regime.UNKNOWN for stretch in shown.stretches):
        collected.append('The regime is not known: the shown bag is too short for the detector.')
    return collected


def _test_dates(evidence: Evidence) -> str:
    """Return the days on which the bags began, if the fit used one of these bags; else ''."""
    if not evidence.bags or not evidence.is_seen:
        return ''
    days = sorted(f'{utc(span_of(bag)[0]):%Y-%m-%d}' for bag in evidence.bags)
    return days[0] if days[0] == days[-1] else f'{days[0]} to {days[-1]}'


def drawn_figures(figures: Sequence[ReportFigure]) -> list[tuple[ReportFigure, str]]:
    """Draw figures for a page, as SVG."""
    with drawing():
        return [
            (figure, svg(figure.draw(), f'f{number}', figure.question))
            for number, figure in enumerate(figures, 1)
        ]


def figures_of(evidence: Evidence) -> list[ReportFigure]:
    """List the figures for which `evidence` has data, in the order of the page."""
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
    """Yield the figures of the shown bag."""
    shown, windows = evidence.shown, evidence.windows
    if shown is None:
        return
    bag = f'Bag {label_text(shown.bag.source.name, 60)}.'
    read = f'Grey: dynamic regime. {bag} After Fig.'
    yield (
        'How did the temperatures of case and board change?',
        of_bags.draw_temperatures,
        'Readings of the case and the board thermometer. The board lags behind the case, so a '
        f'ramp begins first at the case. {read} 3 of the paper.',
    )
    means = '' if windows is None else f', means over {windows.window_s:g} s at rest'
    yield (
        'When do the readings drift, and does the regime flag mark these times?',
        of_bags.draw_dynamics,
        f'(a) change of each axis’ reading{means}; (b) estimated rates of the temperatures '
        f'and, below, the second derivative of the {shown.leader} temperature, which has a '
        'pulse at the start and the end of a ramp; (c) regime and direction, unknown until the '
        f'detector has enough readings. {read} 4 of the paper.',
    )
    if windows is None or not evidence.residuals or not (windows.bag == shown.index).any():
        return
    yield (
        'Which residual remains on each axis after the correction?',
        of_bags.draw_residuals,
        'Residual of each axis in the output frame: corrected force less a vector of length g in '
        'the mean measured direction of the position. Each panel has a separate scale. '
        f'{read} 6 of the paper.',
    )
    yield (
        'Does |f| stay constant over the whole program?',
        of_bags.draw_gravity,
        f'|f| from the three axes, less local gravity {evidence.gravity or 0.0:.6g} m/s²; '
        'zero for an ideal unit at rest at any temperature. Above: before and after '
        'the correction; below: after the correction, enlarged. '
        f'{read} 7 of the paper.',
    )


def _of_unit(evidence: Evidence) -> Iterator[tuple[Any, ...]]:
    """Yield the figures of the calibration."""
    calibration = evidence.calibration
    if calibration is None:
        return
    has_band = calibration.posterior is not None
    yield (
        'Which bias and scale are corrected, and how uncertain are they?',
        of_unit.draw_functions,
        'Bias and scale factor over temperature, in a soak and in ramps that begin in a soak at '
        'an end of the range and go to the other end. The value at '
        f'{calibration.reference_temperature_c:g} °C (grey line) and a straight line are '
        'subtracted; the slope of the line stands above each panel.',
        'Hatched: 95 % band of the fit; its largest half width stands above the panel. The bags '
        'do not distinguish curves that are closer together than the band is wide.'
        if has_band
        else '',
        'Circles: measurement in each soak of each position, with the whole residual taken as an '
        'error of the bias or of the scale; of the scale only for axes with half of g or more.'
        if evidence.windows is not None and evidence.residuals
        else '',
    )
    if calibration.gyroscope is not None:
        judged = None if evidence.judgement is None else evidence.judgement.rate
        yield (
            'Which bias of the angular rate is corrected?',
            of_unit.draw_rates,
            'Bias of the gyroscope over temperature, in a soak and in ramps, less the '
            'value at the reference temperature and less a straight line, whose slope stands '
            'above each panel. Hatched: 95 % band, including the uncertainty of the constant '
            'due to the Earth’s rate and the turn-on offset.',
            '' if judged is None else f'Verdict on these bags: {judged}.',
        )


def _of_positions(evidence: Evidence) -> Iterator[tuple[Any, ...]]:
    """Yield the figures of all positions."""
    if evidence.residuals and len(evidence.positions) > 1:
        yield (
            'Does the correction hold in every position?',
            of_bags.draw_every_position,
            'Each row is a position: |f| − g after the correction, over the time since the start '
            'of the position; the scale of all rows is written above. Black, wide lines: static '
            'regime; red, thin lines: dynamic regime. On the right: RMS of the position.',
        )
    if evidence.positions:
        yield (
            'Are the positions well spread, and is any position an outlier?',
            of_bags.draw_positions,
            'Direction of the specific force in the output frame, position by position, in an '
            'equal-area map of both halves of the sphere, seen from +z; the inner circle is 45° '
            'of elevation. If one residual is far larger than all others, the unit was moved '
            'there, or the bag is of another unit.',
            'The area of a red ring is proportional to the RMS residual of its position in a fit '
            'to the other positions, which is the error expected in a new attitude.'
            if evidence.left_out
            else 'The area of a red ring is proportional to the RMS residual of its position.'
            if evidence.residuals
            else '',
            'Red cross: the direction with the largest standard deviation of |f|, which is its '
            'label; a position in this direction would improve the calibration most.'
            if evidence.least_known
            else '',
        )
