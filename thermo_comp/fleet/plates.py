# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the list of the fleet's figures: what each asks, and what of the table it shows."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from ..report.figures_fleet import (
    Draw,
    Panel,
    draw_changes,
    draw_distances,
    draw_lots,
    draw_plate,
    draw_shares,
    draw_spreads,
)
from ..report.plates import DrawnPlate
from ..typing import Floats
from ..unit.calibration import AXES
from .row import Row
from .summary import QUANTITIES, Drift, Summary, spread_of

_MOST_DRIFTS = 24
_PANELS = (
    ('scale_{}', 'scale factor from its median'),
    ('scale_slope_{}_ppm_k', 'slope of the scale factor'),
    ('bias_{}_ug', 'bias'),
    ('bias_slope_{}_ug_k', 'slope of the bias'),
)
_BY_COLUMN = {quantity.column: quantity for quantity in QUANTITIES}


def fleet_plates(fitted: Sequence[Row], summary: Summary) -> list[DrawnPlate]:
    """
    Draw what the fleet has to show.

    Parameters
    ----------
    fitted : sequence of mapping
        The calibrated units.
    summary : Summary
        What the table tells.

    Returns
    -------
    list of DrawnPlate
        In order; none without a calibrated unit.

    """
    if not fitted:
        return []
    drawn: list[tuple[str, str, str, Draw]] = [
        (
            'residuals',
            'What is left of |g|, unit by unit?',
            'Share of the units whose residual at rest is below the value: raw (constants at the '
            'reference temperature), and with each unit’s calibration. Steep is alike; a tail to '
            'the right is a unit to look at.',
            partial(draw_shares, _curves(fitted)),
        )
    ]
    if len(fitted) > 2:
        drawn += [
            (
                'spreads',
                'How much do the units differ?',
                'Share of the units below each value, at the reference temperature. What all have '
                'in common could be designed away; the width is why each unit is calibrated.',
                partial(draw_spreads, _panels(fitted)),
            ),
            (
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
            ),
        ]
    if summary.lot_effects:
        drawn.append(_lot_plate(fitted, summary))
    if summary.drifts:
        drawn.append(_drift_plate(summary.surest_drifts[:_MOST_DRIFTS]))
    return [draw_plate(number, *one) for number, one in enumerate(drawn, 1)]


def _curves(fitted: Sequence[Row]) -> dict[str, Floats]:
    return {
        section: np.array([v for row in fitted if isinstance(v := row[f'{section}_ug'], float)])
        for section in ('raw', 'static', 'dynamic')
    }


def _panels(fitted: Sequence[Row]) -> list[Panel]:
    panels = []
    for pattern, title in _PANELS:
        quantities = [_BY_COLUMN[pattern.format(axis)] for axis in AXES]
        spreads = [spread_of(quantity, fitted) for quantity in quantities]
        values = [np.zeros(0) if one is None else one.values for one in spreads]
        panels.append(Panel(title, quantities[0].unit, values))
    return panels


def _lot_plate(fitted: Sequence[Row], summary: Summary) -> tuple[str, str, str, Draw]:
    effect = summary.lot_effects[0]
    spread = next(one for one in summary.spreads if one.quantity.label == effect.label)
    lot_of = {str(row['name']): str(row['lot']) for row in fitted}
    groups = {
        lot: np.array(
            [
                value
                for name, value in zip(spread.names, spread.values.tolist(), strict=True)
                if lot_of[name] == lot
            ]
        )
        for lot in effect.medians
    }
    return (
        'lots',
        'Where do the lots differ most surely?',
        'Each stroke is a unit, each diamond the median of its lot. Parts or process changed '
        'between lots that lie apart.',
        partial(draw_lots, f'{effect.label}, {effect.unit}', groups),
    )


def _drift_plate(drifts: Sequence[Drift]) -> tuple[str, str, str, Draw]:
    panels: dict[str, tuple[Floats, Floats]] = {}
    for words in ('bias', 'scale factor'):
        by_axis = [
            [next(c for c in one.changes if c.label == f'{words} {axis}') for axis in AXES]
            for one in drifts
        ]
        change = np.array([[c.change for c in row] for row in by_axis])
        sd = np.array([[c.sd for c in row] for row in by_axis])
        panels[f'change of the {words}, {by_axis[0][0].unit}'] = (change, sd)
    return (
        'drift',
        'What changed since the last test?',
        'Bias and scale factor at the reference temperature, the later test minus the earlier; '
        'bars are two standard deviations of both fits. The surest changes first.',
        partial(draw_changes, [one.serial for one in drifts], panels),
    )
