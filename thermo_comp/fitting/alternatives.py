# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the choice between models that differ in the lags of their columns (one lag per axis, or a
bank of time constants for all axes) or in the condition that ends the dynamic regime.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..typing import Floats
from ..unit.columns import Column, Part, bank
from .initialisation import Problem, regress
from .left_out import is_better
from .nonlinear import with_forces
from .options import FitOptions, sets_of
from .part_lags import find_parts
from .priors import prior_model
from .reduction import ReducedBag
from .selection import Fit
from .sensors import board_span, gradients_at_rest, learn_detector
from .windows import PART, PRODUCTS, SET, Model, ThermalWindows, Track, thermal_windows


def model_of(
    bags: Sequence[ReducedBag], options: FitOptions, parts: tuple[Part, Part, Part] | None = None
) -> Model:
    """
    Return the model of the prior calibration; without a prior calibration, return the model that
    `options` name, with all columns whose thermometers are in the bags.

    `parts`: the part whose temperature determines each axis, or None for the bank of lags
    """
    prior, reference = options.prior, options.reference_temperature
    if prior is not None:
        return replace(
            prior_model(prior),
            name=options.model,
            detector=options.detector or prior.detector,
            reference_temperature=reference,
        )
    recorded = (
        {name for name, readings in bag.temperatures.items() if len(readings.value)}
        for bag in bags
    )
    # Thermometers beside the board's: case (recorded or not), and any others that are in all bags.
    sensors = 'case', *sorted(set.intersection(*recorded) - {'board', 'case'})
    detector = options.detector or learn_detector(bags)
    columns: tuple[Column, ...] = ()
    if options.model != 'golovach':
        rests = gradients_at_rest(bags, sensors)
        columns = bank(sensors, rests, board_span(bags, reference), parts)
    if not any(len(bag.case.value) for bag in bags):
        # Without a case thermometer the gradient T_case - T_board is estimated from the board's
        # rate, so its columns would be linear combinations of the columns of group `board`.
        columns = tuple(column for column in columns if not column.is_of_sensor)
    if options.groups is not None:
        groups = {*options.groups, *options.forced}
        if PART in groups:
            groups.update(('board', *PRODUCTS))
        columns = tuple(column for column in columns if column.group in groups)
    sets = sets_of(options, bags)
    return Model(options.model, sets, columns, sensors, detector, reference, parts)


def regressed(windows: ThermalWindows, problem: Problem) -> Fit:
    """Fit the windows with alternative lags and regime detectors; return the best fit."""
    bags, options = problem.bags, problem.options
    fit = _with_lags(windows, problem)
    has_case = all(len(bag.case.value) for bag in bags)
    has_choice = has_case and options.prior is None and options.detector is None
    # Compare detectors if the chosen model has a curve for each regime, or if such a model has an
    # almost equal score (`is_near`) and less than 80 % of the chosen model's noise on each axis.
    trials = fit.selected.trials
    chosen = next(trial for trial in trials if trial.is_chosen)
    limit = 0.8 * chosen.posterior.prior.sigma
    may_have_sets = any(
        SET in trial.groups
        and (trial.is_chosen or (trial.is_near and (trial.posterior.prior.sigma < limit).all()))
        for trial in trials
    )
    if not has_choice or not may_have_sets:
        return fit
    # The alternative detector ends the dynamic regime once the case temperature is constant, the
    # default detector once the temperatures of case and board are constant.
    model = fit.windows.model
    closed = replace(model, detector=replace(model.detector, end_condition='case'))
    undisturbed = fit.windows.data.undisturbed
    early = regress(windows_of(bags, closed, options, undisturbed=undisturbed), problem)
    # Errors of left-out program halves show superfluous columns, not which detector is better.
    return early if is_better(fit.selected.score, early.selected.score, by_halves=False) else fit


def windows_of(
    bags: Sequence[ReducedBag],
    model: Model,
    options: FitOptions,
    tracks: Sequence[Track] | None = None,
    undisturbed: Floats | None = None,
) -> ThermalWindows:
    """Return the windows of bags; `tracks`: thermal states of the bags, if already computed."""
    windows = with_forces(thermal_windows(bags, model, tracks), options)
    return replace(windows, data=replace(windows.data, undisturbed=undisturbed))


def _with_lags(windows: ThermalWindows, problem: Problem) -> Fit:
    """
    Fit models with one lag per axis (`find_parts`) until one has a left-out drift of at most
    `Parts.most_drift`. Unless there is such a model, also fit the model of `windows`. Return the
    best fit. With a prior calibration, or for Golovach's model, fit only the model of `windows`.
    """
    bags, options = problem.bags, problem.options
    is_free = options.prior is None and options.model != 'golovach'
    best: Fit | None = None
    for parts in find_parts(windows, problem.start) if is_free else []:
        model = model_of(bags, options, parts.lags)
        of_parts = windows_of(bags, model, options, windows.tracks, parts.undisturbed)
        best = _better(best, regress(of_parts, problem))
        if best.selected.score.rms <= parts.most_drift:
            return best
    return _better(best, regress(windows, problem))


def _better(fit: Fit | None, other: Fit) -> Fit:
    return other if fit is None or is_better(fit.selected.score, other.selected.score) else fit
