# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns how the regression begins: a first guess, and what is known of any unit or of this one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..errors import FitError
from ..typing import Floats
from .coverage import distinct_directions
from .learning import Learnt, learn
from .options import FitOptions
from .posterior import Regression
from .priors import as_known, known_of
from .start import ConstantCalibration, constant_calibration, position_means, within_positions
from .unknowns import BIAS_SD, SCALE_SD, SKEW_SD, Prior, initial_state
from .verdict import POSITIONS_NEEDED
from .windows import CURVE, SET, ThermalWindows

# Widths that columns begin with and silent ones keep: what a cheap sensor does over a chamber.
COLUMN_BIAS_SD, _COLUMN_SCALE_SD = 1e-3, 1e-4
# What temperature does to a unit that no thermometer has seen, per K: a cheap sensor's data sheet.
_UNSEEN_SLOPES = 5e-3, 2e-4
# A mounting begins with this much of a bias of its own, and the noise with this [m/s^2].
_OFFSET_SD, _SIGMA = 1e-6, 1e-5


def regress(
    windows: ThermalWindows,
    start: ConstantCalibration,
    up: Floats,
    options: FitOptions,
    tell: Callable[[float], None],
) -> tuple[Regression, Learnt]:
    """Learn from the windows what is known of the unit, with or without a prior."""
    known, data = options.prior, windows.data
    # What the sets alone leave is a response, and no noise.
    walks = windows.raw.shape[1] > 0
    walks &= options.groups is None or not {CURVE, SET} >= {*options.groups}
    has_one_direction = len(distinct_directions(up)) == 1
    if not walks or has_one_direction:
        # Nor is it a lean of the supports; in one attitude a lean may be any drift of the bias.
        data = replace(data, lean=data.lean[:, :0])
    regression = Regression(data, options.gravity, start.scale)
    inverse = np.asarray(np.linalg.inv(start.misalignment), dtype=np.float64)
    bias, skew = start.bias / start.scale, inverse[[1, 2, 2], [0, 0, 1]]
    state = initial_state(data, regression.n_bags, bias, np.ones(3), skew, up)
    prior, knowns = _wide_prior(windows, start, up, options), []
    if known is not None:
        state = as_known(known, regression, state)
        *knowns, widest = known_of(known, regression, state, windows.model.sets, options)
        prior = replace(prior, widths=data.parts.astype(np.float64), known=widest)
    forced = [
        options.model == 'golovach' or group == CURVE or group in options.forced
        for group in data.groups
    ]
    learnt = learn(
        regression,
        state,
        prior,
        np.array(forced),
        lambda part: tell(0.7 + 0.25 * part),
        held=(prior.widths[1] > 0.0) & has_one_direction,
        walks=walks,
        knowns=knowns,
    )
    return regression, learnt


def first_guess(windows: ThermalWindows, options: FitOptions) -> ConstantCalibration:
    """Guess the triad without temperature: by its ellipsoid, or where that is not seen, a norm."""
    means = position_means(windows.data)
    gravity = options.gravity
    norms = np.linalg.norm(means, axis=1)
    if not norms.all() or (len(means) > 1 and not means.any(axis=0).all()):
        raise FitError('an axis is exactly zero at rest: is it dead, is it the right topic?')
    if len(distinct_directions(means / norms[:, None])) >= POSITIONS_NEEDED:
        return constant_calibration(means, gravity, with_misalignment=False)
    scale = float(np.median(norms)) / gravity
    if options.input == 'm/s^2':
        if abs(scale - 1.0) > 0.2:
            raise FitError(
                f'the samples at rest have norm {scale * gravity:.3g}, expected {gravity:.3g} '
                'm/s^2: is the unit right?'
            )
        scale = 1.0
    return ConstantCalibration(np.zeros(3), np.full(3, scale), np.eye(3))


def _wide_prior(
    windows: ThermalWindows, start: ConstantCalibration, up: Floats, options: FitOptions
) -> Prior:
    """Say what is known of any unit before its data are seen."""
    groups = windows.data.groups
    asked = {*groups} if options.groups is None else {*options.groups, *options.forced}
    allowed = np.array([group in asked for group in groups])
    allowed &= windows.has_temperature
    in_scale = windows.data.in_scale & allowed
    # RMS of what the readings do within the positions, on the largest axis.
    within = within_positions(windows.data.mean / start.scale, windows.data.position)
    drift = float(np.sqrt(np.mean(within**2, axis=0)).max())
    # What a sensor does, its curve does first: the others begin as those of a good one.
    is_curve = np.array([group == CURVE for group in groups])
    wide = np.where(is_curve, max(1.0, drift / COLUMN_BIAS_SD), 1.0)
    scale_wide = wide
    if len(distinct_directions(up)) == 1:
        # One attitude does not tell it from the bias: its curve stays at its prior.
        in_scale &= is_curve
        scale_wide = np.ones(len(groups))
        if options.groups is None:
            # Nor a lag from a tilt or a curve: the curve is what others can use.
            allowed &= is_curve
    if options.model == 'golovach':
        # The paper's sets stay whatever they earn: their prior says nothing.
        wide, scale_wide = 50.0 * wide, 50.0 * scale_wide
    widths = np.stack((allowed * wide * COLUMN_BIAS_SD, in_scale * scale_wide * _COLUMN_SCALE_SD))
    if not windows.was_measured:
        widths[:, 0] = _UNSEEN_SLOPES
    return Prior(
        bias_mean=start.bias / start.scale,
        bias_sd=np.full(3, BIAS_SD),
        scale_sd=SCALE_SD,
        skew_sd=SKEW_SD,
        widths=widths,
        offset_sd=_OFFSET_SD,
        sigma=np.full(3, _SIGMA),
        rho=np.zeros(3),
    )
