# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Contains the limits of the benchmark `strangers.py`: rows of figures over several units, and the
limits that each row violates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from strangers_units import Floats


@dataclass(frozen=True)
class Score:
    """
    RMS figures of a unit, a model and a set of held-out bags; NaN where undefined.

    Parameters
    ----------
    norm, vector : float
        Error of ``|f| - g``, and length of the error vector (for drift: of an axis) [ug].
    norm_ratio, ratio : float
        RMS of error / claimed sd: of ``|f|``, and of the three axes.
    claim : float
        Claimed sd of the length of the error vector (for drift: of an axis) [ug].
    bound_ratio : float
        Error of the bias / its Cramer-Rao bound.

    """

    norm: float = np.nan
    vector: float = np.nan
    norm_ratio: float = np.nan
    ratio: float = np.nan
    claim: float = np.nan
    bound_ratio: float = np.nan


@dataclass(frozen=True)
class Result:
    """
    Scores of all models for a unit, a study and a set of held-out bags.

    Parameters
    ----------
    title : str
        Title of the row: case, study and held-out bags.
    unit : int
        Number of the unit.
    scores : dict of str to Score
        Scores by model; a model that refused the bags is absent.
    chosen : str
        Groups that the fit chose, each with its number of columns.
    fit_s : float
        CPU time of the fit [s].
    refused : str
        The error message of the fit; empty without an error.

    """

    title: str
    unit: int
    scores: Mapping[str, Score] = field(default_factory=dict)
    chosen: str = ''
    fit_s: float = np.nan
    refused: str = ''


@dataclass(frozen=True)
class Limit:
    """
    The limits of a row. By default the error may be up to 1.05 times the error of the best
    baseline, and the RMS of error / claimed sd up to 1.5.

    Parameters
    ----------
    norm, vector : float
        Largest errors of ``|f|`` and of the vector [ug].
    best : float
        Largest error / smallest error of the baselines, for the norm and for the vector.
    low, high : float
        Smallest and largest RMS over all units of error / claimed sd.
    unit : float
        Largest error / claimed sd of a single unit.
    claim : float
        Largest claimed sd / error.
    than, times : str, float
        End of the title of a second row of the case, and largest error / error of this second row.
    bound_ratio : float
        Largest error of the bias / its Cramer-Rao bound.

    """

    norm: float = np.inf
    vector: float = np.inf
    best: float = 1.05
    low: float = 0.0
    high: float = 1.5
    unit: float = np.inf
    claim: float = np.inf
    than: str = ''
    times: float = 1.0
    bound_ratio: float = np.inf


_ONE_THERMOMETER = Limit(norm=25.0, low=0.7, high=1.4)
_REAL_UNIT = Limit(norm=560.0, low=0.7, high=1.4)
_TURN_ON = Limit(low=0.7, high=1.4, unit=2.0)
#: Limits by the beginning of a row's title; of several matching keys the longest applies.
LIMITS = {
    'sample-bags': Limit(norm=1.3, vector=2.0, low=0.7, high=1.4),
    'no-case': _ONE_THERMOMETER,
    'board-twice': _ONE_THERMOMETER,
    'cats even to odd': _REAL_UNIT,
    'cats odd to even': _REAL_UNIT,
    'cats rests left out': Limit(high=1.4),
    'plain': Limit(norm=1.3, vector=2.0, low=0.7, high=1.4),
    'one-pose: own bag': Limit(vector=2.0, low=0.7, high=1.4),
    'one-pose: other program': Limit(vector=5.0, low=0.7, high=1.4),
    # `score` subtracts the smallest claimed variance of a bag, which in case 'returned' contains
    # the variance of a slope over temperature: error / claimed sd has no meaning and no limit.
    'returned': Limit(high=np.inf),
    'soaks': Limit(low=0.5, high=1.5, claim=3.0),
    'turn-on': _TURN_ON,
    'mems': _TURN_ON,
    # A single recording does not show how well turn-ons repeat: error / claimed sd has no limit.
    'sessions one': Limit(high=np.inf),
    'sessions two': Limit(low=0.7, high=1.4),
    # The error of an update may exceed the error of a joint fit by 5 %, as the two fits estimate
    # the sd of turn-ons from different recordings.
    'sessions update': Limit(than='two', times=1.05),
    'ageing': Limit(),
    'kink': Limit(norm=12.0),
    'gradient': Limit(norm=12.0),
    'bump': Limit(norm=60.0),
    'carry': Limit(),
    'support': Limit(vector=60.0),
    # Fit and baselines are given the same wrong gravity: only error / claimed sd is limited.
    'gravity': Limit(best=np.inf),
    'cold-start': Limit(),
    # The claimed sd includes flicker noise over times longer than the recordings, so the error
    # may be as small as half of the claimed sd.
    'flicker': Limit(low=0.5, high=1.4, unit=2.0),
    'slow-thermometer': Limit(),
    'coarse-thermometer': Limit(),
    'slow-drift': Limit(),
    'third-node alone': Limit(),
    # Adding a bag in still air to the fit may increase the error by 2 %, the noise of a fit.
    'third-node joint: chamber': Limit(than='alone: chamber', times=1.02),
    'third-node joint: still air': Limit(than='alone: still air', times=1.02),
    'third-node joint: its attitude': Limit(than='alone: its attitude', times=0.5),
    'third-node prior: chamber': Limit(than='alone: chamber', times=1.02),
    'third-node prior: still air': Limit(than='alone: still air', times=1.02),
    'third-node prior: its attitude': Limit(than='alone: its attitude', times=0.5),
    'bench3': Limit(norm=1.5, vector=2.5, high=1.4),
    'quadratic': Limit(bound_ratio=1.5, low=0.8, high=1.25),
}


@dataclass(frozen=True)
class Row:
    """
    A row of the results: a case, a study and held-out bags, with RMS figures over the units.

    Parameters
    ----------
    title : str
        Case, study and held-out bags.
    scores : dict of str to Score
        Scores by model: RMS over the units whose fit did not fail.
    worst : float
        Largest error / claimed sd of a single unit.
    fit_s : float
        Mean CPU time of a fit [s].
    chosen : str
        Groups that the fit chose for the last unit.
    refused : str
        The message of the first fit that refused its bags; empty without such a fit.

    """

    title: str
    scores: Mapping[str, Score]
    worst: float
    fit_s: float
    chosen: str
    refused: str


def rms(values: Floats | Sequence[float]) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def judged_ratio(score: Score) -> float:
    """Return error / claimed sd: of three axes or, without a known true force, of the norm."""
    return score.norm_ratio if np.isnan(score.ratio) else score.ratio


def rows_of(results: Sequence[Result]) -> list[Row]:
    """Return a row per title with the RMS of the scores over the units, in the results' order."""
    titles = list(dict.fromkeys(result.title for result in results))
    return [_row([result for result in results if result.title == title]) for title in titles]


def _row(results: Sequence[Result]) -> Row:
    models = list(dict.fromkeys(model for result in results for model in result.scores))
    scores = {}
    for model in models:
        units = [result.scores[model] for result in results if model in result.scores]
        scores[model] = Score(
            *(rms([getattr(unit, name) for unit in units]) for name in Score.__dataclass_fields__)
        )
    ratios = [judged_ratio(result.scores['fit']) for result in results if 'fit' in result.scores]
    times = [result.fit_s for result in results if result.fit_s == result.fit_s]
    return Row(
        results[0].title,
        scores,
        max(ratios, default=np.nan),
        float(np.mean(times)) if times else np.nan,
        results[-1].chosen,
        next((result.refused for result in results if result.refused), ''),
    )


def limit_of(title: str) -> Limit:
    """Return the limits of a row: the longest key with which its title begins determines them."""
    return LIMITS[max((key for key in LIMITS if title.startswith(key)), key=len)]


def best_baseline(row: Row, name: str) -> float:
    """Return the smallest error of a row's baselines; infinite if the row has no baseline."""
    errors = [getattr(score, name) for model, score in row.scores.items() if model != 'fit']
    return min((error for error in errors if np.isfinite(error)), default=np.inf)


def misses(row: Row, others: Sequence[Row]) -> list[str]:
    """Return a text for each limit that a row violates; `others` are all rows of the case."""
    exceeded = ['refused'] if row.refused else []
    if 'fit' not in row.scores:
        return exceeded
    limit, fit, ratio = limit_of(row.title), row.scores['fit'], judged_ratio(row.scores['fit'])
    checks = [
        ('norm', fit.norm, limit.norm),
        ('vector', fit.vector, limit.vector),
        ('ratio', ratio, limit.high),
        ('worst ratio', row.worst, limit.unit),
        ('claim / error', fit.claim / fit.vector, limit.claim),
        ('bias / bound', fit.bound_ratio, limit.bound_ratio),
    ]
    for name in ('norm', 'vector'):
        checks.append(
            (f'{name} / best', getattr(fit, name) / best_baseline(row, name), limit.best)
        )
        for other in others:
            if limit.than and other.title.endswith(limit.than) and 'fit' in other.scores:
                share = getattr(fit, name) / getattr(other.scores['fit'], name)
                checks.append((f'{name} / {limit.than}', share, limit.times))
    # An undefined figure, as the vector error without a true force, is NaN and violates no limit.
    exceeded += [f'{name} {value:.3g} > {most:g}' for name, value, most in checks if value > most]
    if ratio < limit.low:
        exceeded.append(f'ratio {ratio:.2g} < {limit.low:g}')
    return exceeded
