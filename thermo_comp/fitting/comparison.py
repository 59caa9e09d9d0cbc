# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the comparison of two models on left-out data.

A model is better if it reduces the error by more than the standard error over the folds, both for
positions and for sections of the program. One that describes only one recording, or one program,
fails one of the two tests.

References
----------
.. [1] A. Vehtari, A. Gelman, J. Gabry, Practical Bayesian model evaluation using leave-one-out
   cross-validation, Statistics and Computing 27 (2017).

"""

from __future__ import annotations

from .left_out import Score

# Logarithms of mean squares that differ by less than this count as equal: 5 % of an RMS.
_EQUAL = 0.1
# Largest factor by which the RMS error of the two halves may rise: two folds scatter by a quarter.
_MOST_BY_HALVES = 1.25


def is_better(before: Score, after: Score, *, by_halves: bool = True) -> bool:
    """
    Whether the second model is better on left-out data by more than the standard error. Halves of
    the program limit the number of columns; they do not compare models of the same columns.
    """
    return gain(before, after, by_halves=by_halves) > 0.0


def gain(before: Score, after: Score, *, by_halves: bool = True) -> float:
    """
    Return the gain of a model if it exceeds its standard errors, else 0.

    It is the sum of the log gains of the drift. If the drifts are equal, the norms of left-out
    positions decide with a gain of two standard errors.
    """
    positions, sections, norms = _gains(before, after)
    drift = [one for one in (positions, sections) if one]
    is_worse_by_halves = by_halves and after.halves.rms > _MOST_BY_HALVES * before.halves.rms
    if (norms and norms[0] < -norms[1]) or is_worse_by_halves:
        return 0.0
    total = sum(gain for gain, _ in drift)
    if total > _EQUAL * len(drift) and all(gain > error for gain, error in drift):
        return total
    is_sure = norms is not None and norms[0] > max(2.0 * norms[1], _EQUAL)
    if is_sure and norms and all(abs(gain) < _EQUAL for gain, _ in drift):
        return norms[0]
    return 0.0


def is_undecided(before: Score, after: Score) -> bool:
    """Whether left-out data do not decide: equal drifts, and no norms scored in both models."""
    *drift, norms = _gains(before, after)
    return norms is None and all(abs(one[0]) < _EQUAL for one in drift if one)


def is_near(chosen: Score, other: Score) -> bool:
    """Whether a model is at most one standard error worse than the chosen one."""
    found = [one for one in _gains(chosen, other) if one]
    return bool(found) and all(gain > -error for gain, error in found)


def _gains(before: Score, after: Score) -> list[tuple[float, float] | None]:
    return [b.gain_of(a) for b, a in zip(before.kinds, after.kinds, strict=True)]
