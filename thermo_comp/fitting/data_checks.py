# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the checks of the windows of a fit, and of the fitted calibration, with advice to the user.

Data that contradict themselves or the model are refused. A refusal stops the fit unless the user
allows it by its name; advice stops no fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..errors import FitError, UndeterminedError
from ..text import counted
from ..thermal.settings import ADVISED_SPAN_K, RAMP_K_MIN
from ..thermal.state import BOARD
from ..typing import Bools, Floats
from ..unit.calibration import POPULATION, Calibration, parameter_layout
from ..unit.gravity import MICRO_G, ug_text
from .coverage import LeastKnown, direction_text, distinct_directions, geometry
from .initial_triad import white_noise_of, within_positions
from .options import FitOptions
from .unknowns import State
from .windows import ThermalWindows

if TYPE_CHECKING:
    from .evidence import ResidualRow
    from .selection import Fit

#: Smallest numbers of positions that determine 6 constants (biases and scale factors), 9 constants
#: (also the misalignment), and 9 constants and the sd of mounting offsets.
POSITIONS_NEEDED, POSITIONS_FOR_MISALIGNMENT, POSITIONS_FOR_MOUNTINGS = 6, 9, 12
#: Span of the board temperature below which no temperature dependence is visible [K].
LEAST_SPAN_K = 3.0


@dataclass(frozen=True)
class Finding:
    """A finding of a check; `name`: word by which a user allows a refusal (--allow swapped)."""

    name: str
    level: Literal['refusal', 'advice', 'good']
    message: str

    def __str__(self) -> str:
        return f'{self.name}: {self.message}'


def advice(name: str, message: str) -> Finding:
    """Return a finding of the level 'advice'."""
    return Finding(name, 'advice', message)


def enforce(findings: Iterable[Finding], options: FitOptions) -> list[Finding]:
    """Raise FitError at the first refusal that the user does not allow."""
    result = []
    for finding in findings:
        if finding.level != 'refusal':
            result.append(finding)
        elif finding.name in options.allow:
            result.append(advice(finding.name, f'allowed: {finding.message}'))
        else:
            raise FitError(f'{finding.message} (override with --allow {finding.name})')
    return result


def judge_windows(
    windows: ThermalWindows, up: Floats, has_case: bool, prior: Calibration | None = None
) -> Iterator[Finding]:
    """
    Check temperatures, ramps and directions `up`, shape (n, 3), of the windows at rest.

    A prior calibration of the unit contains the effects of temperature and of ramps: if a prior is
    given, temperatures beyond its range are checked instead of the span and the ramps.
    """
    yield _judge_positions(up)
    if not windows.has_temperature:
        what = 'no change of temperature was read'
        bags = [bag for bag, _ in windows.rests]
        read = {name for bag in bags for name in bag.temperatures if len(bag.readings(name).value)}
        if 'board' not in read:
            what = 'the bags have no thermometer' + ' of the board' * bool(read)
        text = f'{what}: the calibration holds at the temperature of the test'
        yield advice('temperature', text)
        return
    if prior is not None and prior.provenance.model != POPULATION:
        yield _judge_beyond(windows, prior)
    else:
        yield _judge_span(windows)
        yield from _judge_ramps(windows)
    if has_case:
        yield from _judge_order(windows)
    else:
        yield advice(
            'case',
            'no case temperature: the regime is detected from the board temperature alone, later '
            'and less reliably than with a case thermometer',
        )


def _judge_order(windows: ThermalWindows) -> Iterator[Finding]:
    """Refuse bags if in their ramps the temperature of the board leads that of the case."""
    moving, bag = np.abs(_ramp_rates(windows)) > RAMP_K_MIN, windows.data.bag
    least, where = _correlation(windows, moving), ''
    numbers, first = np.unique(bag, return_index=True)
    of_bags = np.array([_correlation(windows, moving & (bag == number)) for number in numbers])
    if least > -0.3 and of_bags.max() >= 0.3 and of_bags.min() <= -0.3:
        # One bag of twelve with exchanged thermometers hardly changes the correlation of all bags,
        # but the fit would give a part a temperature halfway between board and case temperature.
        bags = (windows.rests[k][0] for k in windows.data.position[first][of_bags <= -0.3])
        least = float(of_bags.min())
        where = f'{", ".join(bag.source.name for bag in bags)}, unlike in other bags: '
    if least <= -0.3:
        text = (
            f'{where}the board temperature leads the case in ramps (correlation {least:.2f} of '
            'T_case - T_board and the rate of T_board): are the two topics exchanged, or is '
            'the case thermometer loose?'
        )
        yield Finding('swapped', 'refusal', text)


def _correlation(windows: ThermalWindows, rows: Bools) -> float:
    """Return the correlation of gradient and board rate; 0 if `rows` are less than 30 windows."""
    if windows.data.weight[rows].sum() < 30.0 * windows.data.weight.max():
        return 0.0
    # The case leads the board in a ramp, so the gradient has the sign of the board's rate.
    return float(np.corrcoef(windows.gradient[rows], windows.rate[rows])[0, 1])


def _judge_span(windows: ThermalWindows) -> Finding:
    span = float(np.ptp(windows.temperature))
    text = f'temperature span {span:.1f} degC'
    if span >= ADVISED_SPAN_K:
        return Finding('span', 'good', text)
    why = 'run the chamber over the whole range of temperatures in use'
    if span < LEAST_SPAN_K and _has_drift(windows):
        why = 'the temperature hardly changes while |f| drifts: is the thermometer on the board?'
    return advice('span', f'{text} ({ADVISED_SPAN_K:g} degC advised): {why}')


def _judge_beyond(windows: ThermalWindows, prior: Calibration) -> Finding:
    # A fit with a prior omits windows beyond the prior's temperatures, which `tracks` includes.
    tracks = (track.states[track.is_known, BOARD] for track in windows.tracks)
    temperature = np.concatenate((windows.temperature, *tracks))
    edges = [edge for part in prior.regime_sets() for edge in part.temperature_range_c]
    lower, upper, coldest, hottest = min(edges), max(edges), temperature.min(), temperature.max()
    text = f'the prior gives the effect of temperature from {lower:.0f} to {upper:.0f} degC'
    if max(lower - coldest, hottest - upper) <= 1.0:
        return Finding('span', 'good', text)
    return advice(
        'span',
        f'{text}; the bags reach {coldest:.0f} to {hottest:.0f} degC, and the fit leaves out the '
        'part of a rest beyond this range, unless the whole rest is beyond it: fit the bags '
        'together with the bags of the prior',
    )


def _has_drift(windows: ThermalWindows) -> bool:
    """Whether the drift of |f| within the positions is above 10 times the noise of a window."""
    data = windows.data
    norm = np.linalg.norm(data.mean, axis=1, keepdims=True)
    drift = float(np.sqrt(np.mean(within_positions(norm, data.position) ** 2)))
    noise = float(np.sqrt(np.mean(white_noise_of(data, np.ones(3)) ** 2)))
    return drift > 10.0 * noise > 0.0


def _ramp_rates(windows: ThermalWindows) -> Floats:
    """Return board rates [K/min], (n,); 0 where the windows' slope is below half the rate."""
    rate, edges = windows.rate * 60.0, windows.data.edges
    for rows in map(slice, edges[:-1], edges[1:]):
        if rows.stop - rows.start > 1:
            change = 60.0 * np.gradient(windows.temperature[rows], windows.data.time[rows])
            rate[rows] *= change * np.sign(rate[rows]) > 0.5 * np.abs(rate[rows])
    return np.asarray(rate)


def _judge_ramps(windows: ThermalWindows) -> Iterator[Finding]:
    rate = _ramp_rates(windows)
    heating, cooling = float(np.mean(rate > RAMP_K_MIN)), float(np.mean(rate < -RAMP_K_MIN))
    if heating + cooling < 0.02:
        yield advice(
            'ramps',
            'no ramp: the board temperature changes by more than '
            f'{RAMP_K_MIN:g} K/min in less than 2 % of the windows, so the effect of a ramp is '
            'unknown; record ramps between the soaks',
        )
        steps = np.diff(np.sort(windows.temperature))
        # Temperatures on both sides of a gap wider than this [K] belong to different soaks.
        least = max(1.0, 0.1 * steps.sum())
        is_gap = steps > least
        n = 1 + int(is_gap.sum())
        # A bag whose temperature drifts slowly through its range has no soaks to count.
        has_soaks = steps[~is_gap].sum() < n * least
        # Five temperatures determine a cubic, and show whether the cubic fits.
        if has_soaks and n < 5:
            yield advice(
                'soaks',
                f'soaks at {counted(n, "temperature")}: the curve of the bias at temperatures '
                'between or beyond the soaks is unknown; five temperatures determine a cubic',
            )
    elif min(heating, cooling) < 0.1 * max(heating, cooling):
        missing = 'cooling' if heating > cooling else 'heating'
        yield advice(
            'directions',
            f'hardly any {missing} was recorded; heating and cooling cause errors of opposite '
            f'sign, so record more {missing}',
        )
    if not windows.has_soaks:
        share, span = np.mean(~windows.is_dynamic), float(np.ptp(windows.temperature))
        yield advice(
            'soak',
            f'only {100.0 * share:.0f} % of the windows are static, over '
            f'{windows.static_span:.1f} K of the span of {span:.1f} K: the soaks end before the '
            'temperatures of the unit are constant; let some soaks last for hours',
        )


def _judge_positions(up: Floats) -> Finding:
    n = len(distinct_directions(up))
    if n < POSITIONS_NEEDED:
        return advice(
            'positions',
            f'{counted(n, "position")}: bias and scale cannot be separated and keep their prior; '
            f'{POSITIONS_NEEDED} positions separate them, '
            f'{POSITIONS_FOR_MISALIGNMENT} give the misalignment',
        )
    if not determines_misalignment(up):
        return advice(
            'misalignment',
            f'{n} positions determine bias and scale; the misalignment keeps its prior: it needs '
            f'{POSITIONS_FOR_MISALIGNMENT} well spread positions',
        )
    advised = 18  # number of positions: two for each of the nine constants
    if n < advised:
        return advice(
            'positions',
            f'{n} positions; {advised} would reduce the uncertainty of bias, scale and '
            'misalignment',
        )
    return Finding('positions', 'good', f'{n} positions')


def judge_coverage(axis: LeastKnown | None) -> Iterator[Finding]:
    """Advise a position if the sd of |f| in an attitude is >= 3 times its median at positions."""
    if axis is not None and axis.sd_m_s2 >= 3.0 * axis.seen_sd_m_s2:
        yield advice(
            'unseen',
            f'{axis.away_deg:.0f} deg away from every position the standard deviation of |f| is '
            f'{ug_text(axis.sd_m_s2)}, against {ug_text(axis.seen_sd_m_s2)} in the positions: '
            f'record a position with {direction_text(np.array(axis.up))}',
        )


def judge_mountings(fit: Fit, offset_sd: float, options: FitOptions) -> Iterator[Finding]:
    """
    Report the sd of mounting and turn-on offsets if the fit had to assume this sd.

    `offset_sd`: published sd of the bias offset of a mounting [m/s^2]. In nine positions the nine
    constants of a triad explain the values of |f|, whatever the mounting offsets are.
    """
    if options.mounting_sd and offset_sd > 1.5 * fit.posterior.prior.offset_sd:
        yield advice(
            'mountings',
            f'|f| differs between positions as by bias offsets of {ug_text(offset_sd)}, far more '
            f'than the stated --mounting-sd of {ug_text(options.mounting_sd)}: the published '
            'uncertainty assumes the larger offsets. Is a bag of another unit, mounting or scale '
            'among the bags?',
        )
    prior = fit.posterior.prior
    n, n_turn_ons = int(fit.windows.data.mounting[-1]) + 1, fit.windows.data.n_turn_ons
    if options.mounting_sd is not None or options.prior is not None or n < POSITIONS_NEEDED:
        return
    assumed = f'the bias is assumed to repeat to {ug_text(offset_sd)} (1 sd): state --mounting-sd'
    # Smallest number of turn-ons that determine the sd of turn-on offsets.
    needed = 4
    if n_turn_ons < min(n, needed):
        yield advice(
            'mountings',
            f'{n} rests in {counted(fit.regression.n_bags, "recording")} have '
            f'{counted(n_turn_ons, "turn-on")}, too few to show how well the bias repeats after '
            f'the unit is switched on again; {assumed}, or make {needed} recordings or more and '
            'switch the unit off for a minute or longer between them',
        )
    elif n < POSITIONS_FOR_MOUNTINGS and prior.offset_sd < prior.offset_scale:
        yield advice(
            'mountings',
            f'{n} positions do not show how well the bias repeats after the unit is mounted or '
            f'switched on again; {assumed}, or record {POSITIONS_FOR_MOUNTINGS} positions or more',
        )


def judge_groups(fit: Fit, options: FitOptions) -> Iterator[Finding]:
    """Report groups of columns named in `options` of which the chosen model has no column."""
    wanted = dict.fromkeys((*(options.groups or ()), *options.forced))
    absent = [group for group in wanted if group not in fit.windows.data.groups]
    if absent and options.prior is None:
        yield advice(
            'groups',
            f'the model has no columns of {", ".join(absent)}, which --groups or --force-groups '
            'names: the fit makes columns of part if the drifts show a lag of each axis, and most '
            'columns of gradient groups if each bag has a case temperature',
        )


def determines_misalignment(up: Floats) -> bool:
    """
    Whether the number and the spread of positions are sufficient to estimate the misalignment.

    The ratio of the largest sd of a constant to the noise of one position must be at most 6. The
    ratio is 1 for 18 well spread positions, 3 for nine, and 4.5 to 8 if each of the six faces is
    held up by hand three times.
    """
    distinct = distinct_directions(up)
    is_enough = len(distinct) >= POSITIONS_FOR_MISALIGNMENT
    return is_enough and geometry(distinct, with_misalignment=True) <= 6.0


def judge_constants(fit: Fit, raw: float, options: FitOptions) -> Iterator[Finding]:
    """
    Refuse data that appear to be compensated already.

    `raw`: RMS of |f| - g of samples corrected by the constants at the reference temperature only
    [m/s^2]. No uncompensated triad has biases [g], relative errors of the scale and misalignments
    [rad] that are all below 1e-4, and a `raw` below 2e-5 g over 20 K.
    """
    state, K = fit.posterior.state, fit.posterior.state.kappa * fit.regression.nominal_scale
    span = float(np.ptp(fit.windows.temperature))
    scale = float(np.abs(K / (1.0 if options.input == 'm/s^2' else K.mean()) - 1.0).max())
    worst, angle = float(np.abs(state.bias).max()), float(np.abs(state.misalignment).max())
    largest = max(scale, worst / options.gravity, angle)
    is_small = largest < 1e-4 and raw < 2e-5 * options.gravity
    if is_small and span > 20.0 and determines_misalignment(state.up):
        yield Finding(
            'compensated',
            'refusal',
            f'there is nothing to correct: over {span:.0f} K |f| - g is {raw / MICRO_G:.1f} ug '
            f'RMS, scale factors are within {1e6 * scale:.1f} ppm, biases within '
            f'{worst / MICRO_G:.1f} ug, misalignments within {1e6 * angle:.1f} urad: the samples '
            'are already compensated, and the calibration must be made from raw samples',
        )


def check_scale(fit: Fit) -> None:
    """
    Refuse a scale factor that deviates by more than six sd from its prior mean, if attitudes are
    few: a drift, step or motion in the bags then looks like an error of the scale factor.
    """
    state, prior = fit.posterior.state, fit.posterior.prior
    if prior.informative or len(distinct_directions(state.up)) >= POSITIONS_NEEDED:
        return
    ratio = state.kappa / prior.scale_mean
    axis = int(np.argmax(np.abs(np.log(np.maximum(ratio, 1e-9)))))
    if abs(ratio[axis] - 1.0) > 6.0 * prior.scale_sd:
        raise UndeterminedError(
            f'by the fit the scale factor of {"xyz"[axis]} is {ratio[axis]:.2f} times the mean of '
            'the axes, which no triad has, and the attitudes are too few to determine the scale '
            'factor: are all rests of one unit, and was the unit still? '
            f'{POSITIONS_NEEDED} attitudes determine the scale factors'
        )


def judge_result(
    fit: Fit, overall: ResidualRow, norms: Floats, slow: float, options: FitOptions
) -> Iterator[Finding]:
    """
    Check the residuals of a fit; `overall`: statistics of the residuals of all windows.

    norms: ``|f| - g`` of each window, shape (n,) [m/s^2]
    slow: sd of the bias offset of a mounting or turn-on, fitted to the bags [m/s^2]
    """
    drift = within_positions(norms[:, None], fit.windows.data.position)
    span, noise = float(np.ptp(fit.windows.temperature)), fit.selected.score.noise
    prior, K = fit.posterior.prior, fit.posterior.state.kappa * fit.regression.nominal_scale
    raw, fitted = overall.raw.rms / MICRO_G, overall.fitted.rms / MICRO_G
    text = f'|f| - g: {raw:.1f} ug RMS raw, {fitted:.1f} ug in sample'
    if overall.left_out.n:
        text += f'; error on data left out {overall.left_out.rms / MICRO_G:.1f} ug'
    is_slow = slow / MICRO_G > max(0.3 * raw, 0.5 * fitted)
    # Noise explains a residual of up to twice the white noise.
    if span > 0.0 and is_slow and overall.fitted.rms > 2.0 * noise:
        why = 'temperature does not explain the drift (jumps, mounting, a loose thermometer?)'
        if float(np.sqrt(np.mean(drift**2))) <= max(2.0 * noise, 0.3 * overall.fitted.rms):
            why = (
                '|f| differs between positions, while temperature explains the drift within them: '
                'the bias does not repeat after the unit is mounted or switched on again'
            )
        yield advice('misfit', f'{text}: {why}')
    elif raw < 1.2 * fitted and span >= LEAST_SPAN_K:
        why = 'there is hardly a temperature drift above the noise to correct; are the samples'
        yield advice('compensated', f'{text}: {why} already compensated?')
    elif overall.left_out.rms > overall.raw.rms and raw >= 1.2 * fitted and span > 0.0:
        why = 'the other positions predict a left-out position badly; record more positions'
        yield advice('left out', f'{text}: left-out residuals exceed the raw residual: {why}')
    else:
        yield Finding('residual', 'good', text)
    alone = overall.two_sets.rms
    # A large residual due to bias offsets of up to 2 `slow`, or to initial lag states, does not
    # contradict the prior: the fit estimates them, so they do not increase its noise `sigma`.
    contradiction, sigma = '', float(np.mean(prior.sigma))
    is_above = overall.fitted.rms > np.hypot(1.5 * alone, 2.0 * slow) and sigma > 1.5 * alone
    if options.prior is not None and is_above:
        contradiction = (
            f'|f| - g is {ug_text(overall.fitted.rms)} RMS with the prior, {ug_text(alone)} with '
            'static and dynamic curves fitted without the prior'
        )
    elif prior.informative and prior.informative.is_changed:
        contradiction = 'the parameters differ from the prior by far more than the prior sd'
    if contradiction:
        yield advice(
            'prior',
            f'the bags contradict the prior: {contradiction}; check that the calibration given by '
            '--prior is of this unit, or of its type',
        )
    if options.prior is not None and options.prior.provenance.model != POPULATION:
        yield from _judge_change(options.prior, K, fit.posterior.state)
    if options.input == 'm/s^2' and np.abs(K - 1.0).max() > 0.1:
        yield advice(
            'units',
            f'the scale factors are {K.min():.3g}..{K.max():.3g}, expected near 1 for m/s^2: is '
            'the unit of the samples right, and --gravity?',
        )


def _judge_change(earlier: Calibration, K: Floats, state: State) -> Iterator[Finding]:
    """
    Report a change of bias or scale, since the calibration `earlier` of the unit, beyond 1 mg or
    1000 ppm and beyond 30 sd of `earlier`: the limits above which `update` refuses a unit.

    K: scale factors by the fit [input units per m/s^2], shape (3,)
    """
    if earlier.posterior is None:
        return
    layout, variance = parameter_layout(earlier), np.diag(earlier.posterior.covariance())
    axes, g = list(earlier.axes), earlier.gravity_m_s2
    before = np.array([axis.scale_factor for axis in axes])
    sd_of_bias, sd_of_scale = (
        np.sqrt(variance[[block.static for block in blocks]])
        for blocks in (layout.bias, layout.scale)
    )
    shift = state.bias / state.kappa - np.array([axis.bias for axis in axes]) / before
    ratio = K / before - 1.0
    is_far = np.abs(shift) > np.maximum(1e-3 * g, 30.0 * sd_of_bias / before)
    is_far |= np.abs(ratio) > np.maximum(1e-3, 30.0 * sd_of_scale)
    if is_far.any():
        changes = [
            f'{axis} by {1e3 * shift[k] / g:+.3g} mg and {1e6 * ratio[k]:+.0f} ppm'
            for k, axis in enumerate('xyz')
        ]
        yield advice(
            'change',
            f'bias and scale have changed since the prior: {", ".join(changes)}. Was the unit '
            'shocked, are axes exchanged, or is a bag of another unit?',
        )
