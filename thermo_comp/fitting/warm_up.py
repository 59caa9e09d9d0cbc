# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns warming-up: bags that begin before the unit has settled after it was switched on.

An oven that heats up moves bias and scale by thousands of ppm without any thermometer outside it
seeing why. Past its first part such a transient is one exponential; it is then estimated per bag
and axis beside everything else, which costs nothing where it is absent because it is modelled
only where it is found.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..unit.gravity import MICRO_G
from .ladder import model_spec
from .regression import Freedom, Outcome
from .selection import fit_model
from .start import ConstantCalibration
from .table import WindowTable
from .verdict import Finding

_REFERENCE_MODEL = 'quadratic+memory2'
_FIRST_GUESS_S = 1800.0
# A transient is there when it takes away this much of the residual.
_NEEDED_RATIO = 0.7
_CUTS_S = (600.0, 1200.0, 1800.0, 2700.0, 3600.0, 5400.0)
_LARGEST_PART = 0.4
_WINDOWS_PER_BAG = 80.0
# The shortest cut that is about as good as the best is taken.
_GOOD_RATIO = 1.04


@dataclass(frozen=True)
class WarmUp:
    """
    A transient after switching on.

    Parameters
    ----------
    cut_s : float
        How much of each bag's start is left out [s].
    time_constant_s : float
        Of the exponential that the rest is modelled by [s].
    largest : float
        Its size at the beginning of what is used [m/s^2].

    """

    cut_s: float
    time_constant_s: float
    largest: float

    def finding(self) -> Finding:
        """
        Say it.

        """
        minutes = self.cut_s / 60.0
        return Finding(
            'warm-up',
            'advice',
            f'the unit was still warming up when the bags began: {minutes:.0f} min of each were '
            f'left out, a transient of up to {self.largest / MICRO_G:.3g} ug and '
            f'{self.time_constant_s / 60.0:.0f} min was estimated in the rest; switch on '
            f'{5.0 * self.time_constant_s / 3600.0:.1f} h before recording',
        )


def find_warm_up(
    table: WindowTable, gravity: float, constant: ConstantCalibration, freedom: Freedom
) -> WarmUp | None:
    """
    Look for a transient at the start of the bags.

    Parameters
    ----------
    table : WindowTable
        Coarse windows.
    gravity : float
        Local gravity.
    constant : ConstantCalibration
        First guess.
    freedom : Freedom
        What the regression may move.

    Returns
    -------
    WarmUp or None
        None when the bags do without.

    """
    # To see whether there is a transient of minutes and hours needs no finer windows.
    longest = float(np.max(table.time))
    coarse = table.coarsened(longest / _WINDOWS_PER_BAG)
    spec = model_spec(_REFERENCE_MODEL, table)

    def fitted(kept: WindowTable, transient_s: float | None) -> Outcome:
        return fit_model(
            kept, spec, gravity, constant, freedom, transient_s=transient_s, max_steps=15
        )

    plain, settling = fitted(coarse, None), fitted(coarse, _FIRST_GUESS_S)
    if _rms(settling, coarse, 0.0) > _NEEDED_RATIO * _rms(plain, coarse, 0.0):
        return None
    # What is left out is judged on what all the cuts leave in: a transient of more than one
    # exponential at the start bends the fit of the rest.
    cuts = [0.0, *(cut for cut in _CUTS_S if cut <= _LARGEST_PART * longest)]
    tried = []
    for cut_s in cuts:
        kept = table.select(table.time >= cut_s).renumbered()
        settling = fitted(kept, _FIRST_GUESS_S)
        tried.append((cut_s, settling, _rms(settling, kept, cuts[-1])))
    best = min(rms for _, _, rms in tried)
    cut_s, settling, _ = next(one for one in tried if one[2] <= _GOOD_RATIO * best)
    solution = settling.solution
    at_first = float(np.max(np.abs(solution.transient / solution.scale[:, 0])))
    left = float(np.exp(-cut_s / solution.transient_s))
    return WarmUp(cut_s, solution.transient_s, at_first * left)


def _rms(outcome: Outcome, table: WindowTable, from_s: float) -> float:
    """
    RMS residual of a table's windows from a time on [m/s^2].

    """
    relative = outcome.residual / np.abs(outcome.solution.scale[:, 0])
    return float(np.sqrt(np.mean(relative[table.time >= from_s] ** 2)))
