# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fit as a whole: sources in, calibration with its evidence out.

Angles and norms of raw words whose zero is far away, as in offset binary, mean nothing. So a fit
is made of what is left above the word of no force, and that word is a part of the bias.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from threadpoolctl import threadpool_limits

from ..errors import FitError
from ..recording.stillness import widened
from ..text import valid_serial
from ..typing import Floats
from ..unit.calibration import Axes, AxisReference, Calibration, Unit
from ..unit.columns import bank
from ..unit.gravity import STANDARD_GRAVITY
from ..unit.nonlinearity import NonlinearTerm
from . import data_checks
from .assembly import build_calibration
from .beginning import first_guess, regress
from .claim import claim_of
from .coverage import LeastKnown, least_known, rough_centre
from .data_checks import Finding, enforce
from .environments import agree_better, bag_at_odds, bags_against, with_doubt
from .evidence import PositionReport, ResidualRow, position_reports, residual_rows
from .gyroscope import RateRow, add_gyroscope
from .nonlinear import choose, is_beyond, judge_terms, of_file, with_blank, with_forces
from .options import COUNTS_FULL_SCALE, FitOptions, sets_of
from .priors import constants_of, prior_columns, prior_sets
from .reduction import ReducedBag, reduce_source
from .selection import Selected, is_better
from .sensors import board_span, gradients_at_rest, learn_detector, without_copies
from .sources import FitSource
from .start import position_means
from .windows import FEWEST_WINDOWS, SET, Model, ThermalWindows, thermal_windows

Progress = Callable[[float], None]

# Usual full scales of units that report m/s^2.
_G_RANGES = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
# Sets that leave less than this part of the noise may be of a regime that closes otherwise.
_SETS_EXPLAIN = 0.8
# A bias beyond this part of 1 g is a word of no force.
_LARGEST_BIAS = 0.5


@dataclass(frozen=True)
class FitResult:
    """A fit and its evidence; `rates` are the gyroscope's residuals, where one was fitted."""

    calibration: Calibration
    selected: Selected
    residuals: tuple[ResidualRow, ...]
    positions: tuple[PositionReport, ...]
    findings: tuple[Finding, ...]
    least_known: LeastKnown | None
    windows: ThermalWindows
    bags: tuple[ReducedBag, ...]
    rates: tuple[RateRow, ...] = ()


def fit(
    sources: Sequence[FitSource], options: FitOptions, progress: Progress = lambda _part: None
) -> FitResult:
    """
    Fit a calibration to bags of a thermal test.

    Raises FitError if the data contradict themselves, or a bag has no still interval.
    """
    check_serial(sources, options)
    if not sources:
        raise FitError('no bag was given')
    bags = []
    for number, source in enumerate(sources):
        progress(0.5 * number / len(sources))
        bags.append(reduce_bag(source, options))
    return fit_bags(bags, options, progress)


def reduce_bag(source: FitSource, options: FitOptions) -> ReducedBag:
    """Stream one source into its sufficient statistics; FitError if it never rests."""
    bag = reduce_source(
        source,
        min_rest_s=options.min_rest_s,
        still_sd=options.still_sd / STANDARD_GRAVITY,
        full_scale=options.saturated_at,
        fewest_windows=FEWEST_WINDOWS,
    )
    if not bag.n_samples:
        raise FitError(f'{source.name}: no accelerometer samples')
    if bag.restless:
        raise FitError(f'{source.name}: {bag.restless}')
    return bag


def fit_bags(
    bags: Sequence[ReducedBag], options: FitOptions, progress: Progress = lambda _part: None
) -> FitResult:
    """Fit a calibration to bags that have been reduced; FitError if they contradict themselves."""
    # Thousands of small products: threads would wait for each other.
    with threadpool_limits(1, 'blas'):
        return _fit_about_offset(bags, options, progress)


def _fit_about_offset(
    bags: Sequence[ReducedBag], options: FitOptions, progress: Progress
) -> FitResult:
    offset = find_offset(bags, options)
    if not offset.any():
        return _fit_alike(bags, options, progress)
    note = f'no force reads {" ".join(f"{word:g}" for word in offset)}: words with an offset'
    known = options.prior and about(options.prior, -offset)
    found = _fit_alike(
        [centred(bag, offset) for bag in bags], replace(options, prior=known), progress
    )
    return replace(
        found,
        calibration=with_notes(about(found.calibration, offset), [f'offset: {note}']),
        findings=(Finding('offset', 'advice', note), *found.findings),
        bags=tuple(bags),
    )


def find_offset(bags: Sequence[ReducedBag], options: FitOptions) -> Floats:
    """Find the word of no force of each axis, shape (3,): 0 but for words that have one."""
    if options.offset is not None:
        return np.full(3, options.offset)
    if options.input != 'counts':
        return np.zeros(3)
    if options.prior is not None:
        known = constants_of(options.prior)
        is_far = np.abs(known.bias / known.scale).max() > _LARGEST_BIAS * options.gravity
        return np.asarray(np.rint(known.bias) * is_far)
    middle = max(bag.middle for bag in bags)
    if middle:
        return np.full(3, middle)
    means = [np.average(i.mean, axis=0, weights=i.count) for bag in bags for i in bag.intervals]
    return np.rint(rough_centre(np.array(means)))


def centred(bag: ReducedBag, offset: Floats) -> ReducedBag:
    """Take the words of no force out of a bag, and of its source."""
    blocks = bag.source.blocks

    def moved() -> Iterator[Any]:
        for block in blocks():
            yield replace(cast(Any, block), accel=block.accel - offset)

    intervals = tuple(replace(one, mean=one.mean - offset) for one in bag.intervals)
    return replace(bag, source=replace(bag.source, blocks=moved), intervals=intervals)


def about(calibration: Calibration, offset: Floats) -> Calibration:
    """Make a calibration of words above those of no force one of the words themselves."""
    unit = calibration.unit
    full_scale = unit.full_scale
    if full_scale == COUNTS_FULL_SCALE and offset.max() > 0.0:
        # Words of 16 bits without a sign, of which nobody said how long they are.
        full_scale = 2.0 * COUNTS_FULL_SCALE + 1.0
    moved = (
        AxisReference(axis.scale_factor, axis.bias + by)
        for axis, by in zip(calibration.axes, offset.tolist(), strict=True)
    )
    return replace(calibration, unit=replace(unit, full_scale=full_scale), axes=Axes(*moved))


def with_notes(calibration: Calibration, notes: Sequence[str]) -> Calibration:
    """Add notes to a calibration's provenance."""
    provenance = calibration.provenance
    return replace(calibration, provenance=replace(provenance, notes=(*provenance.notes, *notes)))


def _fit_alike(bags: Sequence[ReducedBag], options: FitOptions, tell: Progress) -> FitResult:
    """Fit the bags, but for those of another environment: see `environments`."""
    whole = _fit(bags, options, tell)
    known = options.prior
    if known is None:
        bag = bag_at_odds(whole.windows, whole.selected)
        gone = [] if bag is None else [bag]
    elif known.unit.serial == whole.calibration.unit.serial and not whole.windows.data.forces:
        gone = bags_against(whole.windows, known, options)
    else:
        gone = []
    if not gone:
        return whole
    kept = [bag for k, bag in enumerate(bags) if k not in gone]
    rest = whole
    if kept:
        rest = _fit(kept, options, tell)
        pair = (whole.windows, whole.selected), (rest.windows, rest.selected)
        if known is None and not agree_better(*pair, gone[0]):
            return whole
    elif known is not None:
        # Nothing is left that could update the prior.
        provenance = whole.calibration.provenance
        rest = replace(whole, calibration=replace(known, provenance=provenance))
    calibration, finding = with_doubt(
        rest.calibration,
        [bags[k] for k in gone],
        'the other bags' if known is None else 'the prior',
    )
    return replace(
        rest,
        calibration=with_notes(calibration, [f'{finding.name}: {finding.message}']),
        findings=(*rest.findings, finding),
        bags=tuple(bags),
    )


def _fit(bags: Sequence[ReducedBag], options: FitOptions, tell: Progress) -> FitResult:
    """Fit a calibration to bags in which no force is about zero."""
    seen = [bool(len(bag.board.value)) for bag in bags]
    if any(seen) and not all(seen):
        name = bags[seen.index(False)].source.name
        raise FitError(f'{name}: no board temperature, which the other bags have')
    serial = check_serial([bag.source for bag in bags], options)
    findings = enforce(data_checks.judge_prior(serial, options.prior), options)
    findings += enforce(data_checks.judge_bags(bags, options), options)
    bags, copies = without_copies(bags)
    findings += data_checks.judge_copies(copies)
    known = options.prior
    terms: tuple[NonlinearTerm, ...] = ()
    detector = options.detector or (known.detector if known else learn_detector(bags))
    tell(0.55)
    sensors = known.sensors if known else sensors_of(bags)
    if known is not None:
        sets, columns = prior_sets(known), prior_columns(known)
    else:
        sets = sets_of(options, bags)
        is_paper = options.model == 'golovach'
        rests = gradients_at_rest(bags, sensors)
        span = board_span(bags, options.reference_temperature)
        columns = () if is_paper else bank(sensors, rests, span)
        if not any(len(bag.case.value) for bag in bags):
            # A gradient that is guessed from the board's rate tells nothing that its lags do not.
            columns = tuple(one for one in columns if not one.is_of_sensor)
    reference = options.reference_temperature
    model = Model(options.model, sets, columns, sensors, detector, reference)
    windows = with_forces(thermal_windows(bags, model), bags, options)
    if known is not None and windows.data.forces and known.nonlinearity is None:
        known = with_blank(known, options)
        options = replace(options, prior=known)
        windows = with_forces(windows, bags, options)
    start = first_guess(windows, options) if known is None else constants_of(known)
    up = start.force(position_means(windows.data))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    has_case = all(len(bag.case.value) for bag in bags)
    findings += enforce(data_checks.judge_windows(windows, up, has_case), options)
    tell(0.7)
    regression, selected, typical = regress(windows, start, up, options, tell)
    asks = has_case and known is None and options.detector is None
    if asks and _may_have_sets(selected):
        # Only the sets feel when the regime closes: with the case, or with the board too.
        closed = replace(model, detector=replace(detector, closes='case'))
        others = with_forces(thermal_windows(bags, closed), bags, options)
        again = regress(others, start, up, options, tell)
        if is_better(selected.score, again[1].score):
            windows, (regression, selected, typical) = others, again
    if known is None:
        selected, terms = choose(regression, selected, options)
    claim = claim_of(regression, selected, typical, options.gravity_sd)
    residuals, left_out = residual_rows(windows, regression, selected, is_shared=sets.is_shared)
    state = selected.posterior.state
    K = state.kappa * start.scale
    constants, raw = (K, state.bias, state.misalignment), residuals[-1].raw.rms
    found_none = data_checks.judge_constants(windows, up, constants, raw, options)
    findings += enforce(found_none, options)
    findings += data_checks.judge_result(
        K, residuals, claim.offset_sd, options, windows.has_temperature
    )
    try:
        calibration = build_calibration(
            windows,
            regression,
            selected,
            claim,
            bags,
            _unit(bags, options),
            residuals,
            findings,
            known,
            of_file(regression, terms, options),
        )
        rates: tuple[RateRow, ...] = ()
        if known is not None or not is_beyond(windows):
            calibration, rates = add_gyroscope(calibration, windows, bags, options)
        elif windows.angular_rate.shape[1]:
            text = 'the unit rotated in some rests, so no gyroscope was fitted'
            findings.append(Finding('rate', 'advice', text))
    except ValueError as error:
        if 'misalignment' in str(error):
            raise FitError(
                'its axes stand at less than 60 degrees to each other, which no accelerometer '
                'has: is it the right topic, did the axes stay the same in all positions, and '
                'do at least 9 positions show them?'
            ) from error
        raise FitError(f'these data give no calibration that can be used: {error}') from error
    least = least_known(calibration, selected.posterior.state.up)
    unseen = list(data_checks.judge_coverage(least))
    unseen += judge_terms(calibration)
    calibration = with_notes(calibration, [f'{one.name}: {one.message}' for one in unseen])
    return FitResult(
        calibration=calibration,
        selected=selected,
        residuals=residuals,
        positions=position_reports(windows, regression, selected, left_out),
        findings=(*findings, *unseen),
        least_known=least,
        windows=windows,
        bags=tuple(bags),
        rates=rates,
    )


def _may_have_sets(selected: Selected) -> bool:
    """Whether sets are chosen, or would explain much more although left-out data are not sure."""
    chosen = next(one for one in selected.trials if one.is_chosen)
    least = _SETS_EXPLAIN * chosen.prior.sigma
    return any(
        SET in one.groups and (one.is_chosen or (one.is_near and (one.prior.sigma < least).all()))
        for one in selected.trials
    )


def sensors_of(bags: Sequence[ReducedBag]) -> tuple[str, ...]:
    """Name the thermometers beside the board that every bag has; the case leads, seen or not."""
    seen = ({name for name, one in bag.temperatures.items() if len(one.value)} for bag in bags)
    return 'case', *sorted(set.intersection(*seen) - {'board', 'case'})


def check_serial(sources: Sequence[FitSource], options: FitOptions) -> str:
    """Find the unit's serial; FitError if the bags name different ones, or it is none."""
    serials = {source.serial: source.name for source in sources if source.serial}
    if options.serial is None and len(serials) > 1:
        said = ', '.join(f'{name} of {serial}' for serial, name in sorted(serials.items()))
        raise FitError(f'the bags are of different units: {said}')
    try:
        return valid_serial(options.serial or next(iter(serials), 'unknown'))
    except ValueError as mistake:
        raise FitError(str(mistake)) from mistake


def _unit(bags: Sequence[ReducedBag], options: FitOptions) -> Unit:
    serial = check_serial([bag.source for bag in bags], options)
    full_scale = options.saturated_at
    largest = max(bag.reach for bag in bags)
    if full_scale == COUNTS_FULL_SCALE and bags[0].is_integer:
        full_scale = widened(full_scale, np.array([[np.rint(largest)]]))
    if full_scale is None:
        full_scale = next(
            (r * STANDARD_GRAVITY for r in _G_RANGES if r * STANDARD_GRAVITY > 1.1 * largest),
            2.0 * largest,
        )
    cycle = float(np.median([bag.cycle_s for bag in bags]))
    return Unit(serial, options.input, full_scale, cycle)
