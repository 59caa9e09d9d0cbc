# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the report as files: evidence and figures as one HTML page, and the figures as PNG."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path

import numpy as np

from .. import __version__
from ..files import PAGE, PICTURE, write_atomically
from ..fitting import FitResult
from ..judging import SECTIONS
from ..thermal.regime import Regime
from ..unit.calibration import AXES, Calibration
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from .certificate import CertificateInfo, budget, combined, conformity_rule, results
from .evidence import CHOSEN, LEFT_OUT, RAW, Evidence
from .gather import evidence_of_fit
from .html import render
from .plates import DrawnPlate, drawn_plates, png_files
from .text import minus, number

#: Times at which a navigator's user asks [s], all well below a quarter Schuler period of 1266 s.
TIMES_S = (60.0, 300.0, 600.0)
_EARTH_RADIUS = 6.371e6
#: Peak of the Schuler oscillation, 2 R b / g, for a bias b of one micro-g [m]: 12.7.
SCHULER_PEAK_PER_MICRO_G = 2.0 * MICRO_G * _EARTH_RADIUS / STANDARD_GRAVITY
#: Steps of the model by their names in `fitting.ResidualRow`.
_STEPS = ('raw', 'one_set', 'two_sets', 'fitted', 'left_out')
#: What the groups of `unit.columns` are, in words.
_GROUPS = {
    'curve': 'curve over temperature',
    'set': 'difference of the sets',
    'now': 'heat flow (case − board)',
    'rate': 'rate of the board',
    'board': 'parts that lag the board',
    'neighbour': 'parts between case and board',
    'product': 'lags, changing with temperature',
    'mixed': 'heat flow, changing with temperature',
    'square': 'curves of parts that lag',
    'even': 'size of the heat flow',
    'play': 'hysteresis',
}


def write_report(
    subject: FitResult | Evidence,
    path: str | Path,
    *,
    info: CertificateInfo | None = None,
    figures: str | Path | None = None,
    paths: Sequence[str | Path] = (),
    program: str | None = None,
    overwrite: bool = True,
) -> Evidence:
    """
    Write a certificate as one self-contained HTML page.

    Parameters
    ----------
    subject : FitResult or Evidence
        A fit, or what `evidence_of_bags` gathered.
    path : str or Path
        The page.
    info : CertificateInfo or None, optional
        What the laboratory states; what it does not stays blank.
    figures : str or Path or None, optional
        Folder that gets the figures as PNG files, made if it is not there.
    paths, program : optional
        Of a fit: see `evidence_of_fit`.
    overwrite : bool, optional
        Replace a page and pictures that are there.

    Returns
    -------
    Evidence
        What the page is made of.

    Raises
    ------
    OutputError
        If a file may not or cannot be written.
    RecordingError
        If one of `paths` cannot be opened.
    ValueError
        If `program` cannot be read.

    """
    evidence = subject
    if isinstance(evidence, FitResult):
        evidence = evidence_of_fit(evidence, paths=paths, program=program)
    page = render_report(evidence, info)
    if figures is not None:
        for name, content in png_files(evidence).items():
            write_atomically(Path(figures) / name, content, PICTURE, overwrite=overwrite)
    write_atomically(path, page.encode(), PAGE, overwrite=overwrite)
    return evidence


def render_report(evidence: Evidence, info: CertificateInfo | None = None) -> str:
    """Make a report for whoever writes it: the HTML document."""
    return render_page(evidence, drawn_plates(evidence), info=info)


def render_page(
    evidence: Evidence,
    plates: Sequence[DrawnPlate],
    *,
    info: CertificateInfo | None = None,
    script: str = '',
    nonce: str = '',
    notice: str = '',
) -> str:
    """Write the page; `script` and `nonce` are a viewer's (see `html.render`), as is `notice`."""
    info = info or CertificateInfo()
    is_certificate = evidence.calibration is not None
    title = 'Thermal calibration certificate' if is_certificate else 'Thermal test record'
    contributions = budget(evidence, info)
    return render(
        'certificate.html',
        script=script,
        nonce=nonce,
        title=f'{evidence.serial}: {title}',
        heading=title,
        margin=f'{title} {info.number}, unit {evidence.serial}'.replace(' ,', ','),
        notice=notice,
        is_simulated=evidence.is_simulated,
        info=info,
        evidence=evidence,
        verdict=_verdict(evidence),
        seen=_seen(evidence),
        dates=_dates(evidence, info),
        facts=_facts(evidence),
        instruments=[astuple(one) for one in info.instruments],
        results=[astuple(one) for one in results(evidence, info, contributions)],
        budget=[(one.name, one.evaluation, one.basis, _ug(one.standard)) for one in contributions],
        combined=combined(contributions),
        rule=conformity_rule(evidence),
        sections=_sections(evidence),
        times_s=TIMES_S,
        peak=SCHULER_PEAK_PER_MICRO_G,
        navigator=_navigator(evidence),
        plates=plates,
        axes=_axes(evidence.calibration),
        steps=[
            (one.section, *(_ug(getattr(one, name).rms) for name in _STEPS), str(one.raw.n))
            for one in evidence.steps
            if one.raw.n
        ],
        groups=_groups(evidence.calibration),
        rungs=[f'{rung}, µg RMS' for rung in _rungs(evidence)],
        positions=_positions(evidence),
        bags=_bags(evidence),
        sources=[
            (one.name, one.sha256, '', (str(one.n_samples),))
            for one in (
                () if evidence.calibration is None else evidence.calibration.provenance.sources
            )
        ],
        now=f'{dt.datetime.now(dt.timezone.utc):%Y-%m-%d %H:%M}',
        version=__version__,
    )


def position_error(bias: float, time: float) -> float:
    """Give what a constant error [m/s^2] of a horizontal axis moves a position by, ``b t^2/2``."""
    return 0.5 * bias * time * time


def schuler_peak(bias: float) -> float:
    """Give the largest position error [m] of a constant error, reached after 42 minutes."""
    return bias / MICRO_G * SCHULER_PEAK_PER_MICRO_G


def _ug(acceleration: float | None) -> str:
    return '–' if acceleration is None else number(acceleration / MICRO_G)


def _rungs(evidence: Evidence) -> list[str]:
    return [*evidence.residuals, *([LEFT_OUT] if evidence.left_out else [])]


def _verdict(evidence: Evidence) -> tuple[str, str]:
    """Give the verdict and its numbers, spelt for readers."""
    words, _, numbers = evidence.headline.partition(': ')
    if evidence.judgement is not None:
        words, numbers = evidence.judgement.verdict, evidence.judgement.reason
    return words.replace(' ug', ' µg'), numbers.replace(' ug', ' µg')


def _seen(evidence: Evidence) -> list[str]:
    """Say which bags the verdict rests on, and what the flag marked in the one that is shown."""
    said = []
    if evidence.judgement is not None:
        board = evidence.judgement.windows.board
        which = 'bags of its own fit' if evidence.is_seen else 'bags that the fit has not seen'
        said.append(
            f'{len(evidence.positions)} rests in {which}, '
            f'{np.min(board):.1f} to {np.max(board):.1f} °C.'
        )
    shown = evidence.shown
    known = [] if shown is None else [s for s in shown.trace.stretches if s.regime >= 0]
    if shown is not None and not known:
        said.append('The regime was never known: the bag is too short for the detector.')
    elif shown is not None:
        dynamic = [s for s in known if s.regime == Regime.DYNAMIC]
        part = sum(s.stop - s.start for s in dynamic) / sum(s.stop - s.start for s in known)
        said.append(
            f'In bag {evidence.bags[shown.index].name} the flag marked {len(dynamic)} dynamic '
            f'stretches, {100.0 * part:.0f} % of the time in which the regime was known.'
        )
    return said


def _dates(evidence: Evidence, info: CertificateInfo) -> list[tuple[str, str]]:
    """Give the dates; that of the test is the bags' own unless somebody knows better."""
    test = info.dates.test
    if not test and evidence.bags and evidence.is_seen:
        days = sorted(f'{_utc(bag.start_ns):%Y-%m-%d}' for bag in evidence.bags)
        test = days[0] if days[0] == days[-1] else f'{days[0]} to {days[-1]}'
    calibration = evidence.calibration
    fit = '' if calibration is None else calibration.provenance.created
    return [
        ('Date of test', test),
        ('Date of fit', fit),
        ('Date of issue', info.dates.issue),
        ('Due for recalibration', info.dates.due),
    ]


def _facts(evidence: Evidence) -> list[tuple[str, str]]:
    """Say for what the calibration is valid, and how it came about."""
    rows = []
    calibration = evidence.calibration
    if calibration is not None:
        static, dynamic = calibration.regime_sets()
        for name, one in (('static', static), ('dynamic', dynamic)):
            (low, high), (slow, fast) = one.temperature_range_c, one.rate_range_k_min
            text = f'{low:.1f} to {high:.1f} °C, {slow:+.2f} to {fast:+.2f} K/min'
            rows.append((f'Valid, {name}', minus(text)))
        provenance = calibration.provenance
        rows += [
            ('Reference temperature', f'{calibration.reference_temperature_c:g} °C'),
            ('Input', f'{calibration.unit.input}, full scale {calibration.unit.full_scale:g}'),
            ('Model', provenance.model or 'not recorded'),
            ('Fitted by', f'thermo_comp {provenance.tool_version or "(version not recorded)"}'),
        ]
    if evidence.positions:
        rows.append(('Positions', str(len(evidence.positions))))
    return rows


def _sections(evidence: Evidence) -> list[tuple[str, ...]]:
    """Tell what is left of |g| in each section, without and with the calibration."""
    rows: list[tuple[str, ...]] = []
    judgement = evidence.judgement
    if judgement is None:
        return rows
    for name in SECTIONS:
        one = judgement.sections[name]
        if one.n:
            ratio = f'{one.ratio:.2f}' if np.isfinite(one.ratio) else '–'
            n = str(one.n)
            rows.append((name, RAW, _ug(one.raw_rms), _ug(one.raw_peak), '–', '–', n))
            rows.append(
                (name, CHOSEN, _ug(one.rms), _ug(one.peak), _ug(one.claimed_rms), ratio, n)
            )
    return rows


def _navigator(evidence: Evidence) -> list[tuple[str, ...]]:
    judgement = evidence.judgement
    if judgement is None:
        return []
    return [
        (
            correction,
            section,
            _ug(rms),
            *(number(position_error(rms, time)) for time in TIMES_S),
            number(schuler_peak(rms)),
        )
        for section in ('static', 'dynamic')
        if (one := judgement.sections[section]).n
        for correction, rms in ((RAW, one.raw_rms), (CHOSEN, one.rms))
    ]


def _axes(calibration: Calibration | None) -> list[tuple[str, ...]]:
    """Tell what the unit is at the reference temperature."""
    if calibration is None:
        return []
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    densities = calibration.noise_density_m_s2_sqrt_hz
    return [
        (
            axis,
            number(reference.scale_factor, 9),
            number(reference.bias, 6),
            _ug(density),
            *(minus(f'{value:.6f}') for value in row),
        )
        for axis, reference, density, row in zip(
            AXES, axes, densities, calibration.misalignment, strict=True
        )
    ]


def _groups(calibration: Calibration | None) -> list[tuple[str, ...]]:
    """Tell what each part of the model explains."""
    return [
        (
            _GROUPS.get(one.group, one.group),
            one.part,
            _ug(one.explains_m_s2),
            f'{one.effective_parameters:.1f}',
            minus(f'{one.log_evidence_change:+.1f}'),
        )
        for one in (() if calibration is None else calibration.evidence)
    ]


def _positions(evidence: Evidence) -> list[tuple[str, ...]]:
    return [
        (
            str(one.number),
            evidence.bags[one.bag].name,
            f'{one.duration_s / 60.0:.1f}',
            *(minus(f'{value:+.4f}') for value in one.up),
            *(_ug(one.residual_rms.get(rung, np.nan)) for rung in _rungs(evidence)),
        )
        for one in evidence.positions
    ]


def _bags(evidence: Evidence) -> list[tuple[str, str, str, tuple[str, ...]]]:
    """Give each bag's name, hash, remarks and cells."""
    return [
        (
            bag.name,
            bag.sha256,
            '; '.join(bag.remarks),
            (
                f'{_utc(bag.start_ns):%Y-%m-%d %H:%M}',
                f'{bag.duration_s / 3600.0:.2f}',
                str(bag.n_samples),
                number(bag.rate_hz, 4),
                '–'
                if bag.board_span is None
                else minus('{:.1f} to {:.1f}'.format(*bag.board_span)),
            ),
        )
        for bag in evidence.bags
    ]


def _utc(stamp_ns: int) -> dt.datetime:
    return dt.datetime.fromtimestamp(stamp_ns // 10**9, dt.timezone.utc)
