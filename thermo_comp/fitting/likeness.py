# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the correlation of the columns of two terms in the bags, and the advice to record a bag in
which these columns are less correlated.

In one environment the board follows the case in the same way in all bags. A lag of the board
temperature is then proportional to a lag of the gradient T_case - T_board, and both describe the
bags equally well. In another environment the ratio of the two lags differs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .data_checks import POSITIONS_NEEDED, Finding, advice
from .elimination import factored, solved
from .regression import Point
from .selection import Fit
from .windows import CURVE, PART

# Largest variance inflation 1 / (1 - r^2) at which the bags count as separating two columns of
# correlation r. One column leaves sqrt(1 - r^2) of the other column's RMS undescribed, a tenth at
# an inflation of 100. Errors of thermometers may have as large an effect on a column: a
# thermometer that lags by 60 s changes a lag of 600 s by a tenth.
_LARGEST_INFLATION = 100.0


class _Pair(NamedTuple):
    """Groups, parts and names (in messages) of two terms, and the bag that would separate them."""

    groups: tuple[str, str]
    parts: tuple[str, str]
    names: tuple[str, str]
    bag: str


_PARTS = ('bias', 'scale')
_BIAS = ('bias', 'bias')
_LAG = 'a lag of the board temperature'
_FLOW = 'in which the board follows the case in another way, such as with the fan off'
_TURN = 'of the whole temperature program with this axis at another angle to the vertical'
_PAIRS = (
    _Pair(('board', 'gradient_lag'), _BIAS, (_LAG, 'a lag of T_case - T_board'), _FLOW),
    _Pair(('board', 'gradient'), _BIAS, (_LAG, 'T_case - T_board'), _FLOW),
    _Pair((CURVE, CURVE), _PARTS, ('changes of the bias', 'changes of the scale factor'), _TURN),
)


@dataclass(frozen=True)
class Likeness:
    """
    The largest correlation of a column of one term with a column of another term, on one axis.

    The constants, the curve over temperature and all unknowns of bags and positions are eliminated
    from the columns first. If the model has both columns, the variance of each weight is
    `inflation` times its variance in a model with one of the columns.

    groups, parts: group of columns and part (``bias`` or ``scale``) of each term
    """

    groups: tuple[str, str]
    parts: tuple[str, str]
    axis: str
    correlation: float

    @property
    def inflation(self) -> float:
        """Variance inflation factor."""
        return 1.0 / max(1.0 - self.correlation**2, 1e-12)


def likenesses(fit: Fit) -> tuple[Likeness, ...]:
    """Return correlations for all pairs of terms with at least one term in the chosen model."""
    trials = [trial for trial in fit.selected.trials if trial.is_chosen]
    if fit.typical is None or not trials:
        # With a prior calibration, or for Golovach's model, the fit selects no columns.
        return ()
    regression, prior, typical = fit.regression, fit.posterior.prior, trials[0].typical
    groups, is_active = np.array(regression.windows.groups), prior.column_sd > 0.0
    used = set(groups[is_active.any(axis=0)].tolist())
    if PART in used:
        # A curve over the temperature of a part contains a curve and a lag of the board.
        used |= {CURVE, 'board'}
    groups[groups == PART] = CURVE
    terms = {group for pair in _PAIRS for group in pair.groups if used & {*pair.groups}}
    is_offered = np.isin(groups, [*(terms - {CURVE})]) & np.array([[True], [False]])
    is_offered &= (typical > 0.0) & ~is_active
    column_sd = np.where(is_offered, typical, prior.column_sd)
    regression.whiten(prior.noise)
    point = regression.at(fit.posterior.state, replace(prior, column_sd=column_sd))
    try:
        pairs = [_likeness(point, groups, pair) for pair in _PAIRS if used & {*pair.groups}]
    except np.linalg.LinAlgError:
        # The fit has succeeded: a rounding error in this table must not turn it into a failure.
        return ()
    return tuple(likeness for likeness in pairs if likeness is not None)


def _likeness(point: Point, groups: NDArray[np.str_], pair: _Pair) -> Likeness | None:
    """Return the largest correlation of the columns of a pair; None if a term has no column."""
    layout, n = point.layout, point.layout.n_unit
    root = point.precision[:n] ** -0.5
    # Posterior precision of the unit's unknowns, each unknown divided by its prior sd.
    information = point.reduced.matrix[:n, :n] * np.outer(root, root) + np.eye(n)
    acts = point.regression.windows.share == 1.0  # whether each column acts on an axis, (3, m)
    curve = layout.weights[:, :, groups == CURVE]
    others = np.append(np.setdiff1d(np.arange(n), layout.weights), curve[curve >= 0])
    result = []
    for axis in range(3):
        terms = []
        for group, part in zip(pair.groups, pair.parts, strict=True):
            places = layout.weights[_PARTS.index(part), axis]
            terms.append(places[(groups == group) & acts[axis] & (places >= 0)])
        both, k = np.concatenate(terms), len(terms[0])
        if 0 < k < len(both):
            rest = np.setdiff1d(others, both)
            cross = information[np.ix_(rest, both)]
            factor = factored(information[np.ix_(rest, rest)])
            matrix = information[np.ix_(both, both)] - cross.T @ solved(factor, cross)
            sd = np.sqrt(np.diag(matrix))
            largest = np.abs(matrix[:k, k:] / np.outer(sd[:k], sd[k:])).max()
            result.append(Likeness(pair.groups, pair.parts, 'xyz'[axis], min(float(largest), 1.0)))
    return max(result, key=lambda likeness: likeness.correlation, default=None)


def judge_likeness(pairs: Sequence[Likeness], n_directions: int) -> Iterator[Finding]:
    """Advise a bag to separate the two most correlated terms if their inflation is too large."""
    alike = [pair for pair in pairs if pair.inflation > _LARGEST_INFLATION]
    if n_directions < POSITIONS_NEEDED:
        # The finding `positions` reports already that bias and scale are not separated.
        alike = [pair for pair in alike if pair.parts[0] == pair.parts[1]]
    if not alike:
        return
    worst = max(alike, key=lambda pair: pair.inflation)
    texts = next(pair for pair in _PAIRS if pair.groups == worst.groups)
    yield advice(
        'alike',
        f'on axis {worst.axis} the bags do not tell {texts.names[0]} from {texts.names[1]} '
        f'(correlation {worst.correlation:.5f}; in a model with both, the sd of a weight is '
        f'{worst.inflation**0.5:.0f} times its sd in a model with one): record a bag {texts.bag}',
    )
