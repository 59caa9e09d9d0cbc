# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the statistics of a fleet: robust spreads over units, outliers, drift between tests."""

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
from ..typing import Bools, Floats
from .table import COLUMNS, Row, TableColumn, is_fitted

_FALSE_ALARMS = 0.05  # probability of any false outlier, and of any false drift, in a fleet
_UNITS_NEEDED = 8  # smallest number of units of a fleet that is searched for outliers
# Efficiency of the median absolute deviation relative to the sample sd, for a normal distribution.
_MAD_EFFICIENCY = 0.37
# Largest sd of a value by the fit / spread of the values over the units, for a value that the
# unit's data determine; a value with a larger sd is near the prior mean of the fit.
_LARGEST_SD = 5.0
# Smallest residual [ug] or noise [ug/sqrt(Hz)] in a logarithm; it replaces smaller values.
_LEAST = 1e-12
#: Columns of the table in which units are compared.
QUANTITIES = tuple(column for column in COLUMNS if column.label)
#: Columns of bias, scale and misalignment; their changes between two tests of a unit are drift.
_CONSTANTS = tuple(column for column in QUANTITIES if column.sd and '_slope_' not in column.name)


class Spread(NamedTuple):
    """
    Spread of a quantity over the units about the median `middle`, and distance `z` of each unit.

    Only units whose data determine the quantity (`is_counted`) are used for `middle`, `sd` and
    `limit`. A distance `z` is the deviation from the median divided by ``sqrt(sd^2 + s^2)``; s: sd
    of the value by the unit's fit.
    """

    quantity: TableColumn
    names: tuple[str, ...]
    values: Floats
    is_counted: Bools
    middle: float
    sd: float  # 1.4826 median |deviation|; times `middle` if deviations are of logarithms
    z: Floats
    limit: float = float('inf')  # smallest |z| of an outlier; infinite below eight units

    @property
    def counted(self) -> Floats:
        """The values of the units whose data determine the quantity."""
        return np.asarray(self.values[self.is_counted])


@dataclass(frozen=True)
class Outlier:
    """A unit whose value of a quantity is `z` sd from the fleet's median `middle`."""

    name: str
    serial: str
    label: str
    value: float
    middle: float
    z: float
    unit: str
    limit: float


@dataclass(frozen=True)
class Retest:
    """Changes of bias, scale, misalignment of a unit from one test to the next."""

    serial: str
    earlier: str
    later: str
    days: float
    changes: tuple[Drift, ...]
    is_significant: bool

    @property
    def worst(self) -> Drift:
        """The change with the largest ratio to its standard deviation."""
        return max(self.changes, key=_sds)


@dataclass(frozen=True)
class Summary:
    """Number of units by verdict; outliers and drifts, the largest deviation in sd first."""

    verdicts: dict[str, int]
    spreads: tuple[Spread, ...]
    outliers: tuple[Outlier, ...]
    drifts: tuple[Retest, ...]


def summarise(rows: Sequence[Row], earlier: Sequence[Row] = ()) -> Summary:
    """Compute the statistics of a fleet; `earlier`: rows of earlier tables, to find drifts."""
    fitted = [row for row in rows if is_fitted(row)]
    measured = [spread for quantity in QUANTITIES if (spread := spread_of(quantity, fitted))]
    n_comparisons = sum(len(spread.names) for spread in measured)
    spreads = tuple(
        spread._replace(limit=outlier_limit(len(spread.counted), n_comparisons))
        for spread in measured
    )
    serials = {str(row['name']): str(row['serial']) for row in fitted}
    outliers = []
    for spread in spreads:
        label, unit, middle = spread.quantity.label, spread.quantity.unit, spread.middle
        for k in np.flatnonzero(np.abs(spread.z) > spread.limit):
            name, value, z = spread.names[k], float(spread.values[k]), float(spread.z[k])
            about = label, value, middle, z, unit, spread.limit
            outliers.append(Outlier(name, serials[name], *about))
    wide = Verdict.WIDE.value
    # The verdict WIDE contains a number, which is replaced to count all such units together.
    texts = (str(row['verdict']) for row in rows)
    verdicts = (f'{wide} little' if text.startswith(wide) else text for text in texts)
    return Summary(
        verdicts=dict(Counter(verdicts)),
        spreads=spreads,
        outliers=tuple(sorted(outliers, key=lambda outlier: -abs(outlier.z))),
        drifts=tuple(_drifts(fitted, [row for row in earlier if is_fitted(row)])),
    )


def spread_of(quantity: TableColumn, rows: Sequence[Row]) -> Spread | None:
    """Measure the spread of a quantity over units; None if no unit determines the quantity."""
    columns = [name for name in (quantity.name, quantity.sd) if name]
    known = [row for row in rows if all(row[name] is not None for name in columns)]
    values = np.array([row[quantity.name] for row in known], np.float64)
    own_sd = np.array([row[quantity.sd] if quantity.sd else 0.0 for row in known], np.float64)
    is_counted = _determined(quantity, values, own_sd)
    if not is_counted.any():
        return None
    middle = float(np.median(values[is_counted]))
    deviations = _deviations(quantity, values, middle)
    sd = _robust_sd(deviations[is_counted])
    claimed = np.hypot(sd, own_sd)
    z = np.divide(deviations, claimed, out=np.zeros_like(deviations), where=claimed > 0.0)
    names = tuple(str(row['name']) for row in known)
    if quantity.by == 'ppm':
        values, middle = deviations, 0.0
    elif quantity.by == 'logarithm':
        sd *= middle
    return Spread(quantity, names, values, is_counted, middle, sd, z)


def _determined(quantity: TableColumn, values: Floats, own_sd: Floats) -> Bools:
    """
    Choose the units whose data determine a quantity: units are added in the order of their sd by
    the fit, until the sd of the next unit exceeds five times the spread of the units up to it.
    """
    order = np.argsort(own_sd, kind='stable')
    n = len(values)
    first = min(_UNITS_NEEDED, n // 2 + 1)  # number of units whose spread is computed first
    n_counted = 0
    for k in range(first, n + 1):
        best = values[order[:k]]
        spread = _robust_sd(_deviations(quantity, best, float(np.median(best))))
        if own_sd[order[k - 1]] > _LARGEST_SD * spread:
            break
        n_counted = k
    is_counted = np.zeros(n, dtype=np.bool_)
    is_counted[order[:n_counted]] = True
    return is_counted


def _deviations(quantity: TableColumn, values: Floats, middle: float) -> Floats:
    """Return deviations from the median: of values, in ppm or of logarithms, see `quantity.by`."""
    if quantity.by == 'ppm':
        return (values / middle - 1.0) * 1e6
    if quantity.by == 'logarithm':
        return np.asarray(np.log(np.maximum(values, _LEAST) / max(middle, _LEAST)))
    return values - middle


def _robust_sd(deviations: Floats) -> float:
    return 1.4826 * float(np.median(np.abs(deviations)))


def outlier_limit(n_units: int, n_comparisons: int) -> float:
    """Return the smallest |z| of an outlier, by Student's t; infinite below eight units."""
    from scipy.stats import t

    if n_units < _UNITS_NEEDED or not n_comparisons:
        return float('inf')
    return float(t.isf(0.5 * _FALSE_ALARMS / n_comparisons, _MAD_EFFICIENCY * n_units))


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
    limit = norm.isf(0.5 * _FALSE_ALARMS / max(len(pairs) * len(_CONSTANTS), 1))
    drifts = []
    for (serial, begun, before, old), (_, again, after, new) in pairs:
        changes = []
        for column in _CONSTANTS:
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
    """Return the magnitude of a change divided by its sd; 0 if the sd is unknown."""
    return abs(drift.change) / drift.sd if drift.sd > 0.0 else 0.0


def _days(begun: str, again: str) -> float:
    try:
        first, second = (datetime.fromisoformat(start.rstrip('Z')) for start in (begun, again))
    except ValueError:
        return float('nan')
    return (second - first).total_seconds() / 86400.0
