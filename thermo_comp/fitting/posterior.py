# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the one regression: bias, scale, misalignment, attitudes, start states, given the prior.

Window w of position p, axis i, in m/s^2 of the nominal scale factor K0::

    N / K0 = kappa a (1 + S s) + b + B beta + o_p + kappa (A l_p)_i g + walk + white,
    a = (A u_p)_i g,  A = M^-1,  l_p across u_p: what the support leans by

With g = 0 this is the regression of an angular rate: what is left is b, B beta and o_p.

B and S are columns of one table (`unit.columns`), each in units of its RMS over the windows. All
unknowns have Gaussian priors (attitudes: flat on the sphere); Gauss-Newton finds the mode, the
inverse of the Hessian is the covariance. The windows enter only through the whitened columns of
each position, so a step costs nothing that grows with the length of a recording but one product.

References
----------
.. [1] D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992).

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..typing import Bools, Floats, Ints
from .design import Design
from .unknowns import Layout, Prior, State

# Of what is known of a direction, the least that is left without one position.
_LEAST_LEFT = 1e-5
# Of a matrix of unit diagonal: what keeps it positive definite to the last digit.
_JITTER = 1e-13
# Start states of neighbouring lags are told apart to fewer digits.
_START_JITTER = 1e-10
# A step that promises less than this part of a noise variance per reading may be the last ...
_FAR = 0.1
# ... of no more than so many. Of one that goes uphill such shares are tried, down to this one,
# the Hessian of what bends the way so much stiffer while the rest follows.
_MOST_STEPS, _FALL, _LEAST_SHARE, _HELD = 6, 0.25, 1e-3, 1e9
# A step that promises less log evidence than this goes where the next look would send it.
_NEAR = 30.0
# Parts of their widths in which columns that take no part are tried.
_PARTS = 10.0 ** np.arange(-4.0, 1.01, 0.25)
_SKEW_ROWS = ((1, 0), (2, 0), (2, 1))

# A state, its residuals filtered and whitened, the prior's pull, minus twice its log density.
_Look = tuple[State, Floats, Floats, Floats, float]


class Factor:
    """The Hessian, factored: what belongs to one bag alone is eliminated first."""

    def __init__(self, hessian: Floats, layout: Layout) -> None:
        n = layout.n_unit
        self._n, self._blocks = n, layout.blocks
        root = np.sqrt(np.diag(hessian))
        self._root = root
        scaled = hessian / np.outer(root, root)
        unit = scaled[:n, :n].copy()
        self.log_determinant = 2.0 * float(np.log(root).sum())
        self._locals = []
        jitter = np.full(len(hessian), _JITTER)
        jitter[layout.start] = _START_JITTER
        for block in layout.blocks:
            factor = cho_factor(scaled[block, block] + np.diag(jitter[block]))
            cross = cho_solve(factor, scaled[block, :n])
            unit -= scaled[:n, block] @ cross
            self._locals.append((factor, cross))
            self.log_determinant += 2.0 * float(np.log(np.diag(factor[0])).sum())
        self._unit = cho_factor(unit + _JITTER * np.eye(n))
        self.log_determinant += 2.0 * float(np.log(np.diag(self._unit[0])).sum())

    def solve(self, right: Floats) -> Floats:
        """Solve for one right side."""
        n = self._n
        right = right / self._root
        first = right[:n].copy()
        for block, (_, cross) in zip(self._blocks, self._locals, strict=True):
            first -= cross.T @ right[block]
        result = np.empty_like(right)
        result[:n] = cho_solve(self._unit, first)
        for block, (factor, cross) in zip(self._blocks, self._locals, strict=True):
            result[block] = cho_solve(factor, right[block]) - cross @ result[:n]
        return np.asarray(result / self._root)

    def covariances(self) -> tuple[Floats, list[Floats]]:
        """Covariance of what belongs to the unit, and of what belongs to each bag."""
        n, root = self._n, self._root
        unit = cho_solve(self._unit, np.eye(n))
        blocks = []
        for block, (factor, cross) in zip(self._blocks, self._locals, strict=True):
            alone = cho_solve(factor, np.eye(block.stop - block.start))
            both = alone + cross @ unit @ cross.T
            blocks.append(both / np.outer(root[block], root[block]))
        return unit / np.outer(root[:n], root[:n]), blocks


@dataclass(frozen=True)
class Posterior:
    """
    The mode and its surroundings.

    told: what of each unknown the data told, not the prior, 0..1, shape (n,)
    covariance: of what belongs to the unit, shape (n_unit, n_unit)
    variance: of all unknowns, shape (n,)
    whitened: measured minus predicted, whitened, in units of sigma, shape (n_windows, 3)
    log_evidence: logarithm of the marginal likelihood, but for a constant of the data
    """

    state: State
    layout: Layout
    told: Floats
    covariance: Floats
    variance: Floats
    whitened: Floats
    log_evidence: float


@dataclass(frozen=True)
class Absent:
    """
    What the data say of weights that take no part, beside all that does.

    information: on these weights, shape (k, k)
    pull: towards which they would go, shape (k,)
    places: which of them each column's is; -1 where it takes part, shape (2, 3, m)
    """

    information: Floats
    pull: Floats
    places: Ints

    def gain(self, widths: Floats, columns: Bools) -> float:
        """
        Return what columns, shape (m,), would add to the log evidence in one part of their widths:
        ``(q (1 + S)^-1 q - log det(1 + S)) / 2`` with S and q in units of these.
        """
        wanted = (self.places >= 0) & columns
        at, width = self.places[wanted], np.broadcast_to(widths[:, None], wanted.shape)[wanted]
        S, along = np.linalg.eigh(self.information[np.ix_(at, at)] * np.outer(width, width))
        square = _PARTS[:, None] ** 2
        S, q2 = square * np.maximum(S, 0.0), square * (along.T @ (width * self.pull[at])) ** 2
        return 0.5 * float((q2 / (1.0 + S) - np.log1p(S)).sum(axis=1).max(initial=0.0))


class Regression(Design):
    """The Gauss-Newton on the data of a fit; see `Design` for the parameters."""

    def whiten(self, state: State, prior: Prior) -> tuple[Floats, Floats, float]:
        """Residuals without their walk, the same in sds, and minus twice the log likelihood."""
        residual = self.residual(state)
        filtered = np.empty_like(residual)
        size = 0.0
        for axis in range(3):
            found = self._whitened(axis, float(prior.rho[axis]))
            filtered[:, axis] = self._whitener.filter(residual[:, [axis]], found.gains)[:, 0]
            size += found.determinant + 2.0 * len(residual) * float(np.log(prior.sigma[axis]))
        white = filtered / prior.sigma
        return filtered, white, size + float(np.sum(white * white))

    def _equations(
        self, state: State, prior: Prior, layout: Layout, filtered: Floats
    ) -> tuple[Floats, Floats]:
        """Hessian and gradient of minus the log likelihood, of what `whiten` gave."""
        hessian = np.zeros((layout.n, layout.n))
        gradient = np.zeros(layout.n)
        width = layout.axis.shape[1]
        for axis in range(3):
            own = slice(layout.axis[axis, 0], layout.axis[axis, -1] + 1)
            for p in range(len(self._rows)):
                other, G, g = self._block(state, prior, layout, p, axis, filtered)
                hessian[own, own] += G[:width, :width]
                hessian[own, other] += G[:width, width:]
                hessian[np.ix_(other, other)] += G[width:, width:]
                gradient[own] += g[:width]
                gradient[other] += g[width:]
            hessian[layout.n_unit :, own] = hessian[own, layout.n_unit :].T
            hessian[np.ix_(layout.skew, np.arange(own.start, own.stop))] = hessian[
                own, layout.skew
            ].T
        return hessian, gradient

    def _block(
        self, state: State, prior: Prior, layout: Layout, p: int, axis: int, filtered: Floats
    ) -> tuple[Ints, Floats, Floats]:
        """Say what one axis in one position tells: places behind its own, Hessian, gradient."""
        found = self._whitened(axis, float(prior.rho[axis]))
        A = state.inverse
        a = self.gravity * float(A[axis] @ state.up[p])
        kappa = float(state.kappa[axis])
        width, first = layout.axis.shape[1], layout.axis[axis, 0]
        moved, lag = self.moved, self.windows.lag[self.moved]
        m0 = state.start[self._bags[p], lag]
        behind = 1 + len(self.windows.groups) + np.arange(len(moved))
        n_leans = layout.lean.shape[1]
        # How each unknown acts on the base: T; a weight takes its column along with what the
        # start states add to it.
        starts = width + 6 + 2 * n_leans
        T = np.zeros((len(self._base[0]), starts + layout.start.shape[1]))
        T[0, 1] = 1.0
        for places, factor in zip(layout.weights[:, axis], (1.0, kappa * a), strict=True):
            used = np.flatnonzero(places >= 0)
            T[1 + used, places[used] - first] = factor
            used = np.flatnonzero(places[moved] >= 0)
            T[behind[used], places[moved[used]] - first] = factor * m0[used]
        on_bias, on_scale = state.weights[:, axis]
        if layout.start.size:
            T[behind, starts + lag] = (on_bias + kappa * a * on_scale)[moved]
        across = kappa * self.gravity * (A[axis] @ state.tangents[p])
        T[len(T) - n_leans :, width + 6 : starts] = np.kron(np.eye(n_leans), across)
        T = T[layout.base]
        scaled = np.concatenate(([1.0], on_scale, on_scale[moved] * m0, np.zeros(n_leans)))
        scaled = scaled[layout.base]
        T[:, 0] = a * scaled
        turned = kappa * self.gravity * scaled
        for k, (row, source) in enumerate(_SKEW_ROWS):
            if row == axis:
                T[:, width + k] = state.up[p, source] * turned
        T[:, width + 3 : width + 5] = np.outer(turned, A[axis] @ state.tangents[p])
        T[0, width + 5] = 1.0
        rows, variance = self._rows[p], float(prior.sigma[axis]) ** 2
        G = T.T @ (found.grams[p][np.ix_(layout.base, layout.base)] @ T) / variance
        g = T.T @ (found.base[rows].T @ filtered[rows, axis])[layout.base] / variance
        other = np.concatenate(
            (
                layout.skew,
                layout.up[p],
                layout.offset[p, axis : axis + 1],
                layout.lean[p].ravel(),
                layout.start[self._bags[p]],
            )
        )
        return other, G, g

    def ask_absent(self, state: State, prior: Prior, allowed: Prior) -> Absent:
        """Ask the data for columns that take no part; `state` is the mode under `prior`."""
        everything = replace(prior, widths=np.maximum(prior.widths, allowed.widths))
        layout = self.layout(everything.widths > 0.0)
        filtered, *_ = self.whiten(state, everything)
        hessian, pull = self._equations(state, everything, layout, filtered)
        precision = self.precision(everything, layout)
        places = np.where(prior.widths[:, None] == 0.0, layout.weights, -1)
        is_absent = np.isin(np.arange(layout.n), places)
        absent, present = np.flatnonzero(is_absent), np.flatnonzero(~is_absent)
        away = self.vector(state, layout) - self.prior_mean(everything, layout)
        gradient = pull - precision * away
        information = hessian[np.ix_(absent, absent)]
        hessian[np.diag_indices(layout.n)] += precision
        for where, matrix in self._inform(prior, layout):
            hessian[where, where] += matrix
            gradient[where] -= matrix @ away[where]
        kept = hessian[np.ix_(present, present)]
        root = np.sqrt(np.diag(kept))
        factor = cho_factor(kept / np.outer(root, root) + _JITTER * np.eye(len(root)))
        cross = hessian[np.ix_(present, absent)] / root[:, None]
        solved = cho_solve(factor, cross)
        # A mode is one to some digits: columns that are almost others' sums would feel the rest.
        pull = gradient[absent] - solved.T @ (gradient[present] / root)
        number = np.full(layout.n + 1, -1)
        number[absent] = np.arange(len(absent))
        return Absent(information - cross.T @ solved, pull, number[places])

    def without(self, posterior: Posterior, prior: Prior, p: int) -> State | None:
        """
        Find the mode that the other positions alone would give, to first order.

        What belongs to the unit has moved; the rest is as it was. None where the others do not
        tell something that this one does.
        """
        layout, n = posterior.layout, posterior.layout.n_unit
        filtered = posterior.whitened * prior.sigma
        starts = layout.start[self._bags[p]]
        local = np.concatenate((layout.up[p], layout.offset[p], layout.lean[p].ravel(), starts))
        place = np.full(layout.n, -1)
        place[:n] = np.arange(n)
        place[local] = n + np.arange(len(local))
        size = n + len(local)
        hessian, gradient = np.zeros((size, size)), np.zeros(size)
        for axis in range(3):
            other, G, g = self._block(posterior.state, prior, layout, p, axis, filtered)
            where = place[np.concatenate((layout.axis[axis], other))]
            hessian[np.ix_(where, where)] += G
            gradient[where] += g
        away = self.vector(posterior.state, layout)
        known = np.diag(self.precision(prior, layout)[local])
        if n_starts := len(starts):
            known[-n_starts:, -n_starts:] += self.start_information / prior.start_share
        gradient[n:] -= known @ away[local]
        inner = np.linalg.solve(
            hessian[n:, n:] + known, np.column_stack((hessian[n:, :n], gradient[n:]))
        )
        told = hessian[:n, :n] - hessian[:n, n:] @ inner[:, :n]
        pull = gradient[:n] - hessian[:n, n:] @ inner[:, n]
        # In coordinates of unit variance: what this position alone told is near 1.
        scale = np.sqrt(np.diag(posterior.covariance))
        root = np.linalg.cholesky(
            posterior.covariance / np.outer(scale, scale) + _JITTER * np.eye(n)
        )
        root *= scale[:, None]
        shares, directions = np.linalg.eigh(root.T @ told @ root)
        left = 1.0 - shares
        if left.min() < _LEAST_LEFT:
            return None
        step = np.zeros(layout.n)
        step[:n] = -root @ (directions @ ((directions.T @ (root.T @ pull)) / left))
        return self._moved(posterior.state, step, layout)

    def solve(
        self, state: State, prior: Prior, n_steps: int = 6, tolerance: float = 1e-3
    ) -> Posterior:
        """
        Find the mode under a prior, in so many steps or, where it is far, in as many as it takes;
        one step only looks where a state is; with none, short ones are taken unseen.
        """
        layout = self.layout(prior.widths > 0.0)
        precision = self.precision(prior, layout)
        matrices = self._inform(prior, layout)
        mean = self.prior_mean(prior, layout)
        information = np.diag(precision)
        for where, matrix in matrices:
            information[where, where] += matrix

        def look(state: State) -> _Look:
            filtered, white, size = self.whiten(state, prior)
            away = self.vector(state, layout) - mean
            pull = information @ away
            return state, filtered, white, pull, size + float(away @ pull)

        def equations(at: _Look) -> tuple[Floats, Floats]:
            hessian, gradient = self._equations(at[0], prior, layout, at[1])
            return hessian + information, gradient - at[3]

        # All but these is linear: wherever these go, the rest follows at once.
        bends = np.zeros(layout.n, dtype=bool)
        for places in (layout.kappa, layout.skew, layout.up, layout.start):
            bends[places] = True
        # What takes no part any more is 0.
        found = look(self._moved(state, np.zeros(layout.n), layout))
        far = _FAR * self.windows.mean.size
        last = max(n_steps, _MOST_STEPS) - 1 if n_steps != 1 else 0
        for k in range(last + 1):
            state, _, white, _, size = found
            hessian, gradient = equations(found)
            factor = Factor(hessian, layout)
            step = factor.solve(gradient)
            promised = 0.5 * float(step @ gradient)
            if is_short := not n_steps and promised < _NEAR:
                state = self._moved(state, step, layout)
            is_enough = k == last or (k >= (n_steps or 2) - 1 and promised < far)
            if promised < tolerance or is_short or is_enough:
                break
            found, share = look(self._moved(state, step, layout)), 1.0
            while found[-1] >= size and share > _LEAST_SHARE:
                found = look(self._moved(state, np.where(bends, share * step, 0.0), layout))
                held, pull = equations(found)
                held[np.diag_indices(layout.n)] *= np.where(bends, _HELD, 1.0)
                follow = Factor(held, layout).solve(pull)
                found, share = look(self._moved(found[0], follow, layout)), _FALL * share
            if found[-1] >= size:
                break
        determinant = float(np.log(precision[precision > 0.0]).sum())
        determinant += sum(float(np.linalg.slogdet(matrix)[1]) for _, matrix in matrices)
        evidence = -0.5 * (size - 2.0 * promised + factor.log_determinant - determinant)
        covariance, blocks = factor.covariances()
        variance = np.concatenate([np.diag(block) for block in (covariance, *blocks)])
        told = 1.0 - precision * variance
        ends = [layout.n_unit, *(block.stop for block in layout.blocks)]
        for where, matrix in matrices:
            # What is known together ends with the unit's, or with one bag's.
            at = slice(-len(matrix), None)
            own = (covariance, *blocks)[ends.index(where.stop)][at, at]
            told[where] = 1.0 - np.einsum('ij,ji->i', matrix, own)
        return Posterior(state, layout, told, covariance, variance, white, evidence)
