# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the RMS effects of the unknowns of bags and positions, to compare with the unit's response.

The node knows no initial lag states, tilts and offsets of the fitted bags: a drift that the fit
explains by these unknowns is not corrected in use.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..typing import Floats
from ..unit.gravity import ug_text
from .data_checks import Finding, advice
from .initial_triad import within_positions
from .regression import PosteriorMode, Regression


@dataclass(frozen=True)
class Contributions:
    """
    RMS contributions to the samples of an axis [m/s^2]; None if the fit lacks the unknowns.

    thermal_response: response of the unit, less its value at the mean of the columns over all
        windows; RMS over the windows
    initial_lag_states: effect of the initial lag states, RMS over the windows
    support_tilt: effect of the tilts less its mean in each position, RMS over the windows
    mounting_offsets, turn_on_offsets: RMS of the bias offsets of all positions, and of all bags,
        with the posterior variance added, because |f| shows only the vertical part of an offset
    slow_noise: sd of the slow noise, see `Noise`
    """

    thermal_response: float
    initial_lag_states: float | None
    support_tilt: float | None
    mounting_offsets: float
    turn_on_offsets: float | None
    slow_noise: float


def contributions_of(regression: Regression, posterior: PosteriorMode) -> Contributions:
    """Return the contributions at the solution of a fit."""
    prior, state, layout = posterior.prior, posterior.state, posterior.layout
    position = regression.windows.position
    residual = regression.residual(state, layout)

    def effect_of(name: str) -> Floats:
        """Return the part of the samples that the fit explains by the unknowns `name`, (n, 3)."""
        zero = np.zeros_like(getattr(state, name))
        return regression.residual(replace(state, **{name: zero}), layout) - residual

    def expected(name: str) -> float:
        """Return the root of the expected mean square of unknowns under the posterior."""
        variance = posterior.variance[getattr(layout, name)]
        return float(np.sqrt(np.mean(getattr(state, name) ** 2 + variance)))

    on_bias, on_scale = state.weights
    columns = regression.columns - regression.columns.mean(axis=0)
    force = (state.kappa * regression.along(state))[position]
    tilt = _rms(within_positions(effect_of('tilt'), position))
    return Contributions(
        thermal_response=_rms(columns @ on_bias.T + force * (columns @ on_scale.T)),
        initial_lag_states=_rms(effect_of('start')) if layout.start.size else None,
        support_tilt=tilt if layout.tilt.size else None,
        mounting_offsets=expected('offset'),
        turn_on_offsets=expected('turn_on') if layout.turn_on.size else None,
        slow_noise=_rms(prior.sigma * np.sqrt(prior.noise.variance)),
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def judge_contributions(values: Contributions, noise: float) -> Iterator[Finding]:
    """
    Report unknowns of bags whose effects exceed both the thermal response of the unit and `noise`,
    the white noise of a window [m/s^2].
    """
    steady = 'keep the unit switched on at a constant temperature for hours before each recording'
    stiff = 'record on a support whose tilt does not change with temperature'
    for name, what, value, action in (
        ('starts', 'the initial lag states of the bags', values.initial_lag_states, steady),
        ('supports', 'tilts of the support', values.support_tilt, stiff),
    ):
        if value is not None and value > max(values.thermal_response, noise):
            yield advice(
                name,
                f'{what} explain {ug_text(value)} RMS on an axis, more than the thermal response '
                f'of the unit, {ug_text(values.thermal_response)}: the bags hardly determine this '
                f'response; {action}',
            )
