# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the fleet's page: what a lab has to act on first, the whole table last."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Sequence
from functools import partial
from urllib.parse import quote

import numpy as np

from .. import __version__
from ..report.figures import DrawnFigure, ReportFigure, drawn_figures
from ..report.figures_fleet import draw_distances, draw_shares
from ..report.html import render
from ..report.text import minus, number
from .summary import Summary
from .table import Cell, Row, is_fitted, is_valid

# A list longer than this is for the table's readers.
_MOST_ROWS = 60


def render_fleet(
    rows: Sequence[Row], summary: Summary, certificate_of: Callable[[Row], str]
) -> str:
    """Write the page; `certificate_of` gives a certificate's path beside it, or nothing."""
    fitted = [row for row in rows if is_fitted(row)]
    refused = [row for row in rows if not is_fitted(row)]
    level = 'good' if all(map(is_valid, rows)) else 'reserved' if fitted else 'poor'
    return render(
        'fleet.html',
        title='Fleet report',
        most=_MOST_ROWS,
        level=level,
        n_tests=len(rows),
        n_fitted=len(fitted),
        verdicts=sorted(summary.verdicts.items()),
        can_tell=np.isfinite(summary.limit),
        limit=summary.limit,
        n_standing_out=len({one.name for one in summary.outliers}),
        n_drifted=sum(one.is_significant for one in summary.drifts),
        n_left_out=sum(int(row['n_left_out'] or 0) for row in rows),
        refused=[[row[k] for k in ('problem', 'name', 'serial', 'verdict')] for row in refused],
        outliers=[
            _cells(one.name, one.serial, one.label, one.value, one.middle, one.unit, one.z)
            for one in summary.outliers
        ],
        drifts=[
            _cells(one.serial, one.earlier, one.later, one.worst.label, one.days, one.worst.change)
            + _cells(one.worst.unit, one.worst.sd, 'yes' if one.is_significant else 'no')
            for one in summary.drifts
        ],
        is_real=[one.is_significant for one in summary.drifts],
        figures=_figures(fitted, summary),
        spreads=[
            _cells(one.quantity.label, one.quantity.unit, float(np.min(one.values)), one.middle)
            + _cells(float(np.max(one.values)), one.sd, len(one.values))
            for one in summary.spreads
        ],
        tests=[
            _cells(*(row[k] for k in ('name', 'serial', 'lot', 'verdict', 'model')))
            + _cells(row['static_ug'], row['dynamic_ug'], row['peak_ug'])
            + [_range(row), *_cells(row['n_positions'] or None), _bags(row)]
            for row in rows
        ],
        links=[quote(certificate_of(row)) if is_fitted(row) else '' for row in rows],
        footer=f'Report made {dt.datetime.now(dt.timezone.utc):%Y-%m-%d %H:%M} UTC by thermo_comp '
        f'{__version__}. 1 µg = 9.80665·10⁻⁶ m/s². Residuals: |f| − g at rest, on each unit’s own '
        'bags, over windows as long as the column window_s says, 60 s if nothing else.',
    )


def _cells(*cells: Cell) -> list[str]:
    return [
        '–' if cell is None else number(cell) if isinstance(cell, float) else str(cell)
        for cell in cells
    ]


def _range(row: Row) -> str:
    lowest, highest = row['lowest_c'], row['highest_c']
    return '–' if lowest is None or highest is None else minus(f'{lowest:.0f} to {highest:.0f}')


def _bags(row: Row) -> str:
    n_left_out = row['n_left_out']
    return f'{row["n_bags"]} − {n_left_out}' if n_left_out else str(row['n_bags'])


def _figures(fitted: Sequence[Row], summary: Summary) -> list[DrawnFigure]:
    if not fitted:
        return []
    curves = {
        section: np.array([v for row in fitted if isinstance(v := row[f'{section}_ug'], float)])
        for section in ('raw', 'static', 'dynamic')
    }
    found = [
        ReportFigure(
            'residuals',
            'What is left of |f|, unit by unit?',
            'Share of the units whose residual at rest is below the value: raw (constants at the '
            'reference temperature), and with each unit’s calibration. Steep is alike; a tail to '
            'the right is a unit to look at.',
            partial(draw_shares, curves),
        )
    ]
    # Of few units nobody knows what is usual.
    if np.isfinite(summary.limit):
        labels, z, names = zip(
            *((one.quantity.label, one.z, one.names) for one in summary.spreads), strict=True
        )
        found.append(
            ReportFigure(
                'distances',
                'Which units stand out, and in what?',
                'Each stroke is a unit: its distance from the fleet’s median in robust standard '
                'deviations. Diamonds beyond the dashed lines are the units listed above.',
                partial(draw_distances, labels, z, names, summary.limit),
            )
        )
    return drawn_figures(found)
