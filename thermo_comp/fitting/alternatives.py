# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the alternatives that need other columns: the lags of the parts of the axes or a bank of lags,
and the end condition of the dynamic regime.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from ..typing import Floats
from ..unit.columns import bank
from .beginning import regress
from .comparison import is_better
from .nonlinear import with_forces
from .options import FitOptions, sets_of
from .part_lags import find_parts
from .priors import prior_columns, prior_sets
from .reduction import ReducedBag
from .regression import Regression
from .selection import Selected
from .sensors import board_span, gradients_at_rest, learn_detector
from .start import ConstantCalibration
from .windows import SET, Model, ThermalWindows, thermal_windows

Progress = Callable[[float], None]
Regressed = tuple[Regression, Selected, Floats | None]  # see `regress`

# Largest left-out drift, relative to the noise, of a model with the lags of parts beside which no
# bank of lags is tried.
_AT_NOISE = 2.0


def model_of(
    bags: Sequence[ReducedBag],
    options: FitOptions,
    part_taus: tuple[float, float, float] | None = None,
) -> Model:
    """
    Return curves, columns and detector: those of the prior, or else all that the bags allow.

    `part_taus`: see `Model`
    """
    prior, reference = options.prior, options.reference_temperature
    if prior is not None:
        sets, columns = prior_sets(prior), prior_columns(prior)
        detector = options.detector or prior.detector
        return Model(options.model, sets, columns, prior.sensors, detector, reference)
    detector, sensors = options.detector or learn_detector(bags), sensors_of(bags)
    columns = ()
    if options.model != 'golovach':
        rests = gradients_at_rest(bags, sensors)
        columns = bank(sensors, rests, board_span(bags, reference), part_taus)
    if not any(len(bag.case.value) for bag in bags):
        # Without a case thermometer the gradient is estimated from the board's rate, and its
        # columns are combinations of those of the board.
        columns = tuple(column for column in columns if not column.is_of_sensor)
    if options.groups is not None:
        asked = {*options.groups, *options.forced}
        columns = tuple(column for column in columns if column.group in asked)
    sets = sets_of(options, bags)
    return Model(options.model, sets, columns, sensors, detector, reference, part_taus)


def regressed(
    windows: ThermalWindows,
    bags: Sequence[ReducedBag],
    start: ConstantCalibration,
    up: Floats,
    options: FitOptions,
    tell: Progress,
) -> tuple[ThermalWindows, Regressed]:
    """Fit the windows, with the better of the alternatives; return the windows used."""
    windows, result = _with_lags(windows, bags, start, up, options, tell)
    has_case = all(len(bag.case.value) for bag in bags)
    has_choice = has_case and options.prior is None and options.detector is None
    if not has_choice or not _may_have_sets(result[1]):
        return windows, result
    # The dynamic regime ends at constant temperatures of case and board, or of the case alone.
    # This affects only the sets.
    model = windows.model
    closed = replace(model, detector=replace(model.detector, closes='case'))
    others = with_forces(thermal_windows(bags, closed), bags, options)
    others = replace(others, data=replace(others.data, undisturbed=windows.data.undisturbed))
    again = regress(others, start, up, options, tell)
    # Both have the same columns: halves of the program, which limit their number, say nothing.
    found = is_better(result[1].score, again[1].score, by_halves=False)
    return (others, again) if found else (windows, result)


def _with_lags(
    windows: ThermalWindows,
    bags: Sequence[ReducedBag],
    start: ConstantCalibration,
    up: Floats,
    options: FitOptions,
    tell: Progress,
) -> tuple[ThermalWindows, Regressed]:
    """
    Fit the windows with the lags of the parts, if the axes are curves of one part each.

    A bank of lags is used if there are no such parts. It is tried as well if the model of the
    parts is not at the noise, and taken if it is better on left-out data.
    """
    is_free = options.prior is None and options.model != 'golovach'
    parts = find_parts(windows, start) if is_free else None
    if parts is None:
        return windows, regress(windows, start, up, options, tell)
    model = model_of(bags, options, parts.taus)
    own = with_forces(thermal_windows(bags, model, windows.tracks), bags, options)
    own = replace(own, data=replace(own.data, undisturbed=parts.undisturbed))
    result = regress(own, start, up, options, tell)
    selected = result[1]
    if selected.score.rms > _AT_NOISE * float(selected.prior.sigma.mean()):
        other = regress(windows, start, up, options, tell)
        if is_better(selected.score, other[1].score):
            return windows, other
    return own, result


def _may_have_sets(selected: Selected) -> bool:
    """
    Whether the chosen model has two sets, or a model with two sets is similarly good.

    Similarly good: within one standard error of the chosen model on left-out data, with less than
    80 % of its noise.
    """
    chosen = next(trial for trial in selected.trials if trial.is_chosen)
    limit = 0.8 * chosen.prior.sigma
    return any(
        SET in trial.groups
        and (trial.is_chosen or (trial.is_near and (trial.prior.sigma < limit).all()))
        for trial in selected.trials
    )


def sensors_of(bags: Sequence[ReducedBag]) -> tuple[str, ...]:
    """Return the thermometers that all bags have, without the board's; the case is first."""
    seen = ({name for name, one in bag.temperatures.items() if len(one.value)} for bag in bags)
    return 'case', *sorted(set.intersection(*seen) - {'board', 'case'})
