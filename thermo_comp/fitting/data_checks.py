# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the checks of the data before and after a fit, with numbers and advice.

Only contradictory data are refused; missing data increase the posterior uncertainty. A refusal
stops the fit unless the user allows it by name; advice goes into the result.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..errors import FitError
from ..recording.overview import KELVINS
from ..text import counted
from ..thermal.settings import ADVISED_SPAN_K, RAMP_K_MIN
from ..typing import Floats
from ..unit.calibration import POPULATION, Calibration
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY, spoken
from .coverage import LeastKnown, distinct_directions, geometry, spoken_direction
from .jumps import Jump, find_jumps
from .options import FitOptions
from .reduction import ReducedBag
from .windows import ThermalWindows

if TYPE_CHECKING:
    from .evidence import ResidualRow
    from .selection import Fit

#: Smallest numbers of distinct attitudes: that determine bias and scale factor (six constants),
#: and that determine the misalignment (three constants) in addition.
POSITIONS_NEEDED, POSITIONS_FOR_MISALIGNMENT = 6, 9
#: Smallest number of positions whose norms determine the sd of mounting offsets beside the nine
#: constants.
POSITIONS_FOR_MOUNTINGS = 12


@dataclass(frozen=True)
class Finding:
    """A finding of the checks: the name by which a user can allow a refusal, and the message."""

    name: str
    level: Literal['refusal', 'advice', 'good']
    message: str

    def __str__(self) -> str:
        return f'{self.name}: {self.message}'


def _advice(name: str, message: str) -> Finding:
    return Finding(name, 'advice', message)


def enforce(findings: Iterable[Finding], options: FitOptions) -> list[Finding]:
    """Raise FitError at the first refusal that the user does not allow."""
    result = []
    for finding in findings:
        if finding.level != 'refusal':
            result.append(finding)
        elif finding.name in options.allow:
            result.append(_advice(finding.name, f'allowed: {finding.message}'))
        else:
            raise FitError(f'{finding.message} (override with --allow {finding.name})')
    return result


def judge_prior(serial: str, prior: Calibration | None) -> Iterator[Finding]:
    """
    Refuse a prior of another unit: the small uncertainties of a unit do not apply to another.
    """
    if prior is None or prior.provenance.model == POPULATION:
        return
    if 'unknown' not in (serial, prior.unit.serial) and serial != prior.unit.serial:
        yield Finding(
            'prior',
            'refusal',
            f'the prior is the calibration of unit {prior.unit.serial}, the bags are of {serial}: '
            'make a prior of their type from three units or more with thermo_comp prior',
        )


def judge_bags(bags: Sequence[ReducedBag], options: FitOptions) -> Iterator[Finding]:
    """Check the raw data: saturation, motion, numbers that are no counts, jumps, angular rates."""
    part = sum(bag.n_saturated for bag in bags) / max(sum(bag.n_samples for bag in bags), 1)
    if part > 0.001:
        yield Finding(
            'saturation',
            'refusal' if part > 0.05 else 'advice',
            f'{100.0 * part:.2f} % of the samples are at the full scale: an axis sees more than '
            'it can measure, or --full-scale is wrong',
        )
    part = sum(bag.n_dropped for bag in bags) / max(sum(bag.n_samples for bag in bags), 1)
    if part > 0.01:
        yield _advice(
            'dropped',
            f'{100.0 * part:.0f} % of the samples are not finite, or have a stamp that does not '
            'rise, and are left out: was a clock set back?',
        )
    still = sum(bag.n_still_cells for bag in bags) / max(sum(bag.n_cells for bag in bags), 1)
    if still < 0.5:
        yield _advice(
            'motion',
            f'the unit was still for only {100.0 * still:.0f} % of the time; vibration or '
            'handling in the other time was cut out',
        )
    if not any(interval.sample_sd.any() for bag in bags for interval in bag.intervals):
        text = 'at rest all samples are equal: does the sensor repeat one reading?'
        yield _advice('stuck', text)
    if dead := '; '.join(_dead_axes(bags)):
        text = f'{dead}: the axis is dead there, leave out a bag with a dead axis'
        yield Finding('stuck', 'refusal', text)
    for name in sorted({name for bag in bags for name in bag.temperatures}):
        read = [b.temperatures[name].value for b in bags if name in b.temperatures]
        celsius = np.concatenate(read)
        if len(celsius) and KELVINS[0] < np.median(celsius) < KELVINS[1]:
            reads = f'temperature/{name} reads {np.min(celsius):.4g} .. {np.max(celsius):.4g} degC'
            yield _advice('kelvins', f'{reads}: that looks like kelvins')
    means = np.concatenate([interval.mean for bag in bags for interval in bag.intervals])
    size = float(np.median(np.linalg.norm(means, axis=1)))
    if options.input == 'counts' and not all(bag.is_integer for bag in bags):
        for unit, one_g in (('m/s^2', STANDARD_GRAVITY), ('g', 1.0)):
            if abs(size / one_g - 1.0) < 0.1:
                yield Finding(
                    'units',
                    'refusal',
                    f'the samples have norm {size:.3g} and are no whole numbers: they look like '
                    f'{unit}, not counts; record them as sensor_msgs/Imu in m/s^2',
                )
                break
        else:
            yield _advice(
                'compensated',
                'the samples are no whole numbers: scaled or compensated before they were '
                'recorded? A calibration made from scaled samples is valid for that scaling only',
            )
    jumps = [(bag, event) for bag in bags for event in find_jumps(bag)]
    if jumps:
        per_mg = 1e-3 * (STANDARD_GRAVITY if options.input == 'm/s^2' else size)
        jumped = '; '.join(
            f'{bag.source.name}: {describe(event, per_mg, bag.since_s)}' for bag, event in jumps
        )
        text = f'{jumped}: leave out a bag with a jump, or end before the jump with --to'
        yield Finding('jump', 'refusal', text)
    if not all(bag.angular_rate == bags[0].angular_rate != 'part' for bag in bags):
        names = ', '.join(bag.source.name for bag in bags if bag.angular_rate != 'whole')
        text = f'{names}: not every sample has an angular rate, so no gyroscope was fitted'
        yield _advice('rate', text)


def _dead_axes(bags: Sequence[ReducedBag]) -> Iterator[str]:
    """Describe axes that are constant throughout a rest, but not in most of the rests."""
    rests = [(bag.source.name, rest) for bag in bags for rest in bag.intervals]
    alive = np.array([rest.sample_sd > 0.0 for _, rest in rests])
    usual = 2 * alive.sum(axis=0) >= len(rests)
    for (name, rest), is_alive in zip(rests, alive, strict=True):
        is_dead = ~is_alive & usual & (np.ptp(rest.mean, axis=0) == 0.0)
        # The samples of a working axis show noise or drift within a thousand samples.
        for axis in np.flatnonzero(is_dead & (rest.count.sum() >= 1000)):
            hours = (rest.end_ns - rest.start_ns) / 3600e9
            letter, value = 'xyz'[axis], rest.mean[0, axis]
            yield f'{name}: {letter} reads {value:g} to the bit for {hours:.2g} h'


def describe(jump: Jump, per_mg: float, since_s: float = 0.0) -> str:
    """Describe a jump; `since_s`: start of the part of the bag that was read [s]."""
    vector = ', '.join(f'{v / per_mg:+.3g}' for v in jump.step)
    warmed = ''
    if np.isfinite(jump.temperature_change):
        warmed = (
            f', while its temperature changed by {jump.temperature_change:+.2f} ± '
            f'{jump.temperature_change_sd:.2f} K'
        )
    return (
        f'at {jump.time + since_s:.1f} s the sensor jumped by {jump.along / per_mg:+.3g} mg along '
        f'gravity ({vector}) within {jump.duration_s:.2g} s, without motion{warmed}: not a '
        'function of temperature'
    )


def judge_copies(names: Sequence[str]) -> list[Finding]:
    """Report the thermometers that repeat the board's readings."""
    return [
        _advice('copy', f'temperature/{name} repeats the readings of the board: it is left out')
        for name in names
    ]


def judge_windows(windows: ThermalWindows, up: Floats, has_case: bool) -> Iterator[Finding]:
    """Check temperatures, ramps and directions `up`, shape (n, 3), of the windows at rest."""
    yield _judge_positions(up)
    if not windows.has_temperature:
        text = (
            'no change of temperature was read: the calibration holds at the temperature of the '
            'test'
        )
        yield _advice('temperature', text)
        return
    used_bags = {id(bag): bag for bag, _ in windows.rests}.values()
    n_still = sum(interval.count.sum() for bag in used_bags for interval in bag.intervals)
    part = 1.0 - windows.data.weight.sum() * windows.typical_count / max(n_still, 1.0)
    if used_bags and part > 0.1:
        yield _advice(
            'unmeasured',
            f'{100.0 * part:.0f} % of the time at rest has no temperatures and is left out: do '
            'the thermometers and the accelerometer use the same clock?',
        )
    span = float(np.ptp(windows.temperature))
    text = f'temperature span {span:.1f} degC'
    if span >= ADVISED_SPAN_K:
        yield Finding('span', 'good', text)
    else:
        yield _advice(
            'span',
            f'{text} ({ADVISED_SPAN_K:g} advised): run the chamber over the whole range of use',
        )
    yield from _judge_ramps(windows)
    if not has_case:
        text = (
            'no case temperature: the regime is detected from the board temperature alone, later '
            'and less reliably'
        )
        yield _advice('case', text)
        return
    # The case temperature leads, so the gradient has the sign of the board's rate.
    moving = np.abs(_ramp_rates(windows)) > RAMP_K_MIN
    if windows.data.weight[moving].sum() >= 30.0 * windows.data.weight.max():
        correlation = float(np.corrcoef(windows.gradient[moving], windows.rate[moving])[0, 1])
        if correlation <= -0.3:
            yield Finding(
                'swapped',
                'refusal',
                f'the board temperature leads the case (correlation {correlation:.2f} of gradient '
                'and rate): are the two sensors exchanged?',
            )


def _ramp_rates(windows: ThermalWindows) -> Floats:
    """
    Return the rate of the board temperature [K/min], shape (n,); 0 where the mean temperature
    changes by less than half of this rate from one window to the next, because such a rate is
    noise.
    """
    rate, edges = windows.rate * 60.0, windows.data.edges
    for begin, end in pairwise(edges.tolist()):
        if end - begin > 1:
            rows = slice(begin, end)
            change = 60.0 * np.gradient(windows.temperature[rows], windows.data.time[rows])
            rate[rows] *= change * np.sign(rate[rows]) > 0.5 * np.abs(rate[rows])
    return np.asarray(rate)


def _judge_ramps(windows: ThermalWindows) -> Iterator[Finding]:
    rate = _ramp_rates(windows)
    heating, cooling = float(np.mean(rate > RAMP_K_MIN)), float(np.mean(rate < -RAMP_K_MIN))
    if heating + cooling < 0.02:
        yield _advice(
            'ramps',
            f'no ramp: the board temperature never changes by {RAMP_K_MIN:g} K/min for long, so '
            'the effect of a ramp is unknown; record ramps between the soaks',
        )
    elif min(heating, cooling) < 0.1 * max(heating, cooling):
        seen, missing = ('heating', 'cooling') if heating > cooling else ('cooling', 'heating')
        yield _advice(
            'directions',
            f'only {seen} was recorded; errors in a ramp change sign with its direction, so '
            f'record {missing}, too',
        )
    calm = windows.weight <= 0.5
    span = float(np.ptp(windows.temperature))
    static = float(np.ptp(windows.temperature[calm])) if calm.any() else 0.0
    if np.mean(calm) < 0.05 or static < 0.5 * span:
        yield _advice(
            'soak',
            f'only {100.0 * np.mean(calm):.0f} % of the windows are static, over {static:.1f} of '
            f'{span:.1f} K: the soaks end before the unit has settled; let some last for hours',
        )


def _judge_positions(up: Floats) -> Finding:
    n = len(distinct_directions(up))
    if n < POSITIONS_NEEDED:
        return _advice(
            'positions',
            f'{counted(n, "position")}: bias and scale cannot be separated and keep their prior; '
            f'{POSITIONS_NEEDED} positions separate them, '
            f'{POSITIONS_FOR_MISALIGNMENT} give the misalignment',
        )
    if not determines_misalignment(up):
        return _advice(
            'misalignment',
            f'{n} positions determine bias and scale; the misalignment keeps its prior: it needs '
            f'{POSITIONS_FOR_MISALIGNMENT} well spread positions',
        )
    advised = 18  # two per constant
    if n < advised:
        return _advice('positions', f'{n} positions; {advised} would reduce the uncertainty')
    return Finding('positions', 'good', f'{n} positions')


def judge_coverage(least: LeastKnown | None) -> Iterator[Finding]:
    """Advise a further position if the sd of |f| in some attitude is 3 times that in positions."""
    if least is not None and least.sd_m_s2 >= 3.0 * least.seen_sd_m_s2:
        yield _advice(
            'unseen',
            f'{least.away_deg:.0f} deg away from every position the sd of |f| is '
            f'{spoken(least.sd_m_s2)}, in the positions {spoken(least.seen_sd_m_s2)}: record a '
            f'position with {spoken_direction(np.array(least.up))}',
        )


def judge_mountings(fit: Fit, offset_sd: float, options: FitOptions) -> Iterator[Finding]:
    """
    Report the assumed repeatability of mountings and turn-ons if the norms do not determine it.

    `offset_sd`: published sd of the bias offset of a mounting [m/s^2]. The norms of nine positions
    are explained by nine constants, whatever the offsets.
    """
    n = fit.windows.data.n_positions
    is_assumed = options.mounting_sd is None and options.prior is None
    if is_assumed and POSITIONS_NEEDED <= n < POSITIONS_FOR_MOUNTINGS:
        yield _advice(
            'mountings',
            f'{n} positions do not show how well the bias repeats after the unit is mounted or '
            f'switched on again; the uncertainty assumes {spoken(offset_sd)}: state '
            f'--mounting-sd, or record {POSITIONS_FOR_MOUNTINGS} positions or more',
        )


def determines_misalignment(up: Floats) -> bool:
    """
    Whether the number and the spread of positions are sufficient to estimate M.

    The limit is 6 for the sd of a parameter in units of the noise of one position: 18 well spread
    positions give 1, nine give 3, the six faces held three times each by hand give 4.5 to 8.
    """
    distinct = distinct_directions(up)
    if len(distinct) < POSITIONS_FOR_MISALIGNMENT:
        return False
    return geometry(distinct, with_misalignment=True) <= 6.0


def judge_constants(fit: Fit, raw: float, options: FitOptions) -> Iterator[Finding]:
    """
    Refuse data that appear to be compensated already.

    `raw`: RMS of |f| - g with the constants of the triad alone [m/s^2].
    No triad is built with all constants below 1e-4 and a drift of |f| below 2e-5 g over 20 K.
    """
    state, K = fit.posterior.state, fit.posterior.state.kappa * fit.regression.nominal_scale
    span = float(np.ptp(fit.windows.temperature))
    scale = float(np.abs(K / (1.0 if options.input == 'm/s^2' else K.mean()) - 1.0).max())
    worst, skewed = float(np.abs(state.bias).max()), float(np.abs(state.misalignment).max())
    largest = max(scale, worst / options.gravity, skewed)
    is_none = largest < 1e-4 and raw < 2e-5 * options.gravity
    if is_none and span > 20.0 and determines_misalignment(state.up):
        yield Finding(
            'compensated',
            'refusal',
            f'there is nothing to correct: over {span:.0f} K |f| moves by {raw / MICRO_G:.1f} ug '
            f'RMS, scales differ by {1e6 * scale:.1f} ppm, biases reach {worst / MICRO_G:.1f} ug '
            f'and misalignments {1e6 * skewed:.1f} urad: the samples have been compensated '
            'already, and the calibration must be made from raw samples',
        )


def judge_result(
    K: Floats,
    rows: Sequence[ResidualRow],
    slow: float,
    options: FitOptions,
    has_temperature: bool = True,
) -> Iterator[Finding]:
    """Check the residuals; `slow`: sd of the bias that no temperature explains [m/s^2]."""
    overall = rows[-1]
    raw, fitted = overall.raw.rms / MICRO_G, overall.fitted.rms / MICRO_G
    others = ''
    if overall.left_out.n:
        others = f'{overall.left_out.rms / MICRO_G:.1f} ug on data left out, '
    text = f'|g| error {raw:.1f} ug RMS raw, {others}{fitted:.1f} ug in sample'
    if has_temperature and slow / MICRO_G > max(0.3 * raw, 0.5 * fitted):
        why = ': temperature does not explain the drift (jumps, mounting, a loose thermometer?)'
        yield _advice('misfit', text + why)
    elif raw < 1.2 * fitted and has_temperature:
        why = ': no temperature drift above the noise; already compensated?'
        yield _advice('compensated', text + why)
    elif overall.left_out.rms > overall.raw.rms and has_temperature:
        why = 'each position is predicted badly by the others; record more positions'
        yield _advice('left out', f'{text}: left-out positions exceed the raw error: {why}')
    else:
        yield Finding('residual', 'good', text)
    alone = overall.two_sets.rms
    if options.prior is not None and overall.fitted.rms > 1.5 * alone:
        yield _advice(
            'prior',
            f'the bags contradict the prior: |f| - g is {spoken(overall.fitted.rms)} RMS with the '
            f'prior, {spoken(alone)} with two sets fitted without it: was the prior made for this '
            'unit, or for its type?',
        )
    if options.input == 'm/s^2' and np.abs(K - 1.0).max() > 0.1:
        yield _advice(
            'units',
            f'the scale factors are {K.min():.3g}..{K.max():.3g}, expected near 1 for m/s^2: is '
            'the unit, or --gravity, right?',
        )
