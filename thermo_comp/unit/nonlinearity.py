# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the nonlinearity of the axes over specific force: terms, correction and variance.

x is the sample of an axis less bias, divided by the scale factor; f is the specific force along
the sensitivity axis. With x and f in g, as in IEEE Std 1293::

    x = f + K2 f^2 + Kq |f| f + K3 f^3,    K = coefficient + per_kelvin (T_board - T_ref)

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple

import numpy as np

from ..quantities import QUANTITIES
from ..typing import Floats
from .covariance import N_COEFFICIENTS, Real, covariance_at
from .functions import hold, in_order
from .gravity import STANDARD_GRAVITY
from .schema import Vector, broken, check_ranges

if TYPE_CHECKING:
    from .calibration import Calibration

Kind = Literal['square', 'odd_square', 'cube']
#: Nonlinear terms in the order of a calibration file. The unit of a coefficient is 1/g to the
#: power of this number.
POWERS: dict[Kind, int] = {'square': 1, 'odd_square': 1, 'cube': 2}
#: Prior sd of K2 [g/g^2]: above the limits of K2 in data sheets of quartz pendulum
#: accelerometers, 20 to 60 ug/g^2.
K2_SD = 1e-4
#: Largest |f| / gravity at which |f| is taken as gravity.
AT_REST = 1.01
#: Largest accepted slope of the nonlinear terms up to full scale, at which one step of Halley's
#: method is still accurate enough.
LARGEST_SLOPE = 0.2

#: Index of the first coefficient of the nonlinearity in a result of `Correction.line`.
_NONLINEAR: Final = 12 + N_COEFFICIENTS


@dataclass(frozen=True)
class NonlinearTerm:
    """One term of the nonlinearity, with the coefficients of the axes x, y, z."""

    kind: Annotated[Kind, 'square: K2 f^2; odd_square: Kq abs(f) f; cube: K3 f^3.']
    coefficient: Annotated[
        Vector, 'Coefficient at the reference temperature [g/g^2; K3 in g/g^3].'
    ]
    per_kelvin: Annotated[
        Vector, 'Change of `coefficient` per kelvin of the board, within the calibrated range.'
    ]
    prior_sd: Annotated[float, QUANTITIES['nonlinearity'], 'Prior sd of `coefficient`.']
    effective_parameters: Annotated[
        float, QUANTITIES['number'], 'Effective number of coefficients determined by the data.'
    ] = 0.0
    log_evidence_change: Annotated[
        float, QUANTITIES['log evidence'], 'Loss of log evidence without this nonlinear term.'
    ] = 0.0
    left_out_gain: Annotated[
        float,
        QUANTITIES['log evidence'],
        'Log of a ratio: mean-square error on left-out data without the term / with the term.',
    ] = 0.0


@dataclass(frozen=True)
class Nonlinearity:
    """
    The nonlinearity of the three axes. Beyond the forces of the fit the polynomials continue, and
    the covariance includes the variance of an unknown term K2 d^2. d is the force less the largest
    force of the fit; K2 has the sd `beyond_sd_g_g2`.
    """

    force_range_m_s2: Annotated[
        tuple[Annotated[float, QUANTITIES['error']], Annotated[float, QUANTITIES['error']]],
        'Smallest and largest norm of the specific force in the fit.',
    ]
    beyond_sd_g_g2: Annotated[
        float,
        QUANTITIES['nonlinearity'],
        'Sd of K2 in an unknown term K2 d^2, d: force beyond the largest in the fit.',
    ]
    terms: Annotated[
        tuple[NonlinearTerm, ...], 'At most one square, odd square and cube term, in this order.'
    ] = ()

    def __post_init__(self) -> None:
        check_ranges(self, force_range_m_s2=QUANTITIES['error'])
        kinds = [term.kind for term in self.terms]
        if kinds != [kind for kind in POWERS if kind in kinds]:
            raise ValueError(f'`terms` must be of {list(POWERS)}, at most one each, in this order')

    def check_slope(self, force: float, temperatures: Sequence[float]) -> None:
        """Raise ValueError if the nonlinear terms are too steep up to |f| = `force` [m/s^2]."""
        for t in temperatures:
            k2, kq, k3 = np.abs(self.coefficients(np.array([t])))[..., 0]
            slope = float(np.max(2.0 * (k2 + kq) * force + 3.0 * k3 * force * force))
            if not slope < LARGEST_SLOPE:
                rule = f'have a slope below {LARGEST_SLOPE:g} up to full scale'
                got = f'{slope:.3g} at {t:+.3g} K from T_ref'
                raise broken('nonlinearity.terms', rule, got)

    def coefficients(self, t: Floats) -> Floats:
        """Return K2, Kq [s^2/m], K3 [s^4/m^2] of axes at T_ref + t [K], shape (3, 3, n)."""
        result = np.zeros((3, 3, len(t)))
        for term in self.terms:
            at, slope = np.array([term.coefficient, term.per_kelvin])[:, :, np.newaxis]
            result[list(POWERS).index(term.kind)] = (at + slope * t) / unit_of(term.kind)
        return result


def unit_of(kind: Kind) -> float:
    """Return the divisor that converts a coefficient in g/g^n to SI units."""
    return float(STANDARD_GRAVITY ** POWERS[kind])


def linearised(x: Real, k2: Real, kq: Real, k3: Real) -> Real:
    """
    Solve ``x = f + k2 f^2 + kq |f| f + k3 f^3`` for f by one step of Halley's method from x. The
    error of the result is about (k^2 - k3) (x - f)^3, with k = k2 + kq sign(f). At f = 10 g the
    error is 1e-14 g for k2 = 100 ug/g^2, and 1e-11 g for k3 = 10 ug/g^3.
    """
    r = k3 * x * x
    s = k2 * x + kq * abs(x) + r
    d = 1.0 + (s + s + r)
    return x - x * s * d / (d * d - s * (s + r + r))


def corrected_nonlinear(
    line: Sequence[Real], misalignment: tuple[float, ...], dt: Real, x: Real, y: Real, z: Real
) -> tuple[Real, Real, Real, Real, Real, Real, Real, Real, Real]:
    """Return the force of a sample, and the elements xx to zz of its covariance."""
    bx, bx1, sx, sx1, by, by1, sy, sy1, bz, bz1, sz, sz1 = line[:12]
    k2x, kqx, k3x, k2y, kqy, k3y, k2z, kqz, k3z = line[_NONLINEAR : _NONLINEAR + 9]
    yx, zx, zy = misalignment
    # Solve Eq. (7), (8) of docs/theory.md for x of each axis, then the nonlinearity for f.
    x = linearised((x - (bx + bx1 * dt)) / (sx + sx1 * dt), k2x, kqx, k3x)
    y = linearised((y - (by + by1 * dt)) / (sy + sy1 * dt), k2y, kqy, k3y)
    z = linearised((z - (bz + bz1 * dt)) / (sz + sz1 * dt), k2z, kqz, k3z)
    xx, xy, xz, yy, yz, zz = nonlinear_covariance(line, misalignment, x, y, z)
    return x, yx * x + y, zx * x + zy * y + z, xx, xy, xz, yy, yz, zz


def nonlinear_covariance(
    line: Sequence[Real], misalignment: tuple[float, ...], x: Real, y: Real, z: Real
) -> tuple[Real, Real, Real, Real, Real, Real]:
    """Return the elements xx, xy, xz, yy, yz, zz of the covariance of the force (x, y, z)."""
    xx, xy, xz, yy, yz, zz = covariance_at(line[12:_NONLINEAR], x, y, z)
    dx, ex, fx, gx, dy, ey, fy, gy, dz, ez, fz, gz = line[_NONLINEAR + 9 :]
    yx, zx, zy = misalignment
    vx = x * x * x * (dx + x * (ex + x * (fx + x * gx)))
    vy = y * y * y * (dy + y * (ey + y * (fy + y * gy)))
    vz = z * z * z * (dz + z * (ez + z * (fz + z * gz)))
    cxy = yx * vx
    cxz = zx * vx
    return (
        xx + vx,
        xy + cxy,
        xz + cxz,
        yy + (yx * cxy + vy),
        yz + (yx * cxz + zy * vy),
        zz + (zx * cxz + zy * zy * vy + vz),
    )


class BeyondForce(NamedTuple):
    """
    The variance of the force on an axis due to an unknown square term that begins at the force
    `edge` [m/s^2]: ``growth (2 d)^4`` [m^2/s^4], with d = |x| - `edge`; 0 below `edge`.
    """

    edge: float
    growth: float

    def widened(
        self, x: Real, y: Real, z: Real,
        xx: Real, xy: Real, xz: Real, yy: Real, yz: Real, zz: Real,
    ) -> tuple[Real, Real, Real, Real, Real, Real, Real, Real, Real]:  # fmt: skip
        """Add the variance of an unknown K2 term to the covariance xx, xy, ..., zz of a sample."""
        xx, yy, zz = xx + self._variance(x), yy + self._variance(y), zz + self._variance(z)
        return x, y, z, xx, xy, xz, yy, yz, zz

    def _variance(self, x: Real) -> Real:
        over = abs(x) - self.edge
        over = over + abs(over)  # twice the distance beyond `edge`, or 0
        over = over * over
        return self.growth * over * over


def beyond_force(calibration: Calibration) -> BeyondForce:
    """Return the variance of an unknown square term beyond the largest |f| of the fit."""
    fitted = calibration.nonlinearity
    edge = fitted.force_range_m_s2[1] if fitted else AT_REST * calibration.gravity_m_s2
    sd = (fitted.beyond_sd_g_g2 if fitted else K2_SD) / STANDARD_GRAVITY
    return BeyondForce(edge, sd * sd / 16.0)


class ForceCorrection:
    """The nonlinearity of a calibration as a function of the board temperature [degC]."""

    def __init__(
        self, calibration: Calibration, nonlinearity: Nonlinearity, span: tuple[float, float]
    ) -> None:
        self._nonlinearity = nonlinearity
        self._reference, self._span = calibration.reference_temperature_c, span

    def held(self, board: Floats) -> Floats:
        """Return board temperatures less the reference, limited to the calibrated range."""
        return hold(board, *self._span) - self._reference

    def linearise(self, x: Floats, board: Floats) -> Floats:
        """Subtract the nonlinear terms from x (see module), (n, 3), at board temperatures (n,)."""
        k2, kq, k3 = self._nonlinearity.coefficients(self.held(board))
        return np.asarray(linearised(x.T, k2, kq, k3).T)

    def regressors(self, force: Floats, board: Floats) -> Floats:
        """Return derivatives of x w.r.t. k coefficients, then their changes per K, (n, 3, 2 k)."""
        size = np.abs(force)
        each = {'square': force**2, 'odd_square': size * force, 'cube': force**3}
        values = [each[term.kind] / unit_of(term.kind) for term in self._nonlinearity.terms]
        both = [*values, *(self.held(board)[:, np.newaxis] * value for value in values)]
        return np.stack(both, axis=2) if both else np.zeros((*force.shape, 0))

    def rows(self, board: Floats, slow: Floats) -> Floats:
        """
        Return K2, Kq, K3 of each axis, then coefficients of x^3 to x^6 in the variance of each
        axis, (21, n). `slow`: coefficients of x^2 to x^6 in the variance of each axis, (15, n).
        """
        k = self._nonlinearity.coefficients(self.held(board)).swapaxes(0, 1)
        higher = slow.reshape(3, 5, -1)[:, 1:]
        return np.concatenate((k.reshape(9, -1), higher.reshape(12, -1)))

    def variance(
        self, t: Floats, factor: Floats, diagonal: Floats, on_bias: Floats, on_scale: Floats
    ) -> Floats:
        """
        Return the contribution of the nonlinear terms to the coefficients of x^2 to x^6 in the
        error variance of an axis, (5, n); `t`: T_board - T_ref, (n,) [K].

        The covariance of the coefficients of the k terms is ``factor @ factor.T + diag(diagonal)``
        with `factor` of shape (2 k, rank); `on_bias`, `on_scale`, (rank, n): bias and relative
        scale due to each column of `factor`. Covariances of Kq with other parameters, which are
        omitted, are mostly negative, so the result is mostly too large.
        """
        terms = self._nonlinearity.terms
        k, kinds = len(terms), [list(POWERS).index(term.kind) for term in terms]
        units = np.array([unit_of(term.kind) for term in terms])[:, np.newaxis]
        by_column, alone = np.zeros((3, *on_bias.shape)), np.zeros((3, len(t)))
        by_column[kinds] = (factor[:k, :, None] + t * factor[k:, :, None]) / units[:, :, None]
        alone[kinds] = (diagonal[:k, None] + t * t * diagonal[k:, None]) / (units * units)
        (n2, nq, n3), (v2, vq, v3) = by_column, alone
        # The sums do not use BLAS, whose results depend on the arrays' alignment.
        products = (
            2.0 * on_bias * n2,
            2.0 * (on_scale * n2 + on_bias * n3),
            n2 * n2 + nq * nq + 2.0 * on_scale * n3,
            2.0 * n2 * n3,
            n3 * n3,
        )
        result = in_order(np.array(products), 1)
        result[2] += v2 + vq
        result[4] += v3
        return result
