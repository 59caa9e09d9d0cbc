# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the report as files: evidence and figures as one HTML page, and the figures as PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..files import PAGE, PICTURE, write_atomically
from ..fitting.reduction import ReducedBag
from ..judging.history import drifts_of
from ..text import counted
from ..thermal.regime import Regime
from ..unit.gravity import STANDARD_GRAVITY
from .certificate import CertificateInfo, budget, combined, conformity_rule, results
from .evidence import LEFT_OUT, Evidence
from .figures import ReportFigure, drawn_figures, figures_of
from .html import render, utc
from .style import drawing, png
from .trace import span_of

# Mean radius of the Earth [m]: GRS 80.
_EARTH_RADIUS = 6.371e6


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

    What the laboratory does not state in `info` stays blank. The folder `figures` gets them as PNG
    files, like ``1_temperatures.png``. Raises OutputError if a file may not or cannot be written.
    """
    page = render_report(evidence, info)
    if figures is not None:
        with drawing():
            for number, one in enumerate(figures_of(evidence), 1):
                name = Path(figures) / f'{number}_{one.name}.png'
                write_atomically(name, png(one.draw()), PICTURE, overwrite=overwrite)
    write_atomically(path, page.encode(), PAGE, overwrite=overwrite)


def render_report(
    evidence: Evidence,
    info: CertificateInfo | None = None,
    *,
    figures: Sequence[tuple[ReportFigure, str]] | None = None,
    script: str = '',
    notice: str = '',
) -> str:
    """
    Make the page, with figures that are drawn already if there are some.

    `script` and `notice` are a viewer's.
    """
    if figures is None:
        figures = drawn_figures(figures_of(evidence))
    info = info or CertificateInfo()
    is_certificate = evidence.calibration is not None
    title = 'Thermal calibration certificate' if is_certificate else 'Thermal test record'
    contributions = budget(evidence, info)
    rungs = [*evidence.residuals, *([LEFT_OUT] if evidence.left_out else [])]
    return render(
        'certificate.html',
        script=script,
        title=f'{evidence.serial}: {title}',
        heading=title,
        margin=f'{title} {info.number}, unit {evidence.serial}'.replace(' ,', ','),
        notice=notice,
        is_simulated=evidence.is_simulated,
        info=info,
        evidence=evidence,
        bags=[(one, *span_of(one), remarks_of(one)) for one in evidence.bags],
        seen=_seen(evidence),
        tested=info.dates.test or _test_dates(evidence),
        results=results(evidence, info, contributions),
        budget=contributions,
        combined=combined(contributions),
        rule=conformity_rule(evidence),
        error=position_error,
        schuler=schuler_peak,
        figures=figures,
        drifts=drifts_of(evidence.history),
        rungs=rungs,
        rung_headings=[f'{rung}, µg RMS' for rung in rungs],
    )


def position_error(bias: float, time: float) -> float:
    """Give what a constant error [m/s^2] of a horizontal axis moves a position by, ``b t^2/2``."""
    return 0.5 * bias * time * time


def schuler_peak(bias: float) -> float:
    """Give the largest position error [m] of a constant error, 2 R b / g, after 42 minutes."""
    return 2.0 * _EARTH_RADIUS * bias / STANDARD_GRAVITY


def remarks_of(bag: ReducedBag) -> list[str]:
    """Say what of a bag was lost or is odd."""
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


def _seen(evidence: Evidence) -> list[str]:
    """Say which bags the verdict rests on, and where the regime was never known."""
    said = []
    if evidence.judgement is not None:
        board = evidence.judgement.windows.board
        which = 'bags of its own fit' if evidence.is_seen else 'bags that the fit has not seen'
        said.append(
            f'{counted(len(evidence.positions), "position")} in {which}, '
            f'{np.min(board):.1f} to {np.max(board):.1f} °C.'
        )
    shown = evidence.shown
    if shown is not None and all(one.regime == Regime.UNKNOWN for one in shown.stretches):
        said.append('The regime was never known: the bag is too short for the detector.')
    return said


def _test_dates(evidence: Evidence) -> str:
    """Give the days on which the bags of the calibration's fit began, if it was fitted on some."""
    if not evidence.bags or not evidence.is_seen:
        return ''
    days = sorted(f'{utc(span_of(bag)[0]):%Y-%m-%d}' for bag in evidence.bags)
    return days[0] if days[0] == days[-1] else f'{days[0]} to {days[-1]}'
