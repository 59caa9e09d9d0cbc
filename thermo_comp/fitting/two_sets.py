# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the paper's two sets learn: whether the static one bends, what the dynamic one may keep.

While a unit warms, its lags shift bias and scale one way, while it cools the other way. A set
that is told apart by the flag alone can hold only what both have in common; fitted without care
it takes on the direction of which the bags happen to hold more, and is then the wrong set for
half of the ramps to come. So the part that goes with the rate is estimated beside the dynamic
set, and left out of it.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..typing import Floats
from .regression import Freedom, Outcome, regress
from .table import WindowTable

#: The paper's static set is linear; a bend must leave less than this part of its soaks' residual.
WORTH_A_BEND = 0.9
_FEWEST_WINDOWS = 5


def may_bend(table: WindowTable) -> bool:
    """
    Tell whether soaks lie in each third of the temperatures: a parabola needs three.

    Parameters
    ----------
    table : WindowTable
        The windows.

    Returns
    -------
    bool
        Whether a curved static set is worth trying.

    """
    edges = np.linspace(float(np.min(table.t)), float(np.max(table.t)), 4)
    third = np.searchsorted(edges[1:-1], table.t[~table.is_dynamic])
    return bool(np.all(np.bincount(third, minlength=3) >= _FEWEST_WINDOWS))


def is_worth_a_bend(straight: Outcome, bent: Outcome) -> bool:
    """
    Tell whether the soaks are clearly better described by a curved static set.

    Parameters
    ----------
    straight, bent : Outcome
        The two fits.

    Returns
    -------
    bool
        True for the bent one.

    """
    return _static_rms(bent) < WORTH_A_BEND * _static_rms(straight)


def _static_rms(outcome: Outcome) -> float:
    solution = outcome.solution
    return float(np.sqrt(np.mean((solution.noise_sd[0] / solution.scale[:, 0]) ** 2)))


def even_handed(table: WindowTable, outcome: Outcome, freedom: Freedom) -> Outcome:
    """
    Keep out of the dynamic set what goes with the rate.

    Parameters
    ----------
    table : WindowTable
        The windows.
    outcome : Outcome
        A fit of two sets without further terms.
    freedom : Freedom
        What it was free to move.

    Returns
    -------
    Outcome
        The sets of the same model, fitted beside a term in the rate, without that term; the
        attitudes are those that fit these sets. The information stays that of the given fit.

    """
    plain = outcome.solution
    spec = plain.spec
    if spec.dynamic is None or not _has_both_directions(table):
        return outcome
    beside = replace(spec, rate=True, live='dynamic')
    start = replace(plain, spec=beside, bias=_padded(plain.bias), scale=_padded(plain.scale))
    found = regress(table, start, freedom).solution
    sets = replace(
        found, spec=spec, bias=found.bias[:, :-1], scale=found.scale[:, :-1],
        noise_sd=plain.noise_sd,
    )  # fmt: skip
    held = Freedom(misalignment=False, lags=False, start_memory=False, axes=False, transient=False)
    settled = regress(table, sets, held, max_rounds=1)
    return replace(
        outcome,
        solution=settled.solution,
        cost=settled.cost,
        residual=settled.residual,
        robust_weight=settled.robust_weight,
    )


def _has_both_directions(table: WindowTable) -> bool:
    rate = table.rate[table.is_dynamic]
    fewest = min(np.count_nonzero(rate > 0.0), np.count_nonzero(rate < 0.0))
    return bool(fewest >= _FEWEST_WINDOWS)


def _padded(parameters: Floats) -> Floats:
    return np.pad(parameters, ((0, 0), (0, 1)))
