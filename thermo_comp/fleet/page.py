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
from ..report.figures import ReportFigure, drawn_figures
from ..report.figures_fleet import draw_distances, draw_shares
from ..report.html import render
from .summary import Summary
from .table import Row, is_fitted, is_valid

# A list longer than this is for the table's readers.
_MOST_ROWS = 60


def render_fleet(
    rows: Sequence[Row], summary: Summary, certificate_of: Callable[[Row], str]
) -> str:
    """Write the page; `certificate_of` gives a certificate's path beside it, or nothing."""
    fitted = [row for row in rows if is_fitted(row)]
    return render(
        'fleet.html',
        title='Fleet report',
        most=_MOST_ROWS,
        level='good' if all(map(is_valid, rows)) else 'reserved' if fitted else 'poor',
        rows=rows,
        summary=summary,
        n_fitted=len(fitted),
        refused=[row for row in rows if not is_fitted(row)],
        can_tell=np.isfinite(summary.limit),
        figures=_figures(fitted, summary) if fitted else [],
        links={row['name']: quote(certificate_of(row)) for row in fitted},
        now=f'{dt.datetime.now(dt.timezone.utc):%Y-%m-%d %H:%M}',
        version=__version__,
    )


def _figures(fitted: Sequence[Row], summary: Summary) -> list[tuple[ReportFigure, str]]:
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
        found.append(
            ReportFigure(
                'distances',
                'Which units stand out, and in what?',
                'Each stroke is a unit: its distance from the fleet’s median in robust standard '
                'deviations. Diamonds beyond the dashed lines are the units listed above.',
                partial(
                    draw_distances,
                    [one.quantity.label for one in summary.spreads],
                    [one.z for one in summary.spreads],
                    [one.names for one in summary.spreads],
                    summary.limit,
                ),
            )
        )
    return drawn_figures(found)
