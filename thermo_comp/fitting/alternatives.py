# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the alternatives that need other columns: the lags of the parts of the axes or a bank of lags,
and the end condition of the dynamic regime.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..typing import Floats
from ..unit.columns import Column, bank
from .beginning import Problem, regress
from .left_out import is_better
from .nonlinear import with_forces
from .options import FitOptions, sets_of
from .part_lags import find_parts
from .priors import prior_model
from .reduction import ReducedBag
from .selection import Fit, Selected
from .sensors import board_span, gradients_at_rest, learn_detector
from .windows import SET, Model, ThermalWindows, Track, thermal_windows


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
        return replace(
            prior_model(prior),
            name=options.model,
            detector=options.detector or prior.detector,
            reference_temperature=reference,
        )
    detector, sensors = options.detector or learn_detector(bags), sensors_of(bags)
    columns: tuple[Column, ...] = ()
    if options.model != 'golovach':
        rests = gradients_at_rest(bags, sensors)
        columns = bank(sensors, rests, board_span(bags, reference), part_taus)
    if not any(len(bag.case.value) for bag in bags):
        # Without a case thermometer the gradient is estimated from the board's rate, and its
        # columns are combinations of those of the board.
        columns = tuple(column for column in columns if not column.is_of_sensor)
    if options.groups is not None:
        groups = {*options.groups, *options.forced}
        columns = tuple(column for column in columns if column.group in groups)
    sets = sets_of(options, bags)
    return Model(options.model, sets, columns, sensors, detector, reference, part_taus)


def regressed(windows: ThermalWindows, problem: Problem) -> Fit:
    """Fit the windows, with the better of the alternatives; the fit has the windows used."""
    bags, options = problem.bags, problem.options
    fit = _with_lags(windows, problem)
    has_case = all(len(bag.case.value) for bag in bags)
    has_choice = has_case and options.prior is None and options.detector is None
    if not has_choice or not _may_have_sets(fit.selected):
        return fit
    # The dynamic regime ends at constant temperatures of case and board, or of the case alone.
    # This affects only the sets.
    model = fit.windows.model
    closed = replace(model, detector=replace(model.detector, closes='case'))
    undisturbed = fit.windows.data.undisturbed
    other = regress(windows_of(bags, closed, options, undisturbed=undisturbed), problem)
    # Both have the same columns: halves of the program, which limit their number, say nothing.
    return other if is_better(fit.selected.score, other.selected.score, by_halves=False) else fit


def windows_of(
    bags: Sequence[ReducedBag],
    model: Model,
    options: FitOptions,
    tracks: Sequence[Track] | None = None,
    undisturbed: Floats | None = None,
) -> ThermalWindows:
    """Return the windows of bags with |f|; `tracks`: known thermal states of the detector."""
    windows = with_forces(thermal_windows(bags, model, tracks), bags, options)
    return replace(windows, data=replace(windows.data, undisturbed=undisturbed))


def _with_lags(windows: ThermalWindows, problem: Problem) -> Fit:
    """
    Fit the windows with the lags of the parts, if the axes are curves of one part each.

    A bank of lags is used if there are no such parts. It is tried as well if the model of the
    parts is not at the noise, and taken if it is better on left-out data.
    """
    bags, options = problem.bags, problem.options
    is_free = options.prior is None and options.model != 'golovach'
    parts = find_parts(windows, problem.start) if is_free else None
    if parts is None:
        return regress(windows, problem)
    model = model_of(bags, options, parts.taus)
    of_parts = windows_of(bags, model, options, windows.tracks, parts.undisturbed)
    fit = regress(of_parts, problem)
    # The noise of the fit contains what the lags of the parts do not explain.
    if fit.selected.score.rms > 2.0 * parts.noise:
        with_bank = regress(windows, problem)
        if is_better(fit.selected.score, with_bank.selected.score):
            return with_bank
    return fit


def _may_have_sets(selected: Selected) -> bool:
    """
    Whether the chosen model has two sets, or a model with two sets is similarly good.

    Similarly good: within one standard error of the chosen model on left-out data, with less than
    80 % of its noise.
    """
    chosen = next(trial for trial in selected.trials if trial.is_chosen)
    limit = 0.8 * chosen.posterior.prior.sigma
    return any(
        SET in trial.groups
        and (trial.is_chosen or (trial.is_near and (trial.posterior.prior.sigma < limit).all()))
        for trial in selected.trials
    )


def sensors_of(bags: Sequence[ReducedBag]) -> tuple[str, ...]:
    """Return the thermometers that all bags have, without the board's; the case is first."""
    seen = (
        {name for name, readings in bag.temperatures.items() if len(readings.value)}
        for bag in bags
    )
    return 'case', *sorted(set.intersection(*seen) - {'board', 'case'})
