# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the Kalman filters of the thermometer, one for each of its two modes: predict, correct, mix.

Plain floats, written out: a matrix library costs more per call than all of this together.
"""

from __future__ import annotations

from math import inf, nan

State = tuple[float, float, float, float, float, float, float, float, float]
"""Temperature, rate, acceleration; then P00, P01, P02, P11, P12, P22 of their covariance."""

NOWHERE: State = (nan, nan, nan, inf, 0.0, 0.0, inf, 0.0, inf)
"""Nothing is known."""


def mix(quiet: State, bent: State, to_quiet: float, to_bent: float) -> tuple[State, State]:
    """
    Blend each of two states with the other one by its share of it: mean and covariance of the
    mixture, which contains the distance of the two.
    """
    t, v, a, p00, p01, p02, p11, p12, p22 = quiet
    u, w, b, r00, r01, r02, r11, r12, r22 = bent
    dt, dv, da = u - t, w - v, b - a
    d00, d01, d02, d11, d12, d22 = r00 - p00, r01 - p01, r02 - p02, r11 - p11, r12 - p12, r22 - p22
    apart = to_quiet * (1.0 - to_quiet)
    at, av = apart * dt, apart * dv
    other = to_bent * (1.0 - to_bent)
    ot, ov = other * dt, other * dv
    return (
        (
            t + to_quiet * dt,
            v + to_quiet * dv,
            a + to_quiet * da,
            p00 + to_quiet * d00 + at * dt,
            p01 + to_quiet * d01 + at * dv,
            p02 + to_quiet * d02 + at * da,
            p11 + to_quiet * d11 + av * dv,
            p12 + to_quiet * d12 + av * da,
            p22 + to_quiet * d22 + apart * da * da,
        ),
        (
            u - to_bent * dt,
            w - to_bent * dv,
            b - to_bent * da,
            r00 - to_bent * d00 + ot * dt,
            r01 - to_bent * d01 + ot * dv,
            r02 - to_bent * d02 + ot * da,
            r11 - to_bent * d11 + ov * dv,
            r12 - to_bent * d12 + ov * da,
            r22 - to_bent * d22 + other * da * da,
        ),
    )


def predict(state: State, dt: float, lag: float, power: float) -> State:
    """
    Carry a state over `dt` [s]: the acceleration decays with `lag` [s] and is driven by white
    noise of the spectral density `power` [K^2/s^5].
    """
    t, v, a, p00, p01, p02, p11, p12, p22 = state
    half = 0.5 * dt * dt
    decay = 1.0 / (1.0 + dt / lag)
    grown = power * dt
    driven = grown * half
    # the transition times the covariance, above its diagonal
    c01 = p01 + dt * p11 + half * p12
    c02 = p02 + dt * p12 + half * p22
    c12 = p12 + dt * p22
    return (
        t + dt * v + half * a,
        v + dt * a,
        decay * a,
        p00 + dt * (p01 + c01) + half * (p02 + c02 + 0.2 * driven),
        c01 + dt * (c02 + 0.25 * driven),
        decay * c02 + driven / 3.0,
        p11 + dt * (p12 + c12) + driven / 1.5,
        decay * c12 + 0.5 * dt * grown,
        decay * decay * p22 + grown,
    )


def correct(state: State, measured: float, variance: float) -> tuple[State, float, float]:
    """
    Let a state learn from a temperature [degC] of known variance [K^2]; give it, the innovation
    [K] and the variance of this.
    """
    t, v, a, p00, p01, p02, p11, p12, p22 = state
    spread = p00 + variance
    innovation = measured - t
    k0 = p00 / spread
    k1 = p01 / spread
    k2 = p02 / spread
    left = variance / spread
    return (
        (
            t + k0 * innovation,
            v + k1 * innovation,
            a + k2 * innovation,
            left * p00,
            left * p01,
            left * p02,
            p11 - k1 * p01,
            p12 - k1 * p02,
            p22 - k2 * p02,
        ),
        innovation,
        spread,
    )
