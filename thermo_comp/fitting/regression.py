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

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from ..typing import Bools, Floats, Ints
from .equations import Equations, Tangent, as_vector, moved_by
from .inactive import Inactive
from .unknowns import Layout, Prior, State

# Prior sd of the mean over all bags of the initial lag states, over that of one bag. A non-zero
# mean is a response of the unit, which other initial states would show as well.
_COMMON_START = 0.1


@dataclass(frozen=True)
class Normal:
    """
    Normal equations of all positions, before any prior.

    hessian, gradient: of each position and axis, in the order of `Tangent`, shapes
        (n_positions, 3, k, k), (n_positions, 3, k)
    square: sum of squares of the whitened residuals of each axis, shape (3,)
    """

    hessian: Floats
    gradient: Floats
    square: Floats


@dataclass(frozen=True)
class Common:
    """
    The prior on the sum over the bags of their initial lag states, as a small linear system.

    factor: Cholesky factor of its matrix
    cross: its cross block with the unit's unknowns
    sum: sum of the states after the step of each bag
    answers: derivatives of the unknowns of each bag by this sum
    """

    factor: Floats
    cross: Floats
    sum: Floats
    answers: tuple[Floats, ...]

    def solve(self, right: Floats) -> Floats:
        """Solve the system for a right-hand side."""
        return np.asarray(cho_solve((self.factor, True), right, check_finite=False))


@dataclass(frozen=True)
class Reduced:
    """
    The normal equations of the unit's unknowns, with the unknowns of each bag eliminated.

    information, pull: Hessian and gradient of each bag, shapes (n_bags, n_unit, n_unit),
        (n_bags, n_unit)
    factors: of each bag the Cholesky factor of its block, and the inverse of the block times the
        cross block and times the gradient
    log_determinant: sum over the blocks of the bags
    common: contribution of the prior on the mean of the initial lag states; None without it
    """

    information: Floats
    pull: Floats
    factors: tuple[tuple[Floats, Floats, Floats], ...]
    log_determinant: float
    common: Common | None = None

    @property
    def whole(self) -> tuple[Floats, Floats]:
        """Information and pull of all bags."""
        information, pull = self.information.sum(axis=0), self.pull.sum(axis=0)
        if self.common is None:
            return information, pull
        solved = self.common.solve(np.column_stack((self.common.cross, self.common.sum)))
        n = len(pull)
        return (
            information + self.common.cross.T @ solved[:, :n],
            pull + self.common.cross.T @ solved[:, n],
        )


@dataclass(frozen=True)
class Posterior:
    """
    The Gaussian approximation of the posterior at its mode.

    determined: effective parameters of each unknown (MacKay's gamma), 0 .. 1, shape (n,)
    covariance: covariance of the unit's unknowns, shape (n_unit, n_unit)
    variance: variances of all unknowns, shape (n,)
    square: sum of squares of the whitened residuals of each axis, shape (3,) [(m/s^2)^2]
    log_evidence: logarithm of the marginal likelihood, without a constant of the data
    """

    state: State
    layout: Layout
    determined: Floats
    covariance: Floats
    variance: Floats
    square: Floats
    log_evidence: float

    @property
    def effective_parameters(self) -> Floats:
        """Effective parameters of each column, sum over the axes, shape (2, m)."""
        padded = np.append(self.determined, 0.0)
        return np.asarray(padded[self.layout.weights].sum(axis=1))


def factored(matrix: Floats) -> Floats:
    """
    Return the lower Cholesky factor of a matrix that is positive definite except for rounding.

    The smallest jitter that suffices is added to the matrix scaled to a unit diagonal.
    """
    root = np.sqrt(np.diag(matrix))
    scaled = matrix / np.outer(root, root)
    diagonal = np.diag_indices(len(matrix))
    for jitter in (1e-13, 1e-11, 1e-9):
        scaled[diagonal] += jitter
        with suppress(np.linalg.LinAlgError):
            return np.asarray(np.linalg.cholesky(scaled) * root[:, None])
    scaled[diagonal] += 1e-7
    return np.asarray(np.linalg.cholesky(scaled) * root[:, None])


class Regression(Equations):
    """Gauss-Newton on the measurement equations; see `Equations` for the parameters."""

    def normal(self, tangent: Tangent, grams: Floats, prior: Prior) -> Normal:
        """Form the normal equations from products of the base series (n_positions, k, k)."""
        T, v = tangent.derivatives, tangent.residual
        turned = grams[:, None] @ T
        variance = prior.sigma**2
        hessian = T.transpose(0, 1, 3, 2) @ turned / variance[:, None, None]
        gradient = np.einsum('pibk,pib->pik', turned, v) / variance[:, None]
        square = np.sum((v @ grams) * v, axis=(0, 2))
        return Normal(hessian, gradient, np.maximum(square, 0.0))

    def reduce(
        self,
        normal: Normal,
        prior: Prior,
        layout: Layout,
        state: State,
        bags: Ints | None = None,
        without: int = -1,
    ) -> Reduced:
        """Eliminate the unknowns of each bag; `without`: a position that is left out."""
        n, own = layout.n_unit, layout.axis.shape[1]
        both = own + len(layout.shared)
        of_axis = [slice(int(places[0]), int(places[0]) + own) for places in layout.axis]
        shared = slice(n - len(layout.shared), n)
        precision = self.precision(prior, layout)
        away = as_vector(state, layout)
        bags = np.arange(self.n_bags) if bags is None else bags
        information, pull = np.zeros((len(bags), n, n)), np.zeros((len(bags), n))
        factors, answers, determinant = [], [], 0.0
        for k, bag in enumerate(bags.tolist()):
            block = layout.blocks[bag]
            size = block.stop - block.start
            H, cross, g = np.zeros((size, size)), np.zeros((size, n)), np.zeros(size)
            A, a = information[k], pull[k]
            for p in np.flatnonzero(self.bag_of_position == bag).tolist():
                if p == without:
                    continue
                for axis in range(3):
                    local = self._local(layout, p, axis) - block.start
                    matrix, vector = normal.hessian[p, axis], normal.gradient[p, axis]
                    at = of_axis[axis]
                    A[at, at] += matrix[:own, :own]
                    A[at, shared] += matrix[:own, own:both]
                    A[shared, at] += matrix[own:both, :own]
                    A[shared, shared] += matrix[own:both, own:both]
                    a[at] += vector[:own]
                    a[shared] += vector[own:both]
                    H[local[:, None], local] += matrix[both:, both:]
                    cross[local, at] += matrix[both:, :own]
                    cross[local, shared] += matrix[both:, own:both]
                    g[local] += vector[both:]
            H[np.diag_indices(size)] += precision[block]
            g -= precision[block] * away[block]
            # Attitudes without any information keep their value.
            blind = np.diag(H) <= 0.0
            H[blind, blind] = 1.0
            factor = factored(H)
            own_starts = np.eye(size)[:, layout.start[bag] - block.start]
            solved = cho_solve(
                (factor, True), np.column_stack((cross, g, own_starts)), check_finite=False
            )
            information[k] -= cross.T @ solved[:, :n]
            pull[k] -= cross.T @ solved[:, n]
            factors.append((factor, solved[:, :n], solved[:, n]))
            answers.append(solved[:, n + 1 :])
            determinant += 2.0 * float(np.log(np.diag(factor)).sum())
        common = None
        if len(bags) == self.n_bags > 1 and layout.start.size:
            common = self._common(prior, layout, state, factors, answers)
            determinant += 2.0 * float(np.log(np.diag(common.factor)).sum())
            determinant -= layout.start.shape[1] * float(np.log(prior.start_share))
        return Reduced(information, pull, tuple(factors), determinant, common)

    def _common(
        self,
        prior: Prior,
        layout: Layout,
        state: State,
        factors: list[tuple[Floats, Floats, Floats]],
        answers: list[Floats],
    ) -> Common:
        """Return the system of the prior on the sum of the initial lag states of all bags."""
        at = [places - one.start for places, one in zip(layout.start, layout.blocks, strict=True)]
        bound = (_COMMON_START * self.n_bags) ** 2 * prior.start_share
        matrix = sum(one[own] for one, own in zip(answers, at, strict=True))
        matrix = np.asarray(matrix) + bound * np.eye(layout.start.shape[1])
        cross = sum(one[own] for (_, one, _), own in zip(factors, at, strict=True))
        moved = sum(one[own] for (_, _, one), own in zip(factors, at, strict=True))
        total = state.start.sum(axis=0) + moved
        return Common(factored(matrix), np.asarray(cross), total, tuple(answers))

    def _local(self, layout: Layout, p: int, axis: int) -> Ints:
        return np.concatenate(
            (
                layout.up[p],
                layout.stretch[p],
                layout.offset[p, axis : axis + 1],
                layout.tilt[p].ravel(),
                layout.start[self.bag_of_position[p]],
            )
        )

    def unit_prior(self, prior: Prior, layout: Layout) -> Floats:
        """Return the prior precision of the unit's unknowns, shape (n_unit, n_unit)."""
        if prior.informative is not None:
            return prior.informative.precision
        return np.diag(self.precision(prior, layout)[: layout.n_unit])

    def unit_step(
        self, information: Floats, pull: Floats, prior: Prior, layout: Layout, state: State
    ) -> tuple[Floats, Floats]:
        """Return the step of the unit's unknowns, and the Cholesky factor of their Hessian."""
        known, n = self.unit_prior(prior, layout), layout.n_unit
        away = (as_vector(state, layout) - self.prior_mean(prior, layout))[:n]
        if prior.informative is None:
            factor = factored(information + known)
            return cho_solve((factor, True), pull - known @ away, check_finite=False), factor
        # In units of the prior's standard deviations the system is well conditioned.
        root = prior.informative.root
        turned = solve_triangular(root, information, trans='T')
        turned = solve_triangular(root, turned.T, trans='T')
        factor = factored((turned + turned.T) / 2.0 + np.eye(n))
        right = solve_triangular(root, pull, trans='T') - root @ away
        step = solve_triangular(root, cho_solve((factor, True), right, check_finite=False))
        return step, root.T @ factor

    def step(
        self, state: State, prior: Prior, layout: Layout, grams: Floats, *, held: bool = False
    ) -> tuple[Floats, Reduced, Floats, Floats]:
        """
        Return the Gauss-Newton step, the reduced equations, the Cholesky factor of the unit's
        Hessian, and the sum of squares of each axis. `held`: the nonlinear unknowns are held by a
        damping factor, so that only the linear ones move.
        """
        tangent = self.tangent(state, layout, self.products(layout.used))
        normal = self.normal(tangent, grams, prior)
        if held:
            own, n_starts = layout.axis.shape[1], layout.start.shape[1]
            diagonal = np.einsum('...ii->...i', normal.hessian)
            k = diagonal.shape[-1]
            turns = own + len(layout.shared) + 2 + layout.stretch.shape[1]
            diagonal[..., [0, *range(own, turns), *range(k - n_starts, k)]] *= 1e9
        reduced = self.reduce(normal, prior, layout, state)
        whole, factor = self.unit_step(*reduced.whole, prior, layout, state)
        step = np.zeros(layout.n)
        step[: layout.n_unit] = whole
        for block, (_, cross, alone) in zip(layout.blocks, reduced.factors, strict=True):
            step[block] = alone - cross @ whole
        if (common := reduced.common) is not None:
            bound = common.solve(common.sum - common.cross @ whole)
            for block, answer in zip(layout.blocks, common.answers, strict=True):
                step[block] -= answer @ bound
        return step, reduced, factor, normal.square

    def energy(self, state: State, prior: Prior, layout: Layout, grams: Floats) -> float:
        """Return -2 times the log density of data and state, without the prior's constants."""
        v = self.misfit(state, self.products(layout.used))
        square = np.sum((v @ grams) * v, axis=(0, 2))
        return self._size(np.maximum(square, 0.0), prior) + self._away(state, prior, layout)

    def _size(self, square: Floats, prior: Prior) -> float:
        n = len(self.weight)
        each = square / prior.sigma**2 + 2.0 * n * np.log(prior.sigma) + self.noise_determinant
        return float(each.sum())

    def _away(self, state: State, prior: Prior, layout: Layout) -> float:
        away = as_vector(state, layout) - self.prior_mean(prior, layout)
        own = away[: layout.n_unit]
        local = self.precision(prior, layout)[layout.n_unit :]
        if prior.informative is None:
            size = float(own @ self.unit_prior(prior, layout) @ own)
        else:
            size = float(np.sum((prior.informative.root @ own) ** 2))
        size += float(local @ away[layout.n_unit :] ** 2)
        if self.n_bags > 1 and layout.start.size:
            bound = (_COMMON_START * self.n_bags) ** 2 * prior.start_share
            size += float(np.sum(state.start.sum(axis=0) ** 2)) / bound
        return size

    def solve(self, state: State, prior: Prior, n_steps: int = 6) -> Posterior:
        """Find the posterior at the mode, in at most `n_steps`; with 0 steps at `state`."""
        self.whiten(prior.noise)
        layout = self.layout(prior.column_sd > 0.0, prior.nonlinear_sd > 0.0)
        grams = self.products(layout.used).whole
        state = moved_by(state, np.zeros(layout.n), layout)
        energy = self.energy(state, prior, layout, grams)
        for k in range(n_steps + 1):
            step, reduced, factor, square = self.step(state, prior, layout, grams)
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
        n = layout.n_unit
        covariance = cho_solve((factor, True), np.eye(n), check_finite=False)
        precision = self.precision(prior, layout)
        variance = [np.diag(covariance)]
        for own, cross, _ in reduced.factors:
            inverse = np.linalg.inv(own)
            variance.append((inverse**2).sum(axis=0) + ((cross @ covariance) * cross).sum(axis=1))
        everything = np.concatenate(variance)
        determined = 1.0 - precision * everything
        of_prior = float(np.log(precision[n:][precision[n:] > 0.0]).sum())
        if prior.informative is None:
            of_prior += float(np.log(precision[:n]).sum())
        else:
            root = prior.informative.root
            determined[:n] = 1.0 - np.sum(root * (root @ covariance), axis=0)
            of_prior += 2.0 * float(np.log(np.diag(root)).sum())
        log_hessian = 2.0 * float(np.log(np.diag(factor)).sum()) + reduced.log_determinant
        size = self._size(square, prior) + self._away(state, prior, layout)
        evidence = -0.5 * (size + log_hessian - of_prior)
        return Posterior(state, layout, determined, covariance, everything, square, evidence)

    def inactive(self, posterior: Posterior, prior: Prior, asked: Bools) -> Inactive:
        """Return sparsity and quality factors of inactive columns, (m,), at the mode."""
        state, layout = posterior.state, posterior.layout
        used, n = layout.used, layout.n_unit
        columns = np.flatnonzero(asked & ~used.any(axis=0))
        k = len(columns)
        if not k:
            return Inactive(columns, np.zeros((0, 0)), np.zeros(0))
        products = self.products(used)
        tangent = self.tangent(state, layout, products)
        normal = self.normal(tangent, products.whole, prior)
        reduced = self.reduce(normal, prior, layout, state)
        own = layout.axis.shape[1]
        of_unit = np.hstack((layout.axis, np.tile(layout.shared, (3, 1))))
        of_others = own + len(layout.shared)
        S: Floats = np.zeros((2, k, 3, 2, k, 3))
        Q: Floats = np.zeros((2, k, 3))
        cross: Floats = np.zeros((n, 2, k, 3))
        local = [np.zeros((block.stop - block.start, 2, k, 3)) for block in layout.blocks]
        force = self.along_axes(state)
        for p, bag in enumerate(self.bag_of_position.tolist()):
            among, beside = self.absent_products(columns, used, p)
            for axis in range(3):
                acts = np.array([1.0, state.kappa[axis] * force[p, axis]])
                variance = prior.sigma[axis] ** 2
                both = np.multiply.outer(np.outer(acts, acts), among) / variance
                S[:, :, axis, :, :, axis] += both.transpose(0, 2, 1, 3)
                seen = beside @ tangent.residual[p, axis] / variance
                Q[:, :, axis] += np.outer(acts, seen)
                with_all = beside @ tangent.derivatives[p, axis] / variance
                each = np.multiply.outer(acts, with_all).transpose(2, 0, 1)
                cross[of_unit[axis], :, :, axis] += each[:of_others]
                at = self._local(layout, p, axis) - layout.blocks[bag].start
                local[bag][at, :, :, axis] += each[of_others:]
        size = 2 * k * 3
        S, Q, cross = (
            one.reshape(shape)
            for one, shape in ((S, (size, size)), (Q, (size,)), (cross, (n, size)))
        )
        for bag, (factor, of_cross, alone) in enumerate(reduced.factors):
            own_cross = local[bag].reshape(-1, size)
            solved = cho_solve((factor, True), own_cross, check_finite=False)
            S -= own_cross.T @ solved
            Q -= own_cross.T @ alone
            cross -= of_cross.T @ own_cross
        step, whole = self.unit_step(*reduced.whole, prior, layout, state)
        S -= cross.T @ cho_solve((whole, True), cross, check_finite=False)
        return Inactive(columns, S, Q - cross.T @ step)
