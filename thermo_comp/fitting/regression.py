# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the regression: the posterior of all unknowns under a given prior, by Gauss-Newton.

All unknowns have Gaussian priors, except attitudes without a pose, whose prior is flat. Gauss-
Newton finds the mode; the inverse of the Hessian is the covariance. The unknowns of positions and
bags are eliminated first. A position is left out by subtracting its part of the unit's normal
equations.

References
----------
.. [1] D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992).

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from ..typing import Bools, Floats, Ints
from .elimination import Reduced, eliminate, factored_with_prior, inverse_root, solved
from .equations import Equations, with_step, without_inactive
from .gains import Inactive
from .layout import Layout, Normal, Tangent
from .unknowns import Prior, State


@dataclass(frozen=True)
class PosteriorMode:
    """
    The Gaussian approximation of the posterior at its mode.

    determined: effective number of parameters (MacKay's gamma, 0 to 1) of each unknown, (n,)
    root: root of the covariance of the unit's unknowns, ``root @ root.T``, (n_unit, n_unit)
    variance: variances of all unknowns, shape (n,)
    square: sum of squares of the whitened residuals of each axis, shape (3,) [(m/s^2)^2]
    log_evidence: log marginal likelihood plus a constant that depends only on the data
    """

    prior: Prior
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
        """Effective number of weights of each column, summed over the axes, shape (2, m)."""
        padded = np.append(self.determined, 0.0)
        return np.asarray(padded[self.layout.weights].sum(axis=1))


@dataclass(frozen=True)
class Point:
    """
    The equations linearised about a state, and the Gauss-Newton step from this state.

    grams: sums of products of whitened base series over each position, as in `Products`
    """

    regression: Regression
    state: State
    prior: Prior
    layout: Layout
    grams: Floats

    @property
    def tangent(self) -> Tangent:
        """The measurement equations, linearised about the state."""
        return self.regression.linearised(self.state, self.layout, self.grams)[0]

    @property
    def normal(self) -> Normal:
        """The normal equations of the linearised measurement equations."""
        return self.regression.linearised(self.state, self.layout, self.grams)[1]

    @cached_property
    def precision(self) -> Floats:
        """Inverse prior variances of all unknowns, see `Equations.precision`, shape (n,)."""
        return self.regression.precision(self.prior, self.layout)

    @cached_property
    def deviation(self) -> Floats:
        """The unknowns of the state less their prior means, shape (n,)."""
        return self.regression.deviation(self.state, self.prior, self.layout)

    @cached_property
    def square(self) -> Floats:
        """Sum of squares of the whitened residuals of each axis, shape (3,)."""
        return self.normal.square

    @cached_property
    def energy(self) -> float:
        """-2 times the log posterior density, without the normalisation of the prior."""
        n, sigma = len(self.regression.weight), self.prior.sigma
        each = self.square / sigma**2 + 2.0 * n * np.log(sigma)
        of_data = float((each + self.regression.noise_determinant).sum())
        of_prior = float(self.precision @ self.deviation**2)
        if self.prior.informative is not None:
            # `precision` is 0 for unknowns with an informative prior: add this prior's term.
            root = self.prior.informative.root
            of_prior += float(np.sum((root @ self.deviation[: self.layout.n_unit]) ** 2))
        if self._common_variance:
            of_prior += float(np.sum(self.state.start.sum(axis=0) ** 2)) / self._common_variance
        return of_data + of_prior

    @property
    def _common_variance(self) -> float:
        """Prior variance of the sum, over the bags, of an initial lag state; 0 if not used."""
        # The prior sd of the mean of an initial lag state over the bags is only 0.1 times its sd
        # in one bag: a mean other than 0 would repeat in all bags, and be a property of the unit.
        is_used = self.regression.n_bags > 1 and bool(self.layout.start.size)
        return is_used * (0.1 * self.regression.n_bags) ** 2 * self.prior.start_variance_ratio

    @cached_property
    def reduced(self) -> Reduced:
        """The normal equations of the unit, with the unknowns of positions and bags eliminated."""
        return self._reduced(self.normal, self.deviation)

    @property
    def norm_by_axes(self) -> Floats:
        """Derivatives of |f| in each position w.r.t. the readings, shape (n_positions, 3)."""
        return np.asarray(self.state.up @ np.linalg.inv(self.state.inverse) / self.state.kappa)

    @cached_property
    def norms_by_unit(self) -> Floats:
        """Derivatives of positions' mean |f| w.r.t. the unit's unknowns, (n_positions, n)."""
        regression, state, layout = self.regression, self.state, self.layout
        products = regression.products(layout.used)
        at_state = regression.at_starts(products.means[:, None], state, products.base)
        means = self.tangent.of(at_state)[:, :, 0]
        result = np.zeros((len(means), layout.n_unit))
        for axis, places in enumerate(layout.unit[:, :-1]):
            of_unit = means[:, axis, -1 - len(places) : -1]
            result[:, places] += self.norm_by_axes[:, [axis]] * of_unit
        return result

    def _reduced(self, normal: Normal, deviation: Floats) -> Reduced:
        in_sigmas = normal.scaled(self.prior.sigma**-2.0)
        reduced = eliminate(in_sigmas, self.layout, self.precision, deviation)
        if not self._common_variance:
            return reduced
        return reduced.with_prior_of_sum(self.state.start.sum(axis=0), self._common_variance)

    def without_each(self) -> Iterator[tuple[Ints, Floats]]:
        """
        Yield, for each mounting, its positions and the unit's normal equations without these
        positions; yield nothing if there is a single mounting.
        """
        base = self.regression.products(self.layout.used).base
        at_state = self.regression.products_at(self.grams, self.state, base)
        mounting = self.regression.windows.mounting
        for number in range(mounting[-1] + 1 if mounting[-1] else 0):
            places = np.flatnonzero(mounting == number)
            normal = self.tangent.at(places).normal(at_state[places])
            yield places, self.reduced.without(places, normal.scaled(self.prior.sigma**-2.0))

    def by_offset(self, axis: int) -> Floats:
        """
        Return the derivatives of the unit's estimated unknowns w.r.t. a bias offset on one axis
        that all positions share, shape (n_unit,).
        """
        deviation = self.deviation.copy()
        deviation[self.layout.offset[:, axis]] -= 1.0
        step, _ = self.unit_step(self._reduced(self.normal, deviation).matrix)
        return step - self.solution[0][: self.layout.n_unit]

    def unit_step(self, matrix: Floats) -> tuple[Floats, Floats]:
        """Return the step of the unit's unknowns, and the Cholesky factor of their Hessian."""
        n = self.layout.n_unit
        information, gradient, deviation = matrix[:n, :n], matrix[:n, n], self.deviation[:n]
        if not np.isfinite(information).all():
            raise np.linalg.LinAlgError('the information about the unit is not finite')
        if self.prior.informative is None:
            precision = self.precision[:n]
            factor = factored_with_prior(information, precision)
            return solved(factor, gradient - precision * deviation), factor
        # Unknowns multiplied by the root of the prior precision have well-conditioned equations.
        root = self.prior.informative.root
        scaled = solve_triangular(root, information, trans='T')
        scaled = solve_triangular(root, scaled.T, trans='T')
        factor = factored_with_prior((scaled + scaled.T) / 2.0, np.ones(n))
        right = solve_triangular(root, gradient, trans='T') - root @ deviation
        return solve_triangular(root, solved(factor, right)), root.T @ factor

    @cached_property
    def solution(self) -> tuple[Floats, Floats]:
        """The step of all unknowns, and the Cholesky factor of the unit's Hessian."""
        return self._solution(self.reduced)

    def _solution(self, reduced: Reduced) -> tuple[Floats, Floats]:
        unit, factor = self.unit_step(reduced.matrix)
        step = np.empty(self.layout.n)
        step[: self.layout.n_unit] = unit
        step[self.layout.own], step[self.layout.of_bag] = reduced.follow(unit)
        return step, factor

    def linear_step(self) -> Floats:
        """Return a step that is damped so that the nonlinear unknowns stay almost constant."""
        layout, local, unit = self.layout, self.normal.local.copy(), self.normal.unit.copy()
        # A factor 1e6 on the Hessian's diagonal divides the steps of nonlinear unknowns by about
        # 1e6; a far larger factor would cause rounding errors with a correlated prior.
        first = layout.of_axis.shape[1]
        starts = range(first, first + layout.start.shape[1])
        at = [*range(2 + layout.stretch.shape[1]), *starts]
        local[..., at, at] *= 1e6
        end = unit.shape[-1] - 1
        at = [0, *range(end - len(layout.shared), end)]
        unit[..., at, at] *= 1e6
        return self._solution(self._reduced(Normal(local, unit), self.deviation))[0]

    def with_step(self, step: Floats) -> Point:
        """Return a `Point` whose state is this state plus a step."""
        return replace(self, state=with_step(self.state, step, self.layout))

    def stepped(self) -> Point:
        """
        Take the Gauss-Newton step.

        If the step increases the energy, fractions of the step of the nonlinear unknowns (those
        that multiply other unknowns) are tried, each with a new step of the linear unknowns.
        """
        # Compute energy and step of this state before the next state is linearised:
        # `Regression.linearised` keeps only the last linearisation.
        energy, (step, _) = self.energy, self.solution
        result = self.with_step(step)
        if result.energy <= energy:
            return result
        layout = self.layout
        is_nonlinear = np.zeros(layout.n, dtype=bool)
        for places in (layout.kappa, layout.shared, layout.up, layout.stretch, layout.start):
            is_nonlinear[places] = True
        for share in (1.0, 0.25, 0.06, 0.015, 0.004, 0.001):
            partial = self.with_step(np.where(is_nonlinear, share * step, 0.0))
            result = partial.with_step(np.where(is_nonlinear, 0.0, partial.linear_step()))
            if result.energy <= energy:
                break
        return result

    def posterior(self, end: Point) -> PosteriorMode:
        """Return the posterior with the mode `end` and the covariance at this point."""
        layout, prior, precision, reduced = self.layout, self.prior, self.precision, self.reduced
        _, factor = self.solution
        n, unit_root = layout.n_unit, inverse_root(factor)
        variance = np.empty(layout.n)
        variance[:n] = np.sum(unit_root**2, axis=1)
        variance[layout.own], variance[layout.of_bag] = reduced.variances(unit_root)
        determined = 1.0 - precision * variance
        of_prior = float(np.log(precision[n:][precision[n:] > 0.0]).sum())
        if prior.informative is None:
            of_prior += float(np.log(precision[:n]).sum())
        else:
            root = prior.informative.root
            determined[:n] = 1.0 - np.sum(root * (root @ unit_root @ unit_root.T), axis=0)
            of_prior += 2.0 * float(np.log(np.diag(root)).sum())
        if reduced.common is not None:
            of_prior += layout.start.shape[1] * float(np.log(prior.start_variance_ratio))
        log_hessian = 2.0 * float(np.log(np.diag(factor)).sum()) + reduced.log_determinant
        evidence = -0.5 * (end.energy + log_hessian - of_prior)
        return PosteriorMode(
            *(prior, end.state, layout, determined, unit_root, variance, end.square, evidence)
        )


class Regression(Equations):
    """Gauss-Newton on the measurement equations; see `Equations` for the parameters."""

    #: The arguments and results of the last call of `linearised`.
    _linearised: tuple[State, Layout, Floats, Tangent, Normal] | None = None

    def at(self, state: State, prior: Prior, grams: Floats | None = None) -> Point:
        """Linearise about `state`, inactive weights set to 0; `grams`: None for all windows."""
        layout = self.layout(prior.column_sd > 0.0, prior.nonlinear_sd > 0.0)
        grams = self.products(layout.used).of_positions if grams is None else grams
        return Point(self, without_inactive(state, layout), prior, layout, grams)

    def linearised(self, state: State, layout: Layout, grams: Floats) -> tuple[Tangent, Normal]:
        """Return the equations linearised about a state, and their normal equations."""
        last = self._linearised
        if last is None or last[0] is not state or last[1] is not layout or last[2] is not grams:
            base = self.products(layout.used).base
            tangent = self.tangent(state, layout, base)
            normal = tangent.normal(self.products_at(grams, state, base))
            last = self._linearised = state, layout, grams, tangent, normal
        return last[3:]

    def solve(self, state: State, prior: Prior, n_steps: int = 6) -> PosteriorMode:
        """Return the posterior after at most `n_steps` steps from `state` to the mode."""
        self.whiten(prior.noise)
        point = self.at(state, prior)
        for _ in range(n_steps):
            end = point.stepped()
            if end.energy > point.energy:
                break
            if point.energy - end.energy < 1e-3:
                return point.posterior(end)
            point = end
        return point.posterior(point)

    def step(self, state: State, prior: Prior) -> PosteriorMode:
        """Take one step towards the mode; the covariance is computed at `state`."""
        self.whiten(prior.noise)
        point = self.at(state, prior)
        end = point.stepped()
        return point.posterior(end if end.energy <= point.energy else point)

    def inactive(self, posterior: PosteriorMode, wanted: Bools) -> Inactive:
        """Return the sparsity and quality factors of the inactive columns in the mask `wanted`."""
        point = self.at(posterior.state, posterior.prior)
        state, layout, sigma, n = point.state, point.layout, point.prior.sigma, point.layout.n_unit
        part, column = np.nonzero(self.windows.parts & wanted & ~layout.used)
        if not len(column):
            return Inactive(part, column, np.zeros((0, 0)), np.zeros(0))
        base = self.products(layout.used).base
        columns, at = np.unique(column, return_inverse=True)
        of_columns, with_base = self.products_of(columns, base, state)
        # Derivatives of the sample w.r.t. a column's contribution to the bias, and to the scale.
        acts = np.stack((np.ones_like(state.up), state.kappa * self.along(state)))
        acts /= sigma
        rows = point.tangent.of(self.at_starts(with_base, state, base))[:, :, at]
        rows *= (acts[part] / sigma).transpose(1, 2, 0)[..., None]
        reduction, cross = point.reduced.eliminate_from(rows)
        sums = np.tensordot(np.einsum('api,bpi->iabp', acts, acts), of_columns, 1)
        S = -reduction.reshape(len(part), 3, len(part), 3)
        for axis in range(3):
            S[:, axis, :, axis] += sums[axis, part[:, None], part, at[:, None], at]
        step, factor = point.unit_step(point.reduced.matrix)
        S = S.reshape(reduction.shape) - cross[:n].T @ solved(factor, cross[:n])
        Q = cross[n] - cross[:n].T @ step
        if self.windows.acts_on is not None:
            absent = ~self.windows.acts_on[column].ravel()
            S[absent], S[:, absent], Q[absent] = 0.0, 0.0, 0.0
        return Inactive(part, column, S, Q)
