# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the covariance of a corrected sample as polynomials in the forces of the three axes.

x, y, z are the specific forces along the axes, before the misalignment is corrected. The vector u
has nine elements: a constant error and a scale error of each axis, and the errors of the three
elements yx, zx, zy of the misalignment. To first order the error e of the corrected force is ::

    e_x = u0 + x u1
    e_y = yx (u0 + x u1) + u2 + y u3 + x u6
    e_z = zx (u0 + x u1) + zy (u2 + y u3) + u4 + z u5 + x u7 + y u8

Each element of the covariance of the force error e is a polynomial of second degree in the forces
x, y, z, whose coefficients are sums over the elements of the covariance of the errors u. The
covariance of u is stored as rows: first a, b, c of the error variance ``a + b x + c x^2`` of each
axis, then the covariance of each pair of errors in `BETWEEN`.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Final, TypeVar

import numpy as np

from ..typing import Floats
from .functions import in_order

# Type of a quantity: the value of one sample, or an array of many samples.
Real = TypeVar('Real', float, Floats)

_OF_AXES: Final = [(u + i, u + j) for u in (0, 2, 4) for i, j in ((0, 0), (0, 1), (1, 1))]
_PAIRS: Final = list(combinations_with_replacement(range(9), 2))
#: Pairs of errors u: of two different axes, or of a misalignment error and any error.
BETWEEN: Final = [pair for pair in _PAIRS if pair not in _OF_AXES]
#: Number of rows of a covariance of the nine errors u.
N_ROWS: Final = len(_PAIRS)
_FIRST, _SECOND = np.array(BETWEEN).T
#: Rows of `BETWEEN` with the variances of the misalignment's elements.
OF_MISALIGNMENT: Final = [BETWEEN.index((u, u)) for u in (6, 7, 8)]
#: Terms of the polynomials xx, xy, xz, yy, yz, zz: pairs of indices in (1, x, y, z).
_TERMS: Final = [
    [(i, j) for i, j in combinations_with_replacement(range(4), 2) if i < first and j < second]
    for first, second in combinations_with_replacement((2, 3, 4), 2)
]
#: Number of coefficients of the polynomials xx to zz; indices of the constants of xx, yy, zz.
N_COEFFICIENTS: Final = sum(map(len, _TERMS))
CONSTANTS: Final = tuple(sum(map(len, _TERMS[:element])) for element in (0, 3, 5))


class CovarianceMap:
    """Linear map from rows of the covariance of errors u to coefficients of xx, xy, ..., zz."""

    def __init__(self, misalignment: Sequence[float]) -> None:
        yx, zx, zy = misalignment
        # Derivative of the force w.r.t. errors u: coefficients of 1, x, y, z, shape (axis, 4, u).
        J = np.zeros((3, 4, 9))
        J[0, 0, 0] = J[0, 1, 1] = J[1, 0, 2] = J[1, 2, 3] = J[2, 0, 4] = J[2, 3, 5] = 1.0
        J[2] += zx * J[0] + zy * J[1]
        J[1] += yx * J[0]
        J[1, 1, 6] = J[2, 1, 7] = J[2, 2, 8] = 1.0
        sums = np.zeros((N_COEFFICIENTS, 9, 9))
        elements = zip(combinations_with_replacement(range(3), 2), _TERMS, strict=True)
        places = [(*axes, *term) for axes, terms in elements for term in terms]
        for place, (k, m, i, j) in enumerate(places):
            products = np.outer(J[k, i], J[m, j]) + np.outer(J[k, j], J[m, i]) * (i != j)
            sums[place] = products + np.tril(products, -1).T
        u, w = np.array([*_OF_AXES, *BETWEEN]).T
        factors = sums[:, u, w]
        # Row b of an axis is twice the covariance of the axis' constant error and scale error.
        factors[:, 1:9:3] /= 2.0
        # Each coefficient has nonzero factors of only a few rows of the covariance of u.
        n = int((factors != 0.0).sum(axis=1).max())
        self._places = np.argsort(factors == 0.0, axis=1, kind='stable')[:, :n]
        self._factors = np.take_along_axis(factors, self._places, axis=1)[:, :, np.newaxis]

    def coefficients(self, rows: Floats) -> Floats:
        """Map the covariance of errors u, (45, n), to coefficients of xx, xy, ..., zz, (40, n)."""
        return in_order(self._factors * rows[self._places], 1)


def grown(between: Floats, growth: Floats) -> Floats:
    """Return covariances `BETWEEN`, (36, n), for axis variances `growth`, (3, n), times larger."""
    # Errors of the misalignment do not grow, as it does not depend on the temperature.
    roots = np.concatenate((np.repeat(np.sqrt(growth), 2, 0), np.ones_like(growth)))
    return np.asarray(between * roots[_FIRST] * roots[_SECOND])


def rows_between(errors: Floats, misalignment_variances: Floats) -> Floats:
    """
    Return the rows `BETWEEN`, (36, n), of the covariance of u. `errors`, (9, p, n): u due to each
    of p independent causes; `misalignment_variances`, (3,): added variances of misalignments.
    """
    # The sums do not use BLAS, whose results depend on the arrays' alignment.
    result = in_order(errors[_FIRST] * errors[_SECOND], 1)
    result[OF_MISALIGNMENT] += misalignment_variances[:, np.newaxis]
    return result


def covariance_at(
    coefficients: Sequence[Real], x: Real, y: Real, z: Real
) -> tuple[Real, Real, Real, Real, Real, Real]:
    """Evaluate xx, xy, xz, yy, yz, zz of the covariance of the corrected force [m^2/s^4]."""
    (a, ax, axx, b, bx, by, bxx, bxy, c, cx, cy, cz, cxx, cxy, cxz, d, dx, dy, dxx, dxy, dyy,
     e, ex, ey, ez, exx, exy, exz, eyy, eyz,
     f, fx, fy, fz, fxx, fxy, fxz, fyy, fyz, fzz) = coefficients  # fmt: skip
    return (
        a + x * (ax + x * axx),
        b + x * (bx + x * bxx + y * bxy) + y * by,
        c + x * (cx + x * cxx + y * cxy + z * cxz) + y * cy + z * cz,
        d + x * (dx + x * dxx + y * dxy) + y * (dy + y * dyy),
        e + x * (ex + x * exx + y * exy + z * exz) + y * (ey + y * eyy + z * eyz) + z * ez,
        f
        + x * (fx + x * fxx + y * fxy + z * fxz)
        + y * (fy + y * fyy + z * fyz)
        + z * (fz + z * fzz),
    )
