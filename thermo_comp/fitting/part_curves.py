# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the powers of the temperature x of each axis's part, as sums of columns of t and of the lag m.

The temperature of the part of an axis, such as a sensor's package, is ``x = t - m``, t being the
board temperature and m the lag of the part. By the binomial theorem x^p is a sum of the columns
t^p, t^(p-1) m, ..., m^p with known factors, so one weight per power describes a curve over x. If
all bags repeat one warm-up, m is a function of t, and the data would not determine separate
weights of the columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..typing import Floats, Ints
from ..unit.columns import Column, Part

#: Highest power in the curves of x, the temperature of a part.
ORDER = 3


class PartCurves(NamedTuple):
    """
    The powers of the temperature x of the part of each axis; each power is a curve over x.

    axis, power: axis and power of x of each of p curves, shape (p,)
    sums: factors of the m columns of sets and response whose weighted sum is a curve, (p, m)
    """

    axis: Ints
    power: Ints
    sums: Floats

    def kelvins(self, values: Floats) -> Floats:
        """Return the temperature change that corresponds to the RMS of each curve [K]."""
        # The largest slope of x^p is p |x|^(p - 1) at the largest |x|.
        most = np.repeat(np.abs(values[:, ::ORDER]).max(axis=0, initial=0.0), ORDER)
        steepest = self.power * most ** (self.power - 1)
        rms = np.sqrt(np.mean(values**2, axis=0))
        return np.asarray(rms / np.maximum(steepest, 1e-300))


def curves_of(parts: Sequence[Part], columns: Sequence[Column], n_curves: int) -> PartCurves:
    """
    Return the curves over the temperature of each axis's part; none if a column is missing.

    `n_curves`: number of columns of the static and dynamic set, of which the first are t, t^2, t^3
    """
    places = {
        (column.kind, column.power, column.part): n_curves + k for k, column in enumerate(columns)
    }
    # Kinds of the columns of the powers m, m^2 and m^3 of a part's lag m.
    kinds = 'board', 'square', 'cube'
    powers = np.arange(1, ORDER + 1)
    rows = []
    for part in parts:
        for power in powers.tolist():
            row = np.zeros(n_curves + len(columns))
            row[power - 1] = 1.0
            for k, kind in enumerate(kinds[:power] if part.tau_s else (), 1):
                if (place := places.get((kind, power - k, part))) is None:
                    return curves_of((), columns, n_curves)
                row[place] = math.comb(power, k) * (-1.0) ** k
            rows.append(row)
    return PartCurves(
        np.repeat(np.arange(len(parts)), ORDER),
        np.tile(powers, len(parts)),
        np.array(rows).reshape(-1, n_curves + len(columns)),
    )
