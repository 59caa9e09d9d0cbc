# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the statistics of a fleet table: robust spreads, outliers, drift."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from ..judging.evaluation import Drift
from ..judging.verdicts import Verdict
from ..typing import Floats
from .table import COLUMNS, Column, Row, is_fitted

_FALSE_ALARMS = 0.05
# Smallest number of units for which outliers are sought.
_UNITS_NEEDED = 8
# Efficiency of the median absolute deviation for a normal spread, relative to the sample sd.
_MAD_EFFICIENCY = 0.37
#: The columns in which units are compared.
QUANTITIES = tuple(column for column in COLUMNS if column.label)


class Spread(NamedTuple):
    """Spread of a quantity about its median, and each unit's distance in robust sd."""

    quantity: Column
    names: tuple[str, ...]
    values: Floats
    middle: float
    sd: float  # 1.4826 times the median absolute deviation (of the logarithm for sizes)
    z: Floats


@dataclass(frozen=True)
class Outlier:
    """A unit that is `z` standard deviations away from the fleet's median `middle`."""

    name: str
    serial: str
    label: str
    value: float
    middle: float
    z: float
    unit: str


@dataclass(frozen=True)
class Retest:
    """Changes between two tests of a unit, and whether they are significant."""

    serial: str
    earlier: str
    later: str
    days: float
    changes: tuple[Drift, ...]
    is_significant: bool

    @property
    def worst(self) -> Drift:
        """The most significant change."""
        return max(self.changes, key=_sds)


@dataclass(frozen=True)
class Summary:
    """Statistics of a fleet: units by verdict; outliers and drifts, most significant first."""

    verdicts: dict[str, int]
    spreads: tuple[Spread, ...]
    limit: float  # smallest distance of an outlier in robust sd; infinite with too few units
    outliers: tuple[Outlier, ...]
    drifts: tuple[Retest, ...]


def summarise(rows: Sequence[Row], earlier: Sequence[Row] = ()) -> Summary:
    """Compute the statistics of a fleet; drifts are changes since the rows of earlier tables."""
    fitted = [row for row in rows if is_fitted(row)]
    spreads = tuple(spread for quantity in QUANTITIES if (spread := spread_of(quantity, fitted)))
    limit = outlier_limit(len(fitted), len(spreads))
    serials = {str(row['name']): str(row['serial']) for row in fitted}
    outliers = [
        Outlier(name, serials[name], one.quantity.label, value, one.middle, z, one.quantity.unit)
        for one in spreads
        for name, value, z in zip(one.names, one.values.tolist(), one.z.tolist(), strict=True)
        if abs(z) > limit
    ]
    wide = Verdict.WIDE.value
    # Drop the amount from the verdict, so that equal verdicts count together.
    texts = (str(row['verdict']) for row in rows)
    verdicts = (f'{wide} little' if text.startswith(wide) else text for text in texts)
    return Summary(
        verdicts=dict(Counter(verdicts)),
        spreads=spreads,
        limit=limit,
        outliers=tuple(sorted(outliers, key=lambda outlier: -abs(outlier.z))),
        drifts=tuple(_drifts(fitted, [row for row in earlier if is_fitted(row)])),
    )


def spread_of(quantity: Column, rows: Sequence[Row]) -> Spread | None:
    """Measure the spread of a quantity over calibrated units; None if no unit has it."""
    known = [row for row in rows if row[quantity.name] is not None]
    if not known:
        return None
    values = np.array([row[quantity.name] for row in known], dtype=np.float64)
    if quantity.by == 'ppm':
        values = (values / np.median(values) - 1.0) * 1e6
    is_size = quantity.by == 'logarithm'
    compared = np.log(np.maximum(values, 1e-12)) if is_size else values
    away = compared - np.median(compared)
    middle, sd = float(np.median(values)), 1.4826 * float(np.median(np.abs(away)))
    z = away / sd if sd > 0.0 else np.zeros_like(away)
    names = tuple(str(row['name']) for row in known)
    return Spread(quantity, names, values, middle, sd * middle if is_size else sd, z)


def outlier_limit(n_units: int, n_quantities: int) -> float:
    """Return the limit of an outlier by Student's t; infinite below eight units."""
    from scipy.stats import t

    if n_units < _UNITS_NEEDED or not n_quantities:
        return float('inf')
    share = 0.5 * _FALSE_ALARMS / (n_units * n_quantities)
    return float(t.isf(share, _MAD_EFFICIENCY * n_units))


def _drifts(rows: Sequence[Row], earlier: Sequence[Row]) -> list[Retest]:
    from scipy.stats import norm

    tests = [
        (str(row['serial']), str(row['start']), f'{source}{row["name"]}', row)
        for source, some in (('earlier ', earlier), ('', rows))
        for row in some
    ]
    pairs = [
        (before, after)
        for before, after in pairwise(sorted(tests, key=itemgetter(0, 1, 2)))
        if before[0] == after[0]
        and before[3]['calibration_sha256'] != after[3]['calibration_sha256']
    ]
    compared = [quantity for quantity in QUANTITIES if quantity.sd]
    limit = norm.isf(0.5 * _FALSE_ALARMS / max(len(pairs) * len(compared), 1))
    drifts = []
    for (serial, begun, before, old), (_, again, after, new) in pairs:
        changes = []
        for column in compared:
            was, was_sd, now, now_sd = np.array(
                [row[name] for row in (old, new) for name in (column.name, column.sd)], np.float64
            ).tolist()
            change = (now / was - 1.0) * 1e6 if column.by == 'ppm' else now - was
            sd = np.nan_to_num(np.hypot(was_sd, now_sd)).item()
            changes.append(Drift(before, after, column.label, column.unit, change, sd))
        is_significant = any(_sds(change) > limit for change in changes)
        days = _days(begun, again)
        drifts.append(Retest(serial, before, after, days, tuple(changes), is_significant))
    return sorted(drifts, key=lambda drift: -_sds(drift.worst))


def _sds(drift: Drift) -> float:
    """Return the size of a change in its standard deviations; 0 if its sd is not known."""
    return abs(drift.change) / drift.sd if drift.sd > 0.0 else 0.0


def _days(begun: str, again: str) -> float:
    try:
        first, second = (datetime.fromisoformat(start.rstrip('Z')) for start in (begun, again))
    except ValueError:
        return float('nan')
    return (second - first).total_seconds() / 86400.0
