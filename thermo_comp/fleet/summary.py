# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a fleet table tells: spreads, units that stand out, drift.

Spreads are robust (median and median absolute deviation), because the units that stand out are in
them. Every limit is set so that a fleet without anything to find raises an alarm once in twenty.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise

import numpy as np

from ..judging import Verdict
from ..typing import Floats
from ..unit.calibration import AXES
from .table import Row, is_fitted

_FALSE_ALARMS = 0.05
# Fewer units have no spread to stand out of.
_UNITS_NEEDED = 8
# A median absolute deviation knows the spread as well as 0.37 n values do with their squares.
_MAD_EFFICIENCY = 0.37


@dataclass(frozen=True)
class Quantity:
    """What units are compared in: relative in ppm of the median, sizes by their logarithm."""

    column: str
    label: str
    unit: str
    is_relative: bool = False
    is_size: bool = False
    sd: str = ''


def _axes(pattern: str, label: str, unit: str, sd: str = '', **kind: bool) -> list[Quantity]:
    return [
        Quantity(pattern.format(a), f'{label} {a}', unit, sd=sd.format(a), **kind) for a in AXES
    ]


QUANTITIES: tuple[Quantity, ...] = (
    *_axes('scale_{}', 'scale factor', 'ppm', 'scale_sd_{}_ppm', is_relative=True),
    *_axes('scale_slope_{}_ppm_k', 'slope of scale', 'ppm/K'),
    *_axes('bias_{}_ug', 'bias', 'µg', 'bias_sd_{}_ug'),
    *_axes('bias_slope_{}_ug_k', 'slope of bias', 'µg/K'),
    *(
        Quantity(f'm_{ij}_urad', f'M[{ij[0]}][{ij[1]}]', 'µrad', sd=f'm_sd_{ij}_urad')
        for ij in ('10', '20', '21')
    ),
    *_axes('noise_{}_ug_sqrt_hz', 'noise', 'µg/√Hz', is_size=True),
    Quantity('static_ug', 'residual, static', 'µg', is_size=True),
    Quantity('dynamic_ug', 'residual, dynamic', 'µg', is_size=True),
)


@dataclass(frozen=True)
class Spread:
    """
    How a quantity is spread: `z`, shape (n,), is the distance from the median `middle` in `sd`.

    `sd` is 1.4826 times the median absolute deviation; of a size, of its logarithm.
    """

    quantity: Quantity
    names: tuple[str, ...]
    values: Floats
    middle: float
    sd: float
    z: Floats


@dataclass(frozen=True)
class Outlier:
    """A unit that stands out by `z` standard deviations from the fleet's `middle`."""

    name: str
    serial: str
    label: str
    value: float
    middle: float
    z: float
    unit: str


@dataclass(frozen=True)
class Change:
    """One quantity, the later test minus the earlier, with the sd that both fits claim."""

    label: str
    unit: str
    change: float
    sd: float

    @property
    def z(self) -> float:
        """Change over its standard deviation."""
        return self.change / self.sd if self.sd > 0.0 else 0.0


@dataclass(frozen=True)
class Drift:
    """What changed between two tests of a unit, and whether by more than chance."""

    serial: str
    earlier: str
    later: str
    days: float
    changes: tuple[Change, ...]
    is_significant: bool

    @property
    def worst(self) -> Change:
        """The surest change."""
        return max(self.changes, key=lambda one: abs(one.z))


@dataclass(frozen=True)
class Summary:
    """
    What a fleet table tells: units by verdict, spreads, outliers and drifts, the surest first.

    Beyond `limit` standard deviations a unit stands out; infinite where too few units tell.
    """

    verdicts: dict[str, int]
    spreads: tuple[Spread, ...]
    limit: float
    outliers: tuple[Outlier, ...]
    drifts: tuple[Drift, ...]


def summarise(rows: Sequence[Row], earlier: Sequence[Row] = ()) -> Summary:
    """Look at a fleet as a whole; rows of earlier tables tell what drifted."""
    fitted = [row for row in rows if is_fitted(row)]
    spreads = tuple(spread for one in QUANTITIES if (spread := spread_of(one, fitted)) is not None)
    limit = outlier_limit(len(fitted), len(spreads))
    serials = {str(row['name']): str(row['serial']) for row in fitted}
    outliers = [
        Outlier(name, serials[name], one.quantity.label, value, one.middle, z, one.quantity.unit)
        for one in spreads
        for name, value, z in zip(one.names, one.values.tolist(), one.z.tolist(), strict=True)
        if abs(z) > limit
    ]
    return Summary(
        verdicts=dict(Counter(_kind(str(row['verdict'])) for row in rows)),
        spreads=spreads,
        limit=limit,
        outliers=tuple(sorted(outliers, key=lambda one: -abs(one.z))),
        drifts=tuple(_drifts(fitted, [row for row in earlier if is_fitted(row)])),
    )


def spread_of(quantity: Quantity, rows: Sequence[Row]) -> Spread | None:
    """Measure the spread of a quantity over calibrated units; None where no unit has it."""
    pairs = [(str(row['name']), _number(row[quantity.column])) for row in rows]
    pairs = [(name, value) for name, value in pairs if np.isfinite(value)]
    if not pairs:
        return None
    values = np.array([value for _, value in pairs])
    if quantity.is_relative:
        values = (values / np.median(values) - 1.0) * 1e6
    middle = float(np.median(values))
    compared = np.log(np.maximum(values, 1e-12)) if quantity.is_size else values
    away = compared - np.median(compared)
    sd = 1.4826 * float(np.median(np.abs(away)))
    z = away / sd if sd > 0.0 else np.zeros_like(away)
    return Spread(
        quantity,
        tuple(name for name, _ in pairs),
        values,
        middle,
        sd * middle if quantity.is_size else sd,
        z,
    )


def outlier_limit(n_units: int, n_quantities: int) -> float:
    """Give the distance of Student's t beyond which a unit stands out; infinite below eight."""
    from scipy.stats import t

    if n_units < _UNITS_NEEDED or not n_quantities:
        return float('inf')
    share = 0.5 * _FALSE_ALARMS / (n_units * n_quantities)
    return float(t.isf(share, _MAD_EFFICIENCY * n_units))


def _drifts(rows: Sequence[Row], earlier: Sequence[Row]) -> list[Drift]:
    from scipy.stats import norm

    by_serial: dict[str, list[tuple[str, str, Row]]] = defaultdict(list)
    for source, found in (('earlier ', earlier), ('', rows)):
        for row in found:
            by_serial[str(row['serial'])].append(
                (str(row['start']), f'{source}{row["name"]}', row)
            )
    pairs = [
        (serial, before, after)
        for serial, tests in sorted(by_serial.items())
        for before, after in pairwise(sorted(tests, key=lambda test: test[:2]))
        if before[2]['calibration_sha256'] != after[2]['calibration_sha256']
    ]
    compared = [quantity for quantity in QUANTITIES if quantity.sd]
    limit = norm.isf(0.5 * _FALSE_ALARMS / max(len(pairs) * len(compared), 1))
    drifts = []
    for serial, (_, name, old), (_, later, new) in pairs:
        changes = tuple(_change(quantity, old, new) for quantity in compared)
        drifts.append(
            Drift(
                serial,
                name,
                later,
                _days(old, new),
                changes,
                any(abs(one.z) > limit for one in changes),
            )
        )
    return sorted(drifts, key=lambda one: -abs(one.worst.z))


def _change(quantity: Quantity, old: Row, new: Row) -> Change:
    before, after = _number(old[quantity.column]), _number(new[quantity.column])
    change = (after / before - 1.0) * 1e6 if quantity.is_relative else after - before
    sd = float(np.hypot(_number(old[quantity.sd]), _number(new[quantity.sd])))
    return Change(quantity.label, quantity.unit, change, sd if np.isfinite(sd) else 0.0)


def _days(old: Row, new: Row) -> float:
    try:
        starts = [datetime.fromisoformat(str(row['start']).rstrip('Z')) for row in (old, new)]
    except ValueError:
        return float('nan')
    return (starts[1] - starts[0]).total_seconds() / 86400.0


def _kind(verdict: str) -> str:
    """Leave the amount out of a verdict, so that like ones count together."""
    wide = Verdict.WIDE.value
    return f'{wide} little' if verdict.startswith(wide) else verdict


def _number(cell: object) -> float:
    return float(cell) if isinstance(cell, (int, float)) else float('nan')
