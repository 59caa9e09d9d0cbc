# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the gyroscope as an accelerometer triad in memory: scale 1, m/s^2 stands for rad/s."""

from dataclasses import replace

import numpy as np

from . import calibration as unit
from .calibration import Calibration, RegimeSet, parameter_layout
from .functions import Polynomial
from .posterior import Posterior
from .provenance import Provenance
from .rate_bias import LARGEST_RATE, NIL, Gyroscope, RateCurve, RateSet, RateTerm


def rate_triad(calibration: Calibration) -> Calibration:
    """Return the gyroscope of a unit, which must have one, as a triad."""
    gyroscope = calibration.gyroscope
    if gyroscope is None:
        raise ValueError('`calibration` must have a gyroscope')

    def regime(shared: RegimeSet, curves: RateSet) -> RegimeSet:
        x, y, z = (
            unit.AxisSet(curve.bias_function, Polynomial((1.0,)), curve.delta, sd)
            for curve, sd in zip(curves.axes(), gyroscope.residual_sd_rad_s, strict=True)
        )
        # Its lack of fit is that of the specific force.
        return replace(shared, x=x, y=y, z=z, lack_of_fit=())

    triad = replace(
        calibration,
        # The full scale of the accelerometer does not limit an angular rate.
        unit=replace(calibration.unit, input='m/s^2', full_scale=LARGEST_RATE),
        axes=unit.Axes(*(unit.AxisReference(1.0, bias) for bias in gyroscope.bias_rad_s)),
        static=regime(calibration.static, gyroscope.static),
        dynamic=regime(calibration.dynamic, gyroscope.dynamic),
        noise_density_m_s2_sqrt_hz=gyroscope.noise_density_rad_s_sqrt_hz,
        slow_noise_m_s2_sqrt_h=gyroscope.slow_noise_rad_s_sqrt_h,
        misalignment=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        misalignment_sd=NIL,
        response=tuple(unit.ResponseTerm(**vars(term), scale=NIL) for term in gyroscope.response),
        provenance=Provenance(),
        evidence=(),
        posterior=None,
        nonlinearity=None,
        gyroscope=None,
    )
    if gyroscope.posterior is None:
        return triad
    rows, n = _bias_rows(triad), parameter_layout(triad).n_parameters
    matrix, variances = np.zeros((n, gyroscope.posterior.rank)), np.zeros(n)
    matrix[rows], variances[rows] = gyroscope.posterior.matrix, gyroscope.posterior.variances
    return replace(triad, posterior=Posterior.of(matrix, variances))


def gyroscope_of(triad: Calibration) -> Gyroscope:
    """Take the gyroscope out of a triad whose scale is 1."""
    x, y, z = (axis.bias for axis in triad.axes)
    static, dynamic = (
        RateSet(*(RateCurve(axis.bias_function, axis.delta) for axis in regime_set.axes()))
        for regime_set in triad.regime_sets()
    )
    sx, sy, sz = (axis.residual_sd_m_s2 for axis in triad.static.axes())
    terms = [vars(term).copy() for term in triad.response]
    for keys in terms:
        del keys['scale']
    posterior = triad.posterior
    if posterior is not None:
        rows = _bias_rows(triad)
        posterior = Posterior.of(posterior.matrix[rows], posterior.variances[rows])
    return Gyroscope(
        bias_rad_s=(x, y, z),
        static=static,
        dynamic=dynamic,
        noise_density_rad_s_sqrt_hz=triad.noise_density_m_s2_sqrt_hz,
        slow_noise_rad_s_sqrt_h=triad.slow_noise_m_s2_sqrt_h,
        residual_sd_rad_s=(sx, sy, sz),
        response=tuple(RateTerm(**keys) for keys in terms),
        posterior=posterior,
    )


def _bias_rows(triad: Calibration) -> list[int]:
    blocks = parameter_layout(triad).bias
    return [row for block in blocks for row in range(block.static, block.end)]
