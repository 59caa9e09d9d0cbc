# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the fleet's page: what a lab has to act on first, the whole table last."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from urllib.parse import quote

import numpy as np

from .. import __version__
from ..report.figures_fleet import draw_distances, draw_shares
from ..report.html import document, figure, table
from ..report.plates import Draw, DrawnPlate, draw_plates
from ..report.text import number
from .summary import Summary
from .table import Cell, Row, is_fitted, is_valid

# A list longer than this is for the table's readers.
_MOST_ROWS = 60


def render_fleet(
    rows: Sequence[Row], summary: Summary, certificate_of: Callable[[Row], str]
) -> str:
    """Write the page; `certificate_of` gives a certificate's path beside it, or nothing."""
    fitted = [row for row in rows if is_fitted(row)]
    plates = _figures(fitted, summary)
    return document(
        'Fleet report',
        [
            '<h1>Fleet report</h1>',
            f'<p class="under">{len(rows)} thermal tests</p>',
            _box(rows, summary),
            _refused(rows),
            _outliers(summary),
            _drifts(summary),
            '<h2>Figures</h2>' if plates else '',
            *(figure(plate) for plate in plates),
            _spreads(summary),
            _units(rows, certificate_of),
            _footer(),
        ],
    )


def _box(rows: Sequence[Row], summary: Summary) -> str:
    n_fitted = sum(map(is_fitted, rows))
    headline = f'{n_fitted} of {len(rows)} tests gave a calibration.'
    facts = [
        ', '.join(f'{n} {verdict}' for verdict, n in sorted(summary.verdicts.items())) + '.',
        _said(len({one.name for one in summary.outliers}), 'unit stands', 'units stand', 'out')
        if np.isfinite(summary.limit)
        else 'Too few units to say which stand out.',
    ]
    if summary.drifts:
        n_drifted = sum(one.is_significant for one in summary.drifts)
        facts.append(
            f'{len(summary.drifts)} units were tested again: '
            f'{n_drifted or "none"} changed by more than chance.'
        )
    n_left_out = sum(int(row['n_left_out'] or 0) for row in rows)
    if n_left_out:
        facts.append(f'{n_left_out} bags were left out.')
    level = 'good' if all(map(is_valid, rows)) else 'reserved' if n_fitted else 'poor'
    return (
        f'<section class="verdict {level}" aria-label="Summary">'
        f'<p><strong>{escape(headline)}</strong></p>'
        + ''.join(f'<p>{escape(fact)}</p>' for fact in facts)
        + '</section>'
    )


def _said(n: int, one: str, several: str, rest: str) -> str:
    return f'{n or "No"} {one if n == 1 else several} {rest}.'


def _refused(rows: Sequence[Row]) -> str:
    without = [row for row in rows if not is_fitted(row)]
    if not without:
        return ''
    columns = ('problem', 'name', 'serial', 'verdict')
    return '<h2>Not calibrated</h2>' + table(
        ('reason', 'test', 'serial', 'verdict'),
        [tuple(str(row[name]) for name in columns) for row in without[:_MOST_ROWS]],
        texts=4,
        caption=_more(len(without)),
    )


def _more(n: int) -> str:
    return f'The first {_MOST_ROWS} of {n}; the others are in fleet.csv.' if n > _MOST_ROWS else ''


def _outliers(summary: Summary) -> str:
    if not summary.outliers:
        return ''
    return '<h2>Units that stand out</h2>' + table(
        ('test', 'serial', 'quantity', 'value', 'median', 'unit', 'distance, sd'),
        [
            (
                one.name,
                one.serial,
                one.label,
                number(one.value),
                number(one.middle),
                one.unit,
                number(one.z),
            )
            for one in summary.outliers[:_MOST_ROWS]
        ],
        texts=3,
        caption='Distance from the median in robust standard deviations (median absolute '
        f'deviation), beyond ±{number(summary.limit)}: a fleet of this size without any oddity '
        f'has such a unit once in twenty times. {_more(len(summary.outliers))}',
    )


def _drifts(summary: Summary) -> str:
    if not summary.drifts:
        return ''
    ordered = summary.drifts
    return '<h2>Tested again</h2>' + table(
        ('serial', 'earlier', 'later', 'surest change in', 'days', 'change', 'unit', 'sd', 'real'),
        [
            (
                one.serial,
                one.earlier,
                one.later,
                one.worst.label,
                number(one.days),
                number(one.worst.change),
                one.worst.unit,
                number(one.worst.sd),
                'yes' if one.is_significant else 'no',
            )
            for one in ordered[:_MOST_ROWS]
        ],
        texts=4,
        caption='Coefficients at the reference temperature, later minus earlier; sd as the two '
        f'fits claim it; real: more than chance. {_more(len(ordered))}',
        chosen=[one.is_significant for one in ordered],
    )


def _figures(fitted: Sequence[Row], summary: Summary) -> list[DrawnPlate]:
    if not fitted:
        return []
    curves = {
        section: np.array([v for row in fitted if isinstance(v := row[f'{section}_ug'], float)])
        for section in ('raw', 'static', 'dynamic')
    }
    drawn: list[tuple[str, str, str, Draw]] = [
        (
            'residuals',
            'What is left of |g|, unit by unit?',
            'Share of the units whose residual at rest is below the value: raw (constants at the '
            'reference temperature), and with each unit’s calibration. Steep is alike; a tail to '
            'the right is a unit to look at.',
            partial(draw_shares, curves),
        )
    ]
    if len(fitted) > 2:
        labels, z, names = zip(
            *((one.quantity.label, one.z, one.names) for one in summary.spreads), strict=True
        )
        distances: Draw = partial(draw_distances, labels, z, names, summary.limit)
        plate = (
            'distances',
            'Which units stand out, and in what?',
            'Each stroke is a unit: its distance from the fleet’s median in robust standard '
            'deviations. Diamonds beyond the dashed lines are the units listed above.',
            distances,
        )
        drawn.append(plate)
    return draw_plates(drawn)


def _spreads(summary: Summary) -> str:
    if not summary.spreads:
        return ''
    return '<h2>Spread of the fleet</h2>' + table(
        ('quantity', 'unit', 'lowest', 'median', 'highest', 'sd', 'units'),
        [
            (
                one.quantity.label,
                one.quantity.unit,
                number(float(np.min(one.values))),
                number(one.middle),
                number(float(np.max(one.values))),
                number(one.sd),
                str(len(one.values)),
            )
            for one in summary.spreads
        ],
        texts=2,
        caption='At the reference temperature; scale factors as the deviation from their median. '
        'sd: 1.4826 times the median absolute deviation.',
    )


def _units(rows: Sequence[Row], certificate_of: Callable[[Row], str]) -> str:
    columns = ('static_ug', 'dynamic_ug', 'peak_ug')
    return '<h2>All tests</h2>' + table(
        (
            *('test', 'serial', 'lot', 'verdict', 'model'),
            *('static', 'dynamic', 'largest', '°C', 'rests', 'bags'),
        ),
        [
            (
                *(str(row[name]) for name in ('name', 'serial', 'lot', 'verdict', 'model')),
                *(_cell(row[name]) for name in columns),
                _range(row),
                str(row['n_positions'] or '–'),
                _bags(row),
            )
            for row in rows
        ],
        texts=5,
        caption='|g| − g at rest in µg: RMS in the static and the dynamic regime, largest window, '
        'on each unit’s own bags; '
        'calibrated board temperatures; still positions. All columns with all digits: '
        'fleet.parquet and fleet.csv.',
        links=[quote(certificate_of(row)) if is_fitted(row) else '' for row in rows],
    )


def _range(row: Row) -> str:
    lowest, highest = row['lowest_c'], row['highest_c']
    if not isinstance(lowest, float) or not isinstance(highest, float):
        return '–'
    return f'{lowest:.0f} to {highest:.0f}'.replace('-', '−')


def _cell(cell: Cell) -> str:
    return '–' if cell is None else number(float(cell))


def _bags(row: Row) -> str:
    n_left_out = row['n_left_out']
    return f'{row["n_bags"]} − {n_left_out}' if n_left_out else str(row['n_bags'])


def _footer() -> str:
    now = dt.datetime.now(dt.timezone.utc)
    return (
        f'<footer>Report made {now:%Y-%m-%d %H:%M} UTC by thermo_comp {escape(__version__)}. '
        '1 µg = 9.80665·10⁻⁶ m/s². Residuals: |g| − g at rest, on each unit’s own bags, over '
        'windows as long as the column window_s says, 60 s if nothing else.</footer>'
    )
