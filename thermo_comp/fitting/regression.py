# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the regression: the posterior of all unknowns under a given prior, by Gauss-Newton.

All unknowns have Gaussian priors (attitudes: flat on the sphere). Gauss-Newton finds the mode; the
inverse of the Hessian is the covariance. The unknowns of each bag are eliminated first, so the
information of a bag about the unit is one matrix and one vector, which are subtracted to leave the
bag out.

References
----------
.. [1] D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992).

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from ..typing import Bools, Floats
from .elimination import Reduced, eliminate, factored, inverse_root, solved
from .equations import Equations, moved_by, without_inactive
from .inactive import Inactive
from .last_result import last_result_kept
from .tangent import Normal, Tangent
from .unknowns import Layout, Prior, State

# Prior sd of the mean over all bags of the initial lag states, over that of one bag. A non-zero
# mean is a response of the unit, which other initial states would show as well.
_COMMON_START = 0.1


@dataclass(frozen=True)
class Posterior:
    """
    The Gaussian approximation of the posterior at its mode.

    determined: effective parameters of each unknown (MacKay's gamma), 0 .. 1, shape (n,)
    root: root of the covariance of the unit's unknowns, ``root @ root.T``, (n_unit, n_unit)
    variance: variances of all unknowns, shape (n,)
    square: sum of squares of the whitened residuals of each axis, shape (3,) [(m/s^2)^2]
    log_evidence: logarithm of the marginal likelihood, without a constant of the data
    """

    state: State
    layout: Layout
    determined: Floats
    root: Floats
    variance: Floats
    square: Floats
    log_evidence: float

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the unit's unknowns, shape (n_unit, n_unit)."""
        return np.asarray(self.root @ self.root.T)

    @property
    def effective_parameters(self) -> Floats:
        """Effective parameters of each column, sum over the axes, shape (2, m)."""
        padded = np.append(self.determined, 0.0)
        return np.asarray(padded[self.layout.weights].sum(axis=1))


class Regression(Equations):
    """Gauss-Newton on the measurement equations; see `Equations` for the parameters."""

    @last_result_kept
    def linearised(self, state: State, layout: Layout, grams: Floats) -> tuple[Tangent, Normal]:
        """
        Return the equations linearised about a state, and the normal equations for products of the
        base series in each position.
        """
        base = self.products(layout.used).base
        tangent = self.tangent(state, layout, base)
        return tangent, tangent.normal(self.products_at(grams, state, base))

    def reduce(self, normal: Normal, prior: Prior, layout: Layout, state: State) -> Reduced:
        """Eliminate the unknowns of positions and bags from normal equations."""
        in_sigmas = normal.scaled(prior.sigma**-2.0)
        precision, away = self.precision(prior, layout), self.away(state, prior, layout)
        reduced = eliminate(in_sigmas, layout, precision, away)
        if self.n_bags > 1 and layout.start.size:
            variance = (_COMMON_START * self.n_bags) ** 2 * prior.start_share
            reduced = reduced.with_prior_of_sum(state.start.sum(axis=0), variance)
        return reduced

    def without_each(self, state: State, prior: Prior, layout: Layout) -> Iterator[Floats]:
        """Yield the normal equations of the unit without each position in turn."""
        products = self.products(layout.used)
        tangent, normal = self.linearised(state, layout, products.whole)
        reduced = self.reduce(normal, prior, layout, state)
        at_state = self.products_at(products.whole, state, products.base)
        for p in range(self.windows.n_positions):
            own = tangent.at(p).normal(at_state[[p]])
            yield reduced.without(p, own.scaled(prior.sigma**-2.0))

    def unit_step(
        self, matrix: Floats, prior: Prior, layout: Layout, state: State
    ) -> tuple[Floats, Floats]:
        """
        Return the step of the unit's unknowns, and the Cholesky factor of their Hessian, given
        their normal equations, see `Reduced.matrix`.
        """
        n = layout.n_unit
        information, pull, away = (
            matrix[:n, :n],
            matrix[:n, n],
            self.away(state, prior, layout)[:n],
        )
        if prior.informative is None:
            known = self.precision(prior, layout)[:n]
            hessian: Floats = information.copy()
            hessian[np.diag_indices(n)] += known
            factor = factored(hessian)
            return solved(factor, pull - known * away), factor
        # In units of the prior's standard deviations the system is well conditioned.
        root = prior.informative.root
        turned = solve_triangular(root, information, trans='T')
        turned = solve_triangular(root, turned.T, trans='T')
        factor = factored((turned + turned.T) / 2.0 + np.eye(n))
        right = solve_triangular(root, pull, trans='T') - root @ away
        return solve_triangular(root, solved(factor, right)), root.T @ factor

    def step(
        self, state: State, prior: Prior, layout: Layout, grams: Floats, *, held: bool = False
    ) -> tuple[Floats, Reduced, Floats]:
        """
        Return the Gauss-Newton step, the reduced equations, and the Cholesky factor of the unit's
        Hessian. `held`: the nonlinear unknowns are held by a damping factor, so that only the
        linear ones move.
        """
        _, normal = self.linearised(state, layout, grams)
        if held:
            normal = _held(normal, layout)
        reduced = self.reduce(normal, prior, layout, state)
        unit, factor = self.unit_step(reduced.whole, prior, layout, state)
        step = np.empty(layout.n)
        step[: layout.n_unit] = unit
        step[layout.own], step[layout.start] = reduced.follow(unit)
        return step, reduced, factor

    def energy(self, state: State, prior: Prior, layout: Layout, grams: Floats) -> float:
        """Return -2 times the log density of data and state, without the prior's constants."""
        square = self._square(state, layout, grams)
        return self._size(square, prior) + self._away(state, prior, layout)

    def _square(self, state: State, layout: Layout, grams: Floats) -> Floats:
        """Return the sum of squares of the whitened residuals of each axis, shape (3,)."""
        _, normal = self.linearised(state, layout, grams)
        return normal.square

    def _size(self, square: Floats, prior: Prior) -> float:
        n = len(self.weight)
        each = square / prior.sigma**2 + 2.0 * n * np.log(prior.sigma) + self.noise_determinant
        return float(each.sum())

    def _away(self, state: State, prior: Prior, layout: Layout) -> float:
        away, precision = self.away(state, prior, layout), self.precision(prior, layout)
        size = float(precision @ away**2)
        if prior.informative is not None:
            # The precision of the unit's unknowns is 0 in the diagonal form.
            size += float(np.sum((prior.informative.root @ away[: layout.n_unit]) ** 2))
        if self.n_bags > 1 and layout.start.size:
            bound = (_COMMON_START * self.n_bags) ** 2 * prior.start_share
            size += float(np.sum(state.start.sum(axis=0) ** 2)) / bound
        return size

    def solve(self, state: State, prior: Prior, n_steps: int = 6) -> Posterior:
        """Find the posterior at the mode, in at most `n_steps`; with 0 steps at `state`."""
        self.whiten(prior.noise)
        layout = self.layout(prior.column_sd > 0.0, prior.nonlinear_sd > 0.0)
        grams = self.products(layout.used).whole
        state = without_inactive(state, layout)
        energy = self.energy(state, prior, layout, grams)
        for k in range(n_steps + 1):
            step, reduced, factor = self.step(state, prior, layout, grams)
            square = self._square(state, layout, grams)
            if k == n_steps:
                break
            found, reached = self._descend(state, step, prior, layout, grams, energy)
            if reached > energy:
                break
            gained, energy, state = energy - reached, reached, found
            if gained < 1e-3:
                break
        return self._posterior(state, prior, layout, reduced, factor, square)

    def _descend(
        self,
        state: State,
        step: Floats,
        prior: Prior,
        layout: Layout,
        grams: Floats,
        energy: float,
    ) -> tuple[State, float]:
        """
        Take a step; return the state and its energy.

        If the step increases the energy, fractions of it are tried in the nonlinear unknowns,
        which enter as products, and the linear unknowns are solved again for each fraction.
        """
        found = moved_by(state, step, layout)
        reached = self.energy(found, prior, layout, grams)
        if reached <= energy:
            return found, reached
        bends = np.zeros(layout.n, dtype=bool)
        for places in (layout.kappa, layout.shared, layout.up, layout.stretch, layout.start):
            bends[places] = True
        for share in (1.0, 0.25, 0.06, 0.015, 0.004, 0.001):
            turned = moved_by(state, np.where(bends, share * step, 0.0), layout)
            follow, *_ = self.step(turned, prior, layout, grams, held=True)
            found = moved_by(turned, np.where(bends, 0.0, follow), layout)
            reached = self.energy(found, prior, layout, grams)
            if reached <= energy:
                break
        return found, reached

    def _posterior(
        self,
        state: State,
        prior: Prior,
        layout: Layout,
        reduced: Reduced,
        factor: Floats,
        square: Floats,
    ) -> Posterior:
        n, own_root = layout.n_unit, inverse_root(factor)
        precision = self.precision(prior, layout)
        everything = np.empty(layout.n)
        everything[:n] = np.sum(own_root**2, axis=1)
        everything[layout.own], everything[layout.start] = reduced.variances(own_root)
        determined = 1.0 - precision * everything
        of_prior = float(np.log(precision[n:][precision[n:] > 0.0]).sum())
        if prior.informative is None:
            of_prior += float(np.log(precision[:n]).sum())
        else:
            root = prior.informative.root
            determined[:n] = 1.0 - np.sum(root * (root @ own_root @ own_root.T), axis=0)
            of_prior += 2.0 * float(np.log(np.diag(root)).sum())
        if reduced.common is not None:
            of_prior += layout.start.shape[1] * float(np.log(prior.start_share))
        log_hessian = 2.0 * float(np.log(np.diag(factor)).sum()) + reduced.log_determinant
        size = self._size(square, prior) + self._away(state, prior, layout)
        evidence = -0.5 * (size + log_hessian - of_prior)
        return Posterior(state, layout, determined, own_root, everything, square, evidence)

    def inactive(self, posterior: Posterior, prior: Prior, asked: Bools) -> Inactive:
        """Return sparsity and quality factors of inactive columns, (m,), at the mode."""
        state, layout, n = posterior.state, posterior.layout, posterior.layout.n_unit
        part, column = np.nonzero(self.windows.parts & asked & ~layout.used.any(axis=0))
        if not len(column):
            return Inactive(part, column, np.zeros((0, 0)), np.zeros(0))
        products = self.products(layout.used)
        tangent, normal = self.linearised(state, layout, products.whole)
        reduced = self.reduce(normal, prior, layout, state)
        columns, at = np.unique(column, return_inverse=True)
        among, beside = self.products_of(columns, products.base)
        # Derivative of the reading by a unit of a column's effect on the bias and on the scale.
        acts = np.stack((np.ones_like(state.up), state.kappa * self.along_axes(state)))
        acts /= prior.sigma
        rows = tangent.of(self.at_starts(beside, state, products.base))[:, :, at]
        rows *= (acts[part] / prior.sigma).transpose(1, 2, 0)[..., None]
        gone, cross = reduced.beside(rows)
        sums = np.tensordot(np.einsum('api,bpi->iabp', acts, acts), among, 1)
        S = -gone.reshape(len(part), 3, len(part), 3)
        for axis in range(3):
            S[:, axis, :, axis] += sums[axis, part[:, None], part, at[:, None], at]
        step, factor = self.unit_step(reduced.whole, prior, layout, state)
        S = S.reshape(gone.shape) - cross[:n].T @ solved(factor, cross[:n])
        Q = cross[n] - cross[:n].T @ step
        if self.windows.acts_on is not None:
            absent = ~self.windows.acts_on[column].ravel()
            S[absent], S[:, absent], Q[absent] = 0.0, 0.0, 0.0
        return Inactive(part, column, S, Q)


def _held(normal: Normal, layout: Layout) -> Normal:
    """Damp the nonlinear unknowns in normal equations."""
    local, unit = normal.local.copy(), normal.unit.copy()
    at = [*range(2 + layout.stretch.shape[1]), *range(layout.of_axis.shape[1], layout.n_local)]
    local[..., at, at] *= 1e9
    end = unit.shape[-1] - 1
    at = [0, *range(end - len(layout.shared), end)]
    unit[..., at, at] *= 1e9
    return Normal(local, unit)
