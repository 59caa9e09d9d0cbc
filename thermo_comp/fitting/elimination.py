# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the elimination of the unknowns of positions and bags from the normal equations of a fit.

Each position has unknowns (attitude, error of |f|, bias offset, tilts) that occur in no other
position, and each bag has unknowns (initial lag states, turn-on offset) that occur in no other
bag. The unknowns of the positions are eliminated first, then the unknowns of the bags (Schur
complement). The normal equations of the unit's unknowns remain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dpotrs, dtrtri

from ..typing import Floats, Ints
from .layout import Layout, Normal


def factored(matrix: Floats, diagonal: Floats | None = None) -> Floats:
    """
    Return the lower Cholesky factors of matrices that are positive definite except for rounding
    errors, shape (..., n, n).

    Each matrix is scaled to a unit diagonal, or by the roots of a given `diagonal`, (..., n).
    Jitters of rising size are added to the scaled diagonal until a Cholesky factor exists.
    """
    square = np.einsum('...ii->...i', matrix) if diagonal is None else diagonal
    root = np.sqrt(square)
    scaled = matrix / root[..., None, :]
    scaled /= root[..., :, None]
    index = np.arange(matrix.shape[-1])
    jitters = 1e-13, 1e-11, 1e-9, 1e-7
    for jitter in jitters:
        scaled[..., index, index] += jitter
        try:
            factor = np.linalg.cholesky(scaled)
        except np.linalg.LinAlgError:
            if matrix.ndim > 2:
                # Factor each matrix separately, so that each gets only the jitter that it needs.
                return np.stack([factored(*pair) for pair in zip(matrix, square, strict=True)])
            if jitter == jitters[-1]:
                raise
        else:
            break
    factor *= root[..., :, None]
    return np.asarray(factor, dtype=np.float64)


def factored_with_prior(information: Floats, precision: Floats) -> Floats:
    """
    Return the lower Cholesky factor of an information matrix plus the precision of a prior, (n,).

    The information is a difference of larger matrices, so its smallest eigenvalues are rounding
    errors. If information plus precision has no Cholesky factor, both are scaled to a unit
    diagonal of their sum, and the eigenvalues of the information that are at most ten times the
    size of its most negative eigenvalue become 0.
    """
    places = np.diag_indices(len(information))
    hessian = information.copy()
    hessian[places] += precision
    if not np.all(hessian[places] > 0.0):
        raise np.linalg.LinAlgError('rounding errors exceed the information about an unknown')
    try:
        return factored(hessian)
    except np.linalg.LinAlgError:
        root = np.sqrt(hessian[places])
        values, vectors = np.linalg.eigh(information / np.outer(root, root))
        values[values < 10.0 * abs(min(values[0], 0.0))] = 0.0
        half = root[:, np.newaxis] * vectors * np.sqrt(values)
        hessian = half @ half.T
        hessian[places] += precision
        return factored(hessian)


def solved(factor: Floats, right: Floats) -> Floats:
    """Solve equations, given the lower Cholesky factor of their matrix."""
    return np.asarray(dpotrs(factor.T, right)[0])


def inverse_root(factor: Floats) -> Floats:
    """Return the upper triangular root of a matrix's inverse, given its lower Cholesky factor."""
    return np.asarray(dtrtri(factor.T)[0])


@dataclass(frozen=True)
class Blocks:
    """
    Diagonal blocks of the normal equations whose k unknowns are eliminated: the blocks of the n
    positions or of the n bags, or the single block of the prior of sums (`Reduced.common`).

    root: inverse of each block's lower Cholesky factor, shape (n, k, k)
    whitened: `root` times the off-diagonal block of the eliminated and the m remaining unknowns
        and, in the last column, `root` times the gradient, shape (n, k, m + 1)
    """

    root: Floats
    whitened: Floats

    @classmethod
    def of(cls, block: Floats, cross: Floats, diagonal: Floats | None = None) -> Blocks:
        """Eliminate diagonal blocks, given `cross` (off-diagonal blocks and gradients)."""
        # The inverse by `numpy.linalg.inv`, which is not made for triangular factors, is slower.
        root = np.stack([inverse_root(factor).T for factor in factored(block, diagonal)])
        return cls(root, root @ cross)

    @cached_property
    def solved(self) -> Floats:
        """Inverse of each block times its cross block and its gradient, shape (n, k, m + 1)."""
        return np.asarray(np.swapaxes(self.root, 1, 2) @ self.whitened)

    @property
    def inverse(self) -> Floats:
        """Inverse of each block, shape (n, k, k)."""
        return np.asarray(np.swapaxes(self.root, 1, 2) @ self.root)

    @property
    def log_determinant(self) -> float:
        """Sum of the log determinants of the eliminated blocks."""
        return -2.0 * float(np.log(np.einsum('nii->ni', self.root)).sum())


@dataclass(frozen=True)
class Reduced:
    """
    The normal equations of the unit's n unknowns after the elimination of all other unknowns.

    of_bag_prior: prior precision of the unknowns of bags, and this precision times their distance
        from the prior mean, shape (2, n_bags, r)
    matrix: Hessian without the prior of the unit's unknowns and, in the last column, the gradient,
        shape (n + 1, n + 1)
    positions: blocks of the positions; the remaining unknowns are the bag's, then the unit's
    shares: contribution of each position to the block, the off-diagonal blocks and the gradient of
        its bag, shape (n_positions, r, r + n + 1); and its contribution to the diagonal of the
        bag's block before the elimination of the positions, shape (n_positions, r)
    bags: blocks of the bags
    common: block of the prior on the sum of the initial lag states over the bags, or None
    """

    layout: Layout
    of_bag_prior: Floats
    matrix: Floats
    positions: Blocks
    shares: tuple[Floats, Floats]
    bags: Blocks
    common: Blocks | None = None

    @property
    def log_determinant(self) -> float:
        """Sum of the log determinants of all eliminated blocks."""
        blocks = self.positions, self.bags, self.common
        return sum(block.log_determinant for block in blocks if block is not None)

    def with_prior_of_sum(self, total: Floats, variance: float) -> Reduced:
        """Add a prior (mean 0, `variance`) of `total`, the sum of initial lag states over bags."""
        r = len(total)
        cross = self.bags.solved[:, :r].sum(axis=0, keepdims=True)
        cross[..., -1] += total
        block = self.bags.inverse[:, :r, :r].sum(axis=0, keepdims=True) + variance * np.eye(r)
        common = Blocks.of(block, cross)
        return replace(self, common=common, matrix=self.matrix + _square(common.whitened))

    def follow(self, step: Floats) -> tuple[Floats, Floats]:
        """Return steps of positions' and bags' unknowns, given the step of the unit's unknowns."""
        r, solved = len(self.bags.root[0]), self.positions.solved
        bags = self.bags.solved[..., -1] - self.bags.solved[..., :-1] @ step
        if self.common is not None:
            excess = self.common.solved[0, :, -1] - self.common.solved[0, :, :-1] @ step
            bags -= self.bags.inverse[..., : len(excess)] @ excess
        positions = solved[..., -1] - solved[..., r:-1] @ step
        positions -= np.einsum('pkr,pr->pk', solved[..., :r], bags[self.layout.bag])
        return positions, bags

    def variances(self, root: Floats) -> tuple[Floats, Floats]:
        """
        Return the variances of the unknowns of positions and bags, without the prior on the sum of
        the initial lag states; `root`: upper triangular root of the unit's covariance.
        """
        bag, r, solved = self.layout.bag, len(self.bags.root[0]), self.positions.solved
        by_unit, by_bag = self.bags.solved[..., :-1], solved[..., :r]
        bags = np.sum(self.bags.root**2, axis=1) + _variance(by_unit, root)
        of_bags = by_bag @ np.swapaxes(self.bags.root[bag], 1, 2)
        positions = np.sum(self.positions.root**2, axis=1) + np.sum(of_bags**2, axis=2)
        positions += _variance(solved[..., r:-1] - by_bag @ by_unit[bag], root)
        return positions, bags

    def without(self, places: Ints, normal: Normal) -> Floats:
        """Return `matrix` without positions `places`, whose normal equations are `normal`."""
        bag, r = self.layout.bag, len(self.bags.root[0])
        at = np.unique(bag[places])
        others = (bag == at[:, None]) & ~np.isin(np.arange(len(bag)), places)
        rest = _of_bags(others.astype(np.float64), self.shares, self.of_bag_prior[:, at])
        left_out = _of_unit(normal.unit, self.layout)
        left_out -= _square(self.positions.whitened[places][..., r:])
        remaining = self.matrix - left_out + _square(self.bags.whitened[at])
        return np.asarray(remaining - _square(rest.whitened))

    def eliminate_from(self, rows: Floats) -> tuple[Floats, Floats]:
        """
        Eliminate the unknowns of positions and bags from the equations of m new unknowns per axis.

        `rows`: products of the derivatives w.r.t. the new unknowns with the derivatives w.r.t. the
        fit's unknowns and with the residual, shape (n_positions, 3, m, k + 1). Returns the
        matrix that the elimination subtracts from the Hessian of the new unknowns, (3 m, 3 m); and
        the products, after the elimination, of the new unknowns with the unit's unknowns and with
        the residual (the gradient), shape (n + 1, 3 m).
        """
        layout, whitened = self.layout, self.positions.whitened
        n_positions, n_own, _ = whitened.shape
        n_local, r, m = layout.n_local, layout.of_bag.shape[1], rows.shape[2]
        local = np.zeros((n_positions, n_own + r, m, 3))
        unit = np.zeros((layout.n_unit + 1, m, 3))
        for axis, at in enumerate(layout.columns):
            each = np.swapaxes(rows[:, axis], 1, 2)
            local[..., axis][:, at[:n_local]] = each[:, :n_local]
            unit[layout.unit[axis], :, axis] = each[:, n_local:].sum(axis=0)
        local = local.reshape(n_positions, n_own + r, 3 * m)
        of_positions = self.positions.root @ local[:, :n_own]
        shares = local[:, n_own:] - np.swapaxes(whitened[..., :r], 1, 2) @ of_positions
        of_bags = self.bags.root @ np.tensordot(_membership(layout), shares, 1)
        cross = unit.reshape(-1, 3 * m)
        cross -= _summed(whitened[..., r:], of_positions) + _summed(self.bags.whitened, of_bags)
        reduction = _square(of_positions, of_bags)
        if self.common is not None:
            # Take account of the prior on the sum of the initial lag states over the bags.
            starts = (np.swapaxes(self.bags.root, 1, 2) @ of_bags).sum(axis=0)
            of_sum = self.common.root @ starts[: layout.start.shape[1]]
            cross += _summed(self.common.whitened, of_sum)
            reduction -= _square(of_sum)
        return reduction, cross


def eliminate(normal: Normal, layout: Layout, precision: Floats, deviation: Floats) -> Reduced:
    """
    Eliminate the unknowns of positions and bags.

    normal: the normal equations in units of the noise
    precision, deviation: inverse prior variances, and unknowns less prior means, shape (n,)
    """
    n_positions, n_own = layout.own.shape
    r, n_local = layout.of_bag.shape[1], layout.n_local
    rows = np.zeros((n_positions, n_own + r, n_own + r + layout.n_unit + 1))
    for axis, at in enumerate(layout.columns):
        rows[:, at[:n_local, None], at] += normal.local[:, axis]
    block, cross = rows[:, :n_own, :n_own], rows[:, :n_own, n_own:]
    diagonal = np.einsum('pii->pi', block)  # a view of `block`
    diagonal += precision[layout.own]
    cross[..., -1] -= (precision * deviation)[layout.own]
    # A diagonal element of 0, for an attitude without information in the data, is set to 1.
    diagonal += diagonal <= 0.0
    positions = Blocks.of(block, cross)
    of_bag = rows[:, n_own:, n_own:]
    reduced = of_bag - np.swapaxes(positions.whitened[..., :r], 1, 2) @ positions.whitened
    shares = reduced, np.einsum('pii->pi', of_bag[..., :r])
    prior = np.stack((precision, precision * deviation))[:, layout.of_bag]
    bags = _of_bags(_membership(layout), shares, prior)
    matrix = _of_unit(normal.unit, layout)
    matrix -= _square(positions.whitened[..., r:], bags.whitened)
    return Reduced(layout, prior, matrix, positions, shares, bags)


def _membership(layout: Layout) -> Floats:
    """Return 1 for the positions of each bag, else 0, shape (n_bags, n_positions)."""
    return np.asarray(layout.bag == np.arange(len(layout.start))[:, None], dtype=np.float64)


def _of_unit(normal: Floats, layout: Layout) -> Floats:
    """Add the normal equations of the three axes for the unit's unknowns, shape (3, k, k)."""
    result = np.zeros((layout.n_unit + 1, layout.n_unit + 1))
    for equations, at in zip(normal, layout.unit, strict=True):
        result[at[:, None], at] += equations
    return result


def _of_bags(members: Floats, shares: tuple[Floats, Floats], prior: Floats) -> Blocks:
    """Eliminate the unknowns of m bags; `members`: 1 for positions of a bag, else 0, (m, n)."""
    if not shares[0].size:
        n = len(members)
        return Blocks(np.zeros((n, 0, 0)), np.zeros((n, *shares[0].shape[1:])))
    sums, diagonals = (np.tensordot(members, share, 1) for share in shares)
    r = diagonals.shape[1]
    block, cross = sums[..., :r], sums[..., r:]
    block[:, np.arange(r), np.arange(r)] += prior[0]
    cross[..., -1] -= prior[1]
    return Blocks.of(block, cross, diagonals + prior[0])


def _variance(derivatives: Floats, root: Floats) -> Floats:
    """Return the variances, (n, k), of functions of the unit's unknowns with `derivatives`."""
    rows = derivatives.reshape(-1, len(root))
    scaled = dtrmm(1.0, root, rows.T, trans_a=True)
    return np.asarray(np.sum(scaled**2, axis=0).reshape(derivatives.shape[:2]))


def _square(*blocks: Floats) -> Floats:
    """Return the matrix that the elimination of blocks subtracts from the equations, (k, k)."""
    rows = np.concatenate([block.reshape(-1, block.shape[2]) for block in blocks])
    return np.asarray(rows.T @ rows)


def _summed(left: Floats, right: Floats) -> Floats:
    """Return the sum over blocks of ``left.T @ right``, shape (k, m)."""
    return np.asarray(left.reshape(-1, left.shape[2]).T @ right.reshape(-1, right.shape[2]))
