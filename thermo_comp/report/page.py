# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the report as an HTML page and PNG files, and the list of its figures."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from ..files import PAGE, PICTURE, write_atomically
from ..fitting.windows import CURVE, SET
from ..judging.evaluation import drifts_of
from ..unit.gravity import STANDARD_GRAVITY
from ..unit.terms import GROUPS
from . import certificate, figures
from .evidence import LEFT_OUT, Evidence, span_of
from .statements import CertificateInfo
from .style import caption, drawing, png, render, svg, utc

# Mean radius of the Earth in GRS 80 [m].
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


def render_report(evidence: Evidence, info: CertificateInfo | None = None) -> str:
    """Return the page, with all figures for which `evidence` has data."""
    info = info or CertificateInfo()
    title = 'Thermal calibration certificate' if evidence.calibration else 'Thermal test record'
    contributions = certificate.budget(evidence, info)
    corrections = [*evidence.residuals, *([LEFT_OUT] if evidence.left_out else [])]
    gravity_sd = info.gravity.standard_uncertainty_m_s2
    return render(
        'certificate.html',
        title=f'{evidence.serial}: {title}',
        heading=title,
        margin=f'{title} {info.number}, unit {evidence.serial}'.replace(' ,', ','),
        is_simulated=evidence.is_simulated,
        info=info,
        evidence=evidence,
        bags=[(bag, *span_of(bag)) for bag in evidence.bags],
        tested=info.dates.test or _test_dates(evidence),
        results=certificate.results(evidence, info, contributions),
        budget=contributions,
        combined=certificate.combined(contributions),
        conformity=certificate.conformity(evidence),
        over_temperature=certificate.over_temperature(evidence, info),
        programs=certificate.programs(evidence.calibration) if evidence.calibration else (),
        groups={CURVE: 'curve over temperature', SET: 'difference of the sets', **GROUPS},
        gravity_sd=(evidence.gravity_sd or None) if gravity_sd is None else gravity_sd,
        is_gravity_known=certificate.unclaimed_gravity_sd(evidence, info) is not None,
        error=position_error,
        schuler=schuler_peak,
        figures=drawn_figures(figures_of(evidence)),
        drifts=drifts_of(evidence.history),
        corrections=corrections,
        correction_headings=[f'{name}, µg RMS' for name in corrections],
    )


def position_error(bias: float, time: float) -> float:
    """Return the position error [m] due to a constant horizontal bias [m/s^2] after a time [s]."""
    return 0.5 * bias * time * time


def schuler_peak(bias: float) -> float:
    """Return the largest position error [m] of a constant bias, 2 R b / g, after 42 minutes."""
    return 2.0 * _EARTH_RADIUS * bias / STANDARD_GRAVITY


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


def report_figure(draw: Callable[..., Figure], *data: Any) -> ReportFigure:
    """Return a figure of `data`, with its texts from the template ``captions.html``."""
    name = draw.__name__.removeprefix('draw_')
    return ReportFigure(name, *caption(name, *data), partial(draw, *data))


def figures_of(evidence: Evidence) -> list[ReportFigure]:
    """List the figures for which `evidence` has data, in the order of the page."""
    shown, windows, calibration = evidence.shown, evidence.windows, evidence.calibration
    is_corrected = False
    if shown is not None and windows is not None and evidence.residuals:
        is_corrected = bool((windows.bag == shown.index).any())
    has_data = {
        figures.draw_temperatures: shown is not None,
        figures.draw_dynamics: shown is not None,
        figures.draw_residuals: is_corrected,
        figures.draw_gravity: is_corrected,
        figures.draw_functions: calibration is not None,
        figures.draw_rates: calibration is not None and calibration.gyroscope is not None,
        figures.draw_every_position: evidence.residuals and len(evidence.positions) > 1,
        figures.draw_positions: evidence.positions,
    }
    return [report_figure(draw, evidence) for draw, is_drawn in has_data.items() if is_drawn]
