# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the ladder: the candidate models and their names.

A name is ``FUNCTION[+TERM...][@dynamic]``, or ``golovach`` for the paper's own scheme.

"""

from __future__ import annotations

import numpy as np

from ..errors import FitError
from ..unit.functions import CubicSpline, Exponential, TemperatureFunction
from .model import ModelSpec, polynomial
from .table import WindowTable

FUNCTION_NAMES = ('constant', 'linear', 'quadratic', 'cubic', 'spline', 'exponential')
TERM_NAMES = ('', 'rate', 'gradient', 'memory1', 'memory2', 'gradient+memory1')
#: E-folds that an exponential is tried with [K].
E_FOLDS_K = (-60.0, -30.0, -15.0, 15.0, 30.0, 60.0)
_N_SPLINE_KNOTS = 5


def golovach_spec() -> ModelSpec:
    """
    Give the paper's scheme: static linear, dynamic quadratic, told apart by the flag alone.

    Where the soaks show a bend, the selection gives the static set one, too.

    """
    return ModelSpec('golovach', polynomial(1), polynomial(2))


def model_spec(name: str, table: WindowTable) -> ModelSpec:
    """
    Make a model from its name.

    Parameters
    ----------
    name : str
        ``golovach`` or ``FUNCTION[+TERM...][@dynamic]``: the function one of `FUNCTION_NAMES`,
        terms ``rate``, ``gradient``, ``memory1``, ``memory2``; ``@dynamic`` keeps the terms out
        of the static set.
    table : WindowTable
        Gives the range for knots.

    Returns
    -------
    ModelSpec
        The model.

    Raises
    ------
    FitError
        If the name is not understood.

    """
    if name == 'golovach':
        return golovach_spec()
    body, _, live = name.partition('@')
    function, *terms = body.split('+')
    known = {'rate', 'gradient', 'memory1', 'memory2'}
    n_memory = sum(term.startswith('memory') for term in terms)
    if (
        function not in FUNCTION_NAMES
        or not known.issuperset(terms)
        or live not in ('', 'dynamic')
        or n_memory > 1
    ):
        raise FitError(
            f"model '{name}' is not known: give auto, golovach, or one of "
            f'{"|".join(FUNCTION_NAMES)}, with +rate, +gradient, +memory1 or +memory2 as wanted'
        )
    lags = next((int(term[-1]) for term in terms if term.startswith('memory')), 0)
    return ModelSpec(
        name=name,
        static=function_shape(function, table),
        gradient='gradient' in terms,
        rate='rate' in terms,
        n_lags=lags,
        live='dynamic' if live else 'both',
    )


def function_shape(name: str, table: WindowTable) -> TemperatureFunction:
    """
    Make the shape of a function family over a table's temperatures.

    Parameters
    ----------
    name : str
        One of `FUNCTION_NAMES`.
    table : WindowTable
        Gives the range.

    Returns
    -------
    TemperatureFunction
        The shape; an exponential's e-fold is a first guess.

    """
    orders = {'constant': 0, 'linear': 1, 'quadratic': 2, 'cubic': 3}
    if name in orders:
        return polynomial(orders[name])
    if name == 'exponential':
        return Exponential(0.0, (0.0,), (E_FOLDS_K[3],))
    lower, upper = float(np.min(table.t)), float(np.max(table.t))
    upper = max(upper, lower + 1.0)
    knots = np.linspace(lower, upper, _N_SPLINE_KNOTS)
    # The reference is a knot: the one nearest moves there, or the outermost when it lies outside.
    nearest = int(np.argmin(np.abs(knots)))
    if lower < 0.0 < upper:
        knots[nearest] = 0.0
        values = knots
    else:
        values = np.sort(np.append(knots, 0.0))
    return CubicSpline(tuple(values.tolist()), (0.0,) * len(values))
