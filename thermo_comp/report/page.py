# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the page: evidence, verdict and figures as one HTML document that needs nothing else.

Whatever comes from a bag or a calibration is text that somebody else wrote: it is escaped on its
way into the page.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from html import escape

import numpy as np

from .. import __version__
from ..judging import SECTIONS
from ..thermal.regime import Regime
from ..unit.gravity import MICRO_G
from .evidence import CHOSEN, RAW, Evidence
from .html import document, figure, table
from .inertial import SCHULER_PEAK_PER_MICRO_G, TIMES_S, position_error, schuler_peak
from .plates import DrawnPlate
from .tables import axes_table, groups_table, positions_table, steps_table
from .text import number


def render_page(
    evidence: Evidence,
    plates: Sequence[DrawnPlate],
    *,
    script: str = '',
    nonce: str = '',
    notice: str = '',
) -> str:
    """
    Write the page.

    Parameters
    ----------
    evidence : Evidence
        What it is about.
    plates : sequence of DrawnPlate
        The figures.
    script : str, optional
        Script of the viewer that serves the page; a page in a file has none.
    nonce : str, optional
        Makes the page's policy let this one script run, and talk to its server.
    notice : str, optional
        Something that the viewer has to say.

    Returns
    -------
    str
        The HTML document.

    """
    is_certificate = evidence.calibration is not None
    title = 'Thermal calibration certificate' if is_certificate else 'Thermal test record'
    parts = [
        f'<h1>{title}</h1>',
        f'<p class="under">Unit {escape(evidence.serial)}</p>',
        f'<p class="notice">{escape(notice)}</p>' if notice else '',
        _verdict(evidence),
        _facts(evidence),
        _statistics(evidence),
        _inertial(evidence),
        '<h2>Figures</h2>' if plates else '',
        *(figure(plate) for plate in plates),
        axes_table(evidence.calibration),
        steps_table(evidence),
        groups_table(evidence.calibration),
        positions_table(evidence),
        _bags(evidence),
        _footer(),
    ]
    return document(f'{evidence.serial}: {title}', parts, script=script, nonce=nonce)


def _verdict(evidence: Evidence) -> str:
    lists = ''.join(
        f'<p>{name}:</p><ul>{"".join(f"<li>{escape(text)}</li>" for text in texts)}</ul>'
        for name, texts in (('Reservations', evidence.findings), ('Checked', evidence.checks))
        if texts
    )
    words, _, numbers = evidence.headline.partition(': ')
    if evidence.judgement is not None:
        words, numbers = evidence.judgement.verdict, evidence.judgement.reason
    return (
        f'<section class="verdict {evidence.level}" aria-label="Verdict">'
        '<div class="under">Verdict</div>'
        f'<p><strong>{escape(_micro(words))}</strong></p><p>{escape(_micro(numbers))}</p>'
        f'{_seen(evidence)}{lists}</section>'
    )


def _micro(text: str) -> str:
    return text.replace(' ug', ' µg')


def _seen(evidence: Evidence) -> str:
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
    return ''.join(f'<p>{escape(text)}</p>' for text in said)


def _facts(evidence: Evidence) -> str:
    calibration = evidence.calibration
    rows = [('Unit', evidence.serial)]
    if calibration is not None:
        provenance = calibration.provenance
        static, dynamic = calibration.regime_sets()
        rows += [
            ('Calibrated', provenance.created or 'date not recorded'),
            ('Fitted by', f'thermo_comp {provenance.tool_version or "(version not recorded)"}'),
            ('Model', provenance.model or 'not recorded'),
            ('Input', f'{calibration.unit.input}, full scale {calibration.unit.full_scale:g}'),
            ('Reference temperature', f'{calibration.reference_temperature_c:g} °C'),
            ('Valid, static', _ranges(static.temperature_range_c, static.rate_range_k_min)),
            ('Valid, dynamic', _ranges(dynamic.temperature_range_c, dynamic.rate_range_k_min)),
        ]
    if evidence.gravity is not None:
        rows.append(('Local gravity', f'{evidence.gravity:.7g} m/s²'))
    if evidence.positions:
        rows.append(('Positions', str(len(evidence.positions))))
    cells = ''.join(f'<dt>{escape(name)}</dt><dd>{escape(text)}</dd>' for name, text in rows)
    return f'<dl>{cells}</dl>'


def _ranges(temperature: tuple[float, float], rate: tuple[float, float]) -> str:
    return (
        f'{temperature[0]:.1f} to {temperature[1]:.1f} °C, '
        f'{rate[0]:+.2f} to {rate[1]:+.2f} K/min'.replace('-', '−')
    )


def _statistics(evidence: Evidence) -> str:
    judgement = evidence.judgement
    if judgement is None:
        return ''
    rows, chosen = [], []
    for name in SECTIONS:
        one = judgement.sections[name]
        if not one.n:
            continue
        ug = [
            number(value / MICRO_G) if np.isfinite(value) else '–'
            for value in (one.raw_rms, one.raw_peak, one.rms, one.peak, one.claimed_rms)
        ]
        ratio = f'{one.ratio:.2f}' if np.isfinite(one.ratio) else '–'
        rows.append((name, RAW, *ug[:2], '–', '–', str(one.n)))
        rows.append((name, CHOSEN, *ug[2:], ratio, str(one.n)))
        chosen += [False, True]
    return '<h2>What is left of |g|</h2>' + table(
        ('section', 'correction', 'RMS, µg', 'largest, µg', 'claimed, µg', 'ratio', 'windows'),
        rows,
        texts=2,
        caption=f'|g| − g at rest, means over {judgement.windows.window_s:g} s. Raw: scale '
        'factor, bias and misalignment at the reference temperature only. Claimed: RMS of the '
        'standard deviations that the calibration gives for these windows. Outside: beyond the '
        'calibrated ranges; it decides nothing.',
        chosen=chosen,
    )


def _inertial(evidence: Evidence) -> str:
    judgement = evidence.judgement
    if judgement is None:
        return ''
    rows = [
        (
            correction,
            section,
            number(rms / MICRO_G),
            *(number(position_error(rms, time)) for time in TIMES_S),
            number(schuler_peak(rms)),
        )
        for section in ('static', 'dynamic')
        if (one := judgement.sections[section]).n
        for correction, rms in ((RAW, one.raw_rms), (CHOSEN, one.rms))
    ]
    return '<h2>What it means to an inertial navigator</h2>' + table(
        (
            'correction',
            'regime',
            'error, µg',
            *(f'after {time:g} s, m' for time in TIMES_S),
            'Schuler peak, m',
        ),
        rows,
        texts=2,
        caption='Position error if the RMS residual were the constant error b of a horizontal '
        f'axis: b t²/2, and at most {SCHULER_PEAK_PER_MICRO_G:.1f} m per µg in a Schuler period.',
    )


def _bags(evidence: Evidence) -> str:
    if evidence.bags:
        head = ('bag', 'start, UTC', 'length, h', 'samples', 'Hz', 'T board, °C')
        rows = []
        for bag in evidence.bags:
            start = dt.datetime.fromtimestamp(bag.start_ns // 10**9, dt.timezone.utc)
            span = bag.board_span
            remarks = f'<br>{escape("; ".join(bag.remarks))}' if bag.remarks else ''
            cells = (
                f'{start:%Y-%m-%d %H:%M}',
                f'{bag.duration_s / 3600.0:.2f}',
                str(bag.n_samples),
                number(bag.rate_hz, 4),
                f'{span[0]:.1f} to {span[1]:.1f}' if span else '–',
            )
            rows.append(
                f'<tr><td>{escape(bag.name)}<br><code>{escape(bag.sha256) or "no hash"}</code>'
                f'{remarks}</td>' + ''.join(f'<td class=number>{c}</td>' for c in cells) + '</tr>'
            )
        headings = ''.join(
            f'<th{" class=number" if i else ""}>{name}</th>' for i, name in enumerate(head)
        )
        listed = (
            '<p class="note">With the SHA-256 of each.</p><div class="scroll"><table><thead><tr>'
            f'{headings}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        )
        return f'<h2>Bags of this report</h2>{listed}{_sources(evidence)}'
    return _sources(evidence)


def _sources(evidence: Evidence) -> str:
    if evidence.calibration is None or evidence.is_fit:
        return ''
    sources = evidence.calibration.provenance.sources
    if not sources:
        return ''
    rows = ''.join(
        f'<tr><td>{escape(source.name)}<br><code>{escape(source.sha256) or "no hash"}</code></td>'
        f'<td class=number>{source.n_samples}</td></tr>'
        for source in sources
    )
    return (
        '<h2>Bags that the calibration was fitted on</h2><div class="scroll"><table><thead><tr>'
        '<th>bag</th><th class=number>samples</th></tr></thead>'
        f'<tbody>{rows}</tbody></table></div>'
    )


def _footer() -> str:
    now = dt.datetime.now(dt.timezone.utc)
    return (
        f'<footer>Report made {now:%Y-%m-%d %H:%M} UTC by thermo_comp {escape(__version__)}. '
        '1 µg = 9.80665·10⁻⁶ m/s². |g|: magnitude of the specific force of a unit at rest. '
        'Static and dynamic: the regime in which the node’s own detector saw each window. '
        'The paper: S. V. Golovach, results of applying the method of algorithmic temperature '
        'drift compensation for a three-axis accelerometer, 2016.</footer>'
    )
