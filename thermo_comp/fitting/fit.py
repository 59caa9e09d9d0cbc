# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the sequence of a fit, from sources to a calibration with its residuals and findings.

Converters with offset-binary samples output a large code at zero force. This code is subtracted
before the fit, which needs directions and norms, and added to the bias after the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from threadpoolctl import threadpool_limits

from ..errors import FitError, UndeterminedError
from ..text import valid_serial
from ..typing import Floats
from ..unit.calibration import Axes, AxisReference, Calibration, Unit
from ..unit.gravity import STANDARD_GRAVITY
from . import data_checks, raw_checks, refit_checks
from .alternatives import model_of, regressed, windows_of
from .assembly import build_calibration
from .claim import claim_of
from .contributions import Contributions, contributions_of, judge_contributions
from .coverage import LeastKnown, distinct_directions, least_known, rough_centre
from .data_checks import Finding, advice, enforce
from .environments import contradicting_bag, contradiction, is_better_without, with_excluded_error
from .evidence import PositionReport, ResidualRow, position_reports, residual_rows
from .gyroscope import RateRow, add_gyroscope
from .initialisation import Problem, initial_triad
from .joining import joined
from .likeness import Likeness, judge_likeness, likenesses
from .nonlinear import (
    choose,
    is_beyond,
    judge_forces,
    judge_terms,
    of_file,
    with_blank,
    with_forces,
)
from .options import COUNTS_FULL_SCALE, FitOptions
from .priors import constants_of, offset_sd_of
from .reduction import ReducedBag, reduce_source
from .selection import Fit
from .sensors import without_copies
from .sources import FitSource
from .thermal_ranges import judge_unseen_axes
from .windows import FEWEST_WINDOWS

Progress = Callable[[float], None]


@dataclass(frozen=True)
class FitResult:
    """
    A calibration with its residuals and findings.

    rates: residuals of the gyroscope
    contributions: effects of the unknowns of bags and positions; None before the end of a fit
    likeness: correlations of terms that the bags may not separate
    """

    calibration: Calibration
    fit: Fit
    residuals: tuple[ResidualRow, ...]
    positions: tuple[PositionReport, ...]
    findings: tuple[Finding, ...]
    least_known: LeastKnown | None
    bags: tuple[ReducedBag, ...]
    rates: tuple[RateRow, ...] = ()
    contributions: Contributions | None = None
    likeness: tuple[Likeness, ...] = ()


def fit(
    sources: Sequence[FitSource], options: FitOptions, progress: Progress = lambda _part: None
) -> FitResult:
    """
    Fit a calibration to bags of a thermal test.

    Raises FitError if the data do not allow a fit, for example if a recording has no rest.
    """
    check_serial(sources, options)
    if not sources:
        raise FitError('no bag was given')
    bags = []
    for number, source in enumerate(sources):
        progress(0.5 * number / len(sources))
        bags.append(_reduced(source, options))
    return fit_bags(bags, options, progress)


def reduce_bag(source: FitSource, options: FitOptions) -> ReducedBag:
    """Compute the statistics of a source; FitError if it has no samples or no rest."""
    return _checked(_reduced(source, options))


def _reduced(source: FitSource, options: FitOptions) -> ReducedBag:
    return reduce_source(
        source,
        min_rest_s=options.min_rest_s,
        still_sd=options.still_sd / STANDARD_GRAVITY,
        full_scale=options.saturated_at,
        fewest_windows=FEWEST_WINDOWS,
    )


def _checked(bag: ReducedBag) -> ReducedBag:
    if not bag.n_samples:
        name = bag.source.name
        raise FitError(f'{name}: no accelerometer samples in the part that is read')
    if bag.restless:
        raise FitError(f'{bag.source.name}: {bag.restless}')
    return bag


def fit_bags(
    bags: Sequence[ReducedBag], options: FitOptions, progress: Progress = lambda _part: None
) -> FitResult:
    """Fit a calibration to the statistics of bags; FitError if the data do not allow a fit."""
    # One bag of a split recording may have no rest: join its bags before the check for rests.
    recordings = [_checked(bag) for bag in joined(bags)]
    # Threads would slow down the products of small matrices in the fit.
    with threadpool_limits(1, 'blas'):
        try:
            result = _judged_result(_fit_without_code_offset(recordings, options, progress))
        except np.linalg.LinAlgError as error:
            raise FitError(
                'the bags do not determine the fit: its equations have no solution in double '
                'precision. Record rests of ten minutes or longer; bags that update a '
                'prior calibration can be fitted together with the bags of the prior'
            ) from error
    notes = tuple(str(finding) for finding in result.findings if finding.level != 'good')
    calibration = result.calibration
    provenance = replace(calibration.provenance, notes=notes)
    return replace(result, calibration=replace(calibration, provenance=provenance))


def _judged_result(result: FitResult) -> FitResult:
    """Add to a result the effects of the unknowns of bags, and the correlations of terms."""
    fit, findings = result.fit, list(result.findings)
    contributions, likeness = contributions_of(fit.regression, fit.posterior), likenesses(fit)
    findings += judge_contributions(contributions, fit.selected.score.noise)
    if all(finding.name != 'environment' for finding in findings):
        # After the exclusion of a bag of another environment, `likeness` is not judged.
        n_directions = len(distinct_directions(fit.posterior.state.up))
        findings += judge_likeness(likeness, n_directions)
    return replace(
        result, findings=tuple(findings), contributions=contributions, likeness=likeness
    )


def _fit_without_code_offset(
    bags: Sequence[ReducedBag], options: FitOptions, progress: Progress
) -> FitResult:
    offset = find_offset(bags, options)
    if not offset.any():
        return _fit_one_environment(bags, options, progress)
    codes = ' '.join(f'{code:g}' for code in offset)
    how = 'estimated; --offset can state it' if options.offset is None else 'by --offset'
    text = f'zero force reads {codes} counts (x y z), {how}: the fit subtracts this offset'
    prior = options.prior and with_code_offset(options.prior, -offset)
    centred_bags = [without_code_offset(bag, offset) for bag in bags]
    result = _fit_one_environment(centred_bags, replace(options, prior=prior), progress)
    return replace(
        result,
        calibration=with_code_offset(result.calibration, offset),
        findings=(advice('offset', text), *result.findings),
        bags=tuple(bags),
    )


def find_offset(bags: Sequence[ReducedBag], options: FitOptions) -> Floats:
    """Return the code at zero force of each axis, shape (3,); 0 without an offset code."""
    if options.offset is not None:
        return np.full(3, options.offset)
    if options.input != 'counts':
        return np.zeros(3)
    if options.prior is not None:
        constants = constants_of(options.prior)
        # If one bias exceeds 0.5 g, all three biases are taken as the codes at zero force.
        is_far = np.abs(constants.bias / constants.scale).max() > 0.5 * options.gravity
        return np.asarray(np.rint(constants.bias) * is_far)
    middle = max(bag.middle for bag in bags)
    if middle:
        return np.full(3, middle)
    means = [np.average(i.mean, axis=0, weights=i.count) for bag in bags for i in bag.intervals]
    return np.rint(rough_centre(np.array(means)))


def without_code_offset(bag: ReducedBag, offset: Floats) -> ReducedBag:
    """Subtract the codes at zero force from a bag and from the blocks of its source."""

    def blocks() -> Iterator[Any]:
        for block in bag.source.blocks():
            yield replace(cast(Any, block), accel=block.accel - offset)

    intervals = tuple(replace(interval, mean=interval.mean - offset) for interval in bag.intervals)
    return replace(bag, source=replace(bag.source, blocks=blocks), intervals=intervals)


def with_code_offset(calibration: Calibration, offset: Floats) -> Calibration:
    """Add `offset`, shape (3,), to the biases of a calibration [counts]."""
    unit = calibration.unit
    full_scale = unit.full_scale
    if full_scale == COUNTS_FULL_SCALE and offset.max() > 0.0:
        # The largest unsigned code of 16 bits, the default length of a code.
        full_scale = 2.0 * COUNTS_FULL_SCALE + 1.0
    axes = (
        AxisReference(axis.scale_factor, axis.bias + by)
        for axis, by in zip(calibration.axes, offset.tolist(), strict=True)
    )
    return replace(calibration, unit=replace(unit, full_scale=full_scale), axes=Axes(*axes))


def _fit_one_environment(
    bags: Sequence[ReducedBag], options: FitOptions, progress: Progress
) -> FitResult:
    """Fit the bags except those of another thermal environment (see `environments`)."""
    first = _fit(bags, options, progress)
    earlier = options.prior
    excluded, may_update = [], False
    if earlier is None:
        excluded = contradicting_bag(first.fit)
    elif (
        earlier.unit.serial == first.calibration.unit.serial and not first.fit.windows.data.forces
    ):
        excluded, may_update = contradiction(first.fit.windows, earlier, options)
    if not excluded:
        return _refined(first, bags, options, progress)
    kept = [bag for k, bag in enumerate(bags) if k not in excluded]
    refit = first
    is_updated = may_update and not kept
    if kept:
        refit = _fit(kept, options, progress)
        if earlier is None and not is_better_without(first.fit, refit.fit, excluded[0]):
            return _refined(first, bags, options, progress)
        refit = _refined(refit, kept, options, progress)
    elif earlier is not None and not is_updated:
        # All bags contradict the prior's effects of temperature and cannot update them: keep the
        # prior, and take the bags as recorded in another environment.
        refit = replace(first, calibration=earlier)
    others = 'the other bags' if earlier is None else 'the prior'
    left_out = [bags[k] for k in excluded]
    calibration, finding = with_excluded_error(
        refit.calibration, left_out, others, is_updated=is_updated
    )
    return replace(
        refit, calibration=calibration, findings=(*refit.findings, finding), bags=tuple(bags)
    )


def _refined(
    result: FitResult, bags: Sequence[ReducedBag], options: FitOptions, progress: Progress
) -> FitResult:
    """Repeat a fit if its bias at settled temperatures is uncertain, or if supports may tilt."""
    if options.prior is not None or options.model == 'golovach':
        return result

    def tried(bags: Sequence[ReducedBag], **given: bool) -> FitResult | None:
        try:
            return _fit(bags, options, progress, **given)
        except (FitError, np.linalg.LinAlgError):
            return None

    if refit_checks.extrapolates(result.fit):
        result = tried(bags, is_by_settled=True) or result
    if not refit_checks.may_have_slow_tilts(result.fit):
        return result
    pieces = [refit_checks.in_pieces(bag) for bag in bags]
    if sum(len(bag.intervals) for bag in pieces) == sum(len(bag.intervals) for bag in bags):
        return result
    tilted = tried(pieces, has_pieces=True)
    if tilted is None or not refit_checks.is_better_with_tilts(result.fit, tilted.fit):
        return result
    finding = advice(
        'tilt',
        'left-out |f| - g is smaller if the supports may tilt from hour to hour: in the fit each '
        'hour of a rest has a separate attitude',
    )
    return replace(
        tilted,
        positions=refit_checks.of_whole_rests(tilted.positions, bags),
        findings=(*tilted.findings, finding),
        bags=tuple(bags),
    )


def _fit(
    bags: Sequence[ReducedBag],
    options: FitOptions,
    progress: Progress,
    *,
    is_by_settled: bool = False,
    has_pieces: bool = False,
) -> FitResult:
    """Fit a calibration to bags whose samples at zero force are near 0; flags: see `Problem`."""
    bags, findings = _judged(bags, options)
    windows = windows_of(bags, model_of(bags, options), options)
    if options.prior and windows.data.forces and options.prior.nonlinearity is None:
        options = replace(options, prior=with_blank(options.prior, options))
        windows = with_forces(windows, options)
    earlier = options.prior
    start = initial_triad(windows, options) if earlier is None else constants_of(earlier)
    up = start.directions(windows.data)
    has_case = all(len(bag.case.value) for bag in bags)
    findings += enforce(data_checks.judge_windows(windows, up, has_case, earlier), options)
    findings += raw_checks.judge_missing(bags, windows)
    findings += judge_forces(windows, options)
    progress(0.7)
    problem = Problem(bags, options, start, up, progress, is_by_settled, has_pieces)
    fit = regressed(windows, problem)
    data_checks.check_scale(fit)
    selected, terms = choose(fit.regression, fit.selected, options)
    fit = fit._replace(selected=selected)
    offset_sd = 0.0 if earlier is None else offset_sd_of(earlier)
    claim = claim_of(fit, options.gravity_sd, offset_sd)
    residuals, in_sample, left_out = residual_rows(fit)
    findings += enforce(data_checks.judge_constants(fit, residuals[-1].raw.rms, options), options)
    findings += data_checks.judge_result(fit, residuals[-1], in_sample, fit.offset_sd, options)
    findings += data_checks.judge_mountings(fit, claim.offset_sd, options)
    findings += data_checks.judge_groups(fit, options)
    try:
        nonlinearity = of_file(fit.regression, terms, options)
        calibration = build_calibration(
            fit, claim, bags, _unit(bags, options), residuals, earlier, nonlinearity
        )
        calibration = replace(calibration, gravity_sd_m_s2=options.gravity_sd)
        rates: tuple[RateRow, ...] = ()
        if earlier is not None or not is_beyond(fit.windows):
            calibration, rates = add_gyroscope(calibration, fit.windows, bags, options)
        elif fit.windows.angular_rate.shape[1]:
            text = 'the stated |f| differs between rests: no bias of the gyroscope was fitted'
            findings.append(advice('rate', text))
    except ValueError as error:
        raise _unusable(error, fit.posterior.state.up) from error
    least_known_axis = least_known(calibration, fit.posterior.state.up)
    findings += data_checks.judge_coverage(least_known_axis)
    findings += judge_terms(calibration)
    findings += judge_unseen_axes(fit, earlier)
    return FitResult(
        calibration=calibration,
        fit=fit,
        residuals=residuals,
        positions=position_reports(fit, in_sample, left_out),
        findings=tuple(findings),
        least_known=least_known_axis,
        bags=tuple(bags),
        rates=rates,
    )


def _judged(
    bags: Sequence[ReducedBag], options: FitOptions
) -> tuple[list[ReducedBag], list[Finding]]:
    """Drop thermometers that copy the board's; return bags, and findings on raw data."""
    has_board = [bool(len(bag.board.value)) for bag in bags]
    if any(has_board) and not all(has_board):
        name = bags[has_board.index(False)].source.name
        raise FitError(
            f'{name}: no board temperature, which the other bags have: leave out this bag, or '
            'name the topic of its board temperature with --topic board=TOPIC'
        )
    serial = check_serial([bag.source for bag in bags], options)
    findings = enforce(raw_checks.judge_prior(serial, options.prior), options)
    findings += enforce(raw_checks.judge_bags(bags, options), options)
    kept, copies = without_copies(bags)
    text = 'repeats the readings of the board, and is left out'
    return kept, findings + [advice('copy', f'temperature/{name} {text}') for name in copies]


def _unusable(error: ValueError, up: Floats) -> FitError:
    if 'misalignment' in str(error):
        # If the positions determine the misalignment, 60 degrees between axes are a data error.
        kind = FitError if data_checks.determines_misalignment(up) else UndeterminedError
        return kind(
            'in the fit the angle between two of the axes is some 60 degrees or less, which no '
            'accelerometer has: is the topic that of the accelerometer, do all positions have the '
            'same order and signs of the axes, and are there at least 9 positions?'
        )
    return FitError(f'the bags give a calibration with an impossible value: {error}')


def check_serial(sources: Sequence[FitSource], options: FitOptions) -> str:
    """Return the serial of `options`, else of the bags; FitError if ambiguous or invalid."""
    serials = {source.serial: source.name for source in sources if source.serial}
    if options.serial is None and len(serials) > 1:
        names = ', '.join(f'{name} of {serial}' for serial, name in sorted(serials.items()))
        raise FitError(
            f'the bags are of different units: {names}; fit the bags of each unit separately or, '
            'if all bags are of one unit, state its serial with --serial'
        )
    try:
        return valid_serial(options.serial or next(iter(serials), 'unknown'))
    except ValueError as mistake:
        remedy = '' if options.serial else '; the bags state this serial, --serial can replace it'
        raise FitError(f'{mistake}{remedy}') from mistake


def _unit(bags: Sequence[ReducedBag], options: FitOptions) -> Unit:
    serial = check_serial([bag.source for bag in bags], options)
    full_scale = raw_checks.full_scale_of(bags, options)
    cycle = float(np.median([bag.cycle_s for bag in bags]))
    return Unit(serial, options.input, full_scale, cycle)
