# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns |f| in each position of a fit that is not at 1 g everywhere, and the nonlinear terms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Floats
from ..unit.nonlinearity import POWERS, Kind, linearised, unit_of


@dataclass(frozen=True)
class Forces:
    """
    The known magnitude ``|f|^2 = still^2 + spin^2`` of each position, (n_positions,) [m/s^2].

    kinds: the k nonlinear terms that may take part, in the order of a file; the order of the
        coefficients is all kinds at the reference temperature, then all kinds per kelvin
    t: board temperature of each window less the reference, shape (n,) [K]
    still: |f| without rotation; gravity if the unit rotates
    spin: centripetal acceleration w^2 r at the stated radius; 0 without rotation
    sd: standard deviation of |f| without the part of the radius
    radius_sd: relative standard deviation of the radius; 0 if the radius is not estimated
    """

    kinds: tuple[Kind, ...]
    t: Floats
    still: Floats
    spin: Floats
    sd: Floats
    radius_sd: float = 0.0

    def norms(self, radius: Floats, stretch: Floats) -> Floats:
        """Return |f| of each position, given the relative errors of radius and |f|."""
        turned = self.spin * (1.0 + radius.sum())
        return np.asarray(np.hypot(self.still, turned) * (1.0 + stretch.sum(axis=1)))

    def by_radius(self, radius: Floats) -> Floats:
        """Differentiate the logarithm of |f| by the relative error of the radius."""
        turned = self.spin * (1.0 + radius.sum())
        return np.asarray(self.spin * turned / (self.still**2 + turned**2))

    @property
    def sizes(self) -> Floats:
        """|f| of each position as stated."""
        return np.hypot(self.still, self.spin)

    @property
    def stretch_sd(self) -> Floats:
        """Relative standard deviation of |f| of each position, above 0."""
        return np.maximum(self.sd / self.sizes, 1e-12)

    def terms(self, force: Floats) -> tuple[Floats, Floats]:
        """Return each term per unit coefficient and its slope, (*force.shape, k)."""
        each = {
            'square': (force**2, 2.0 * force),
            'odd_square': (np.abs(force) * force, 2.0 * np.abs(force)),
            'cube': (force**3, 3.0 * force**2),
        }
        pairs = [np.array(each[kind]) / unit_of(kind) for kind in self.kinds]
        value, slope = np.stack(pairs, axis=-1) if pairs else np.zeros((2, *force.shape, 0))
        return value, slope

    def linearise(self, x: Floats, nonlinear: Floats, rows: slice) -> Floats:
        """Return the readings of windows, shape (n, 3), without the nonlinear terms."""
        k = len(self.kinds)
        at = nonlinear[:, :k] + self.t[rows, np.newaxis, np.newaxis] * nonlinear[:, k:]
        k2, kq, k3 = (
            at[..., self.kinds.index(kind)] / unit_of(kind)
            if kind in self.kinds
            else np.zeros_like(x)
            for kind in POWERS
        )
        return linearised(x, k2, kq, k3)
