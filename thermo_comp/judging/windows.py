# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the windows of a judgement: means of samples at rest, corrected as in the node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..errors import RecordingError
from ..fitting import reduction
from ..fitting.priors import constants_of
from ..fitting.reduction import ReducedBag
from ..fitting.sensors import readings_in_order
from ..online.checks import variance_along
from ..online.compensator import Compensator
from ..online.status import CompensatorConfig
from ..thermal.state import BOARD, RATE, UNKNOWN, WEIGHT, StateLayout
from ..typing import Bools, Floats, Ints, Stamps
from ..unit.calibration import AXES, Calibration
from ..unit.correction import Correction
from ..unit.gravity import MICRO_G
from ..unit.metrics import norm_residual
from ..unit.nonlinearity import AT_REST

#: Default duration of a window of a judgement [s].
WINDOW_S = 60.0
# Largest sum of the distances of a window from the ranges of temperature, rate and the farthest
# column [half ranges] at which the window counts as inside, because thermometers have noise.
_RANGE_TOLERANCE = 0.02
# Smallest number of samples of a usable partial sum / median number of samples of partial sums.
_LEAST_FILLED = 0.9


@dataclass(frozen=True)
class JudgedWindows:
    """
    Windows at rest of all bags, in the order of bags and time; arrays of n rows.

    A window lasts exactly `window_s` from `start_ns`; `time`: middle of the window, from the bag's
    first sample [s]; `count`, `mean`: number and mean of the window's raw samples. A position
    is a still interval, numbered through all bags. `rate`: rate of the board temperature [K/s].
    `is_dynamic`: the coefficients of the dynamic regime have more than half the weight;
    `is_inside`: the window is entirely inside the calibrated ranges; `is_swapped`: the board
    temperature leads the case temperature. `raw` is the specific force with the constants at the
    reference temperature, `force` with the calibration, shapes (n, 3). `size`: the known |f|,
    which is gravity unless the bag states another value. `claimed_sd`: sd of ``|force| - size``
    due to the calibration, `size` and white noise of the mean; `noise_sd`, `lack_sd`: sd due to
    the white noise alone, and due to the lack of fit alone. Rows of `gyro`: raw and corrected
    angular rate, claimed variances, thermal state; empty without a gyroscope.
    """

    window_s: float
    gravity: float
    bag: Ints
    position: Ints
    start_ns: Stamps
    time: Floats
    count: Ints
    mean: Floats
    board: Floats
    rate: Floats
    is_dynamic: Bools
    is_inside: Bools
    is_swapped: Bools
    raw: Floats
    force: Floats
    size: Floats
    claimed_sd: Floats
    noise_sd: Floats
    lack_sd: Floats
    gyro: Floats

    def __len__(self) -> int:
        return len(self.time)

    def select(self, rows: Bools) -> JudgedWindows:
        """Return some of the windows: the given rows of each array."""
        kept = {field.name: getattr(self, field.name)[rows] for field in fields(self)[2:]}
        return replace(self, **kept)

    @cached_property
    def raw_residual(self) -> Floats:
        """|f| with the constants at T_ref, less the known |f|, shape (n,) [m/s^2]."""
        return norm_residual(self.raw, self.size)

    @cached_property
    def residual(self) -> Floats:
        """|f| with the calibration, less the known |f|, shape (n,) [m/s^2]."""
        return norm_residual(self.force, self.size)

    @property
    def is_usual(self) -> Bools:
        """Whether the known |f| (`size`) of each window is within 1 % of gravity."""
        return np.asarray(np.abs(self.size / self.gravity - 1.0) < AT_REST - 1.0)


def sum_length(window_s: float) -> float:
    """Return the longest duration [s] of a partial sum, up to 10 s, that divides `window_s`."""
    return window_s / float(np.ceil(window_s / reduction.WINDOW_S))


def usual_window(bags: Sequence[ReducedBag]) -> float:
    """Return the window length [s]: 60 s rounded up to a multiple of the largest `window_s`."""
    longest = max(bag.window_s for bag in bags)
    return float(np.ceil(WINDOW_S / longest - 1e-6)) * longest


def corrected_windows(
    bags: Sequence[ReducedBag],
    calibration: Calibration | None,
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
) -> JudgedWindows:
    """
    Build the windows of bags, and correct the windows if there is a calibration. Raises
    RecordingError if the sample rate is too low for windows of `window_s`.
    """
    if gravity is None:
        gravity = np.nan if calibration is None else calibration.gravity_m_s2
    table = _table(bags, calibration, window_s, gravity)
    raw, claimed_sd, noise_sd, lack_sd = table['mean'], *np.full((3, len(table)), np.nan)
    is_inside = table['excess'] <= _RANGE_TOLERANCE
    if calibration is not None:
        constants, force = constants_of(calibration), table['force']
        correction = Correction(calibration)
        raw = constants.force(raw)
        along = force / np.linalg.norm(force, axis=1, keepdims=True) @ constants.misalignment
        noise = along**2 @ np.array(correction.noise)
        # The mean has no rounding noise: a converter adds the remainder to the next sample.
        white = along**2 @ np.square(calibration.noise_density_m_s2_sqrt_hz)
        # A higher sample rate raises the noise of each sample, and not the noise of the mean.
        covered_s = np.minimum(calibration.unit.cycle_time_s * table['count'], window_s)
        mean_white = white / covered_s
        variance = np.maximum(table['variance'] - noise, 0.0) + mean_white
        claimed_sd = np.sqrt(variance + table['size_sd'] ** 2)
        noise_sd = np.sqrt(mean_white)
        regimes = np.array([1.0 - table['weight'], table['weight']])
        # In an unknown regime the claimed variance includes the lack of fit of both sets.
        shares = (regimes + table['unknown'] * regimes[::-1])[:, np.newaxis]
        lack = (shares * correction.curves.lack_of_fit(table['board'])).sum(axis=0)
        lack_sd = np.sqrt(np.sum(along**2 * lack.T, axis=1))
        known = calibration.nonlinearity
        is_inside &= table['size'] <= (known.force_range_m_s2[1] if known else AT_REST * gravity)
    copied = (*_ONCE, 'time', 'board', 'rate', 'size', *_TRIPLES, 'gyro')
    return JudgedWindows(
        window_s=window_s,
        gravity=gravity,
        is_dynamic=table['weight'] > 0.5,
        is_inside=is_inside,
        is_swapped=table['swapped'] > 0.0,
        raw=raw,
        claimed_sd=claimed_sd,
        noise_sd=noise_sd,
        lack_sd=lack_sd,
        **{name: table[name] for name in copied},
    )


def columns_of(windows: JudgedWindows, bags: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of a table of windows."""
    force = windows.force.T
    return {
        'bag': np.array(bags, dtype=object)[windows.bag],
        'position': windows.position + 1,
        'start_ns': windows.start_ns,
        'time_s': windows.time,
        'window_s': np.full(len(windows), windows.window_s),
        'samples': windows.count,
        'board_c': windows.board,
        'board_rate_k_min': windows.rate * 60.0,
        'regime': np.where(windows.is_dynamic, 'dynamic', 'static'),
        'is_inside': windows.is_inside.astype(int),
        **{f'force_{axis}_m_s2': force[k] for k, axis in enumerate(AXES)},
        'known_force_m_s2': windows.size,
        'raw_residual_ug': windows.raw_residual / MICRO_G,
        'residual_ug': windows.residual / MICRO_G,
        'claimed_sd_ug': windows.claimed_sd / MICRO_G,
    }


# A structured array of partial sums of samples, or of windows.
_Table: TypeAlias = npt.NDArray[Any]
# Integer fields of a window: `count` is the total over the window's partial sums, other fields are
# copied from the first partial sum. Fields in `_AVERAGED` and `_TRIPLES` are means over the sums.
_ONCE = ('bag', 'position', 'start_ns', 'count')
_AVERAGED = (
    *('time', 'board', 'rate', 'weight', 'unknown'),
    *('variance', 'swapped', 'size', 'size_sd'),
)
_TRIPLES = ('mean', 'force')


def _table(
    bags: Sequence[ReducedBag], calibration: Calibration | None, window_s: float, gravity: float
) -> _Table:
    """Combine the partial sums of bags into windows, one per row."""
    n_gyro = 0
    if calibration is not None and calibration.gyroscope is not None:
        n_gyro = 9 + StateLayout(Correction(calibration).memory).width
    kind = np.dtype(
        [(name, np.int64) for name in _ONCE]
        + [(name, float) for name in (*_AVERAGED, 'excess')]
        + [(name, float, 3) for name in _TRIPLES]
        + [('gyro', float, n_gyro)]
    )
    parts: list[_Table] = [np.zeros(0, kind)]
    n_positions = 0
    for number, bag in enumerate(bags):
        per_window = max(1, round(window_s / bag.window_s))
        if abs(per_window * bag.window_s - window_s) > 1e-6 * window_s:
            raise RecordingError(
                f'the sample rate is too low for windows of {window_s:g} s: give --window as '
                f'{bag.window_s:g} s or a multiple of it',
                path=bag.source.name,
            )
        sums: list[_Table] = [np.zeros(0, kind)]
        for rest in bag.intervals:
            n = rest.n_whole // per_window * per_window
            rows = np.zeros(n, kind)
            rows['bag'], rows['position'] = number, n_positions
            # In a recording of several bags the grid of the windows shifts where a bag ends.
            index = np.rint((rest.time[:n] - rest.begin_s) / bag.window_s - 0.5)
            begin_s = rest.begin_s + bag.window_s * index
            rows['start_ns'] = bag.start_ns + np.rint(begin_s * 1e9).astype(np.int64)
            rows['count'], rows['time'] = rest.count[:n], rest.time[:n]
            rows['mean'] = rest.mean[:n]
            rows['gyro'] = np.nan
            rows['size'] = gravity
            if (known := bag.source.force) is not None:
                first_ns = bag.start_ns - round(bag.since_s * 1e9)
                size = known.of(rest.start_ns, rest.end_ns, first_ns, gravity)
                rows['size'] = size.norm
                rows['size_sd'] = np.hypot(size.sd, known.radius_part(size))
            if n_gyro and rest.angular_rate is not None:
                rows['gyro'][:, :3] = rest.angular_rate[:n]
            sums.append(rows)
            n_positions += 1
        whole = np.concatenate(sums)
        if calibration is None:
            since = (bag.board.stamp_ns - bag.start_ns) * 1e-9
            whole['board'] = np.interp(whole['time'], since, bag.board.value) if len(whole) else 0
            whole['force'] = whole['mean']
        else:
            _correct(calibration, bag, whole)
        # A partial sum with lost messages, or cut by the end of the bag, is not used.
        few = _LEAST_FILLED * np.median(whole['count']) if len(whole) else 0.0
        whole['excess'][whole['count'] < few] = np.nan
        parts.append(_joined(whole.reshape(-1, per_window)))
    return np.concatenate(parts)


def _joined(sums: _Table) -> _Table:
    """Combine each row of partial sums to a window; drop windows with an unusable partial sum."""
    result = sums[:, 0].copy()
    result['count'] = sums['count'].sum(axis=1)
    result['excess'] = sums['excess'].max(axis=1)
    share = sums['count'] / result['count'][:, None]
    for name in (*_AVERAGED, *_TRIPLES, 'gyro'):
        result[name] = np.einsum('nk,nk...->n...', share, sums[name])
    return np.asarray(result[np.isfinite(result['excess'])])


def _correct(calibration: Calibration, bag: ReducedBag, sums: _Table) -> None:
    """Correct the mean samples in `sums`, each by the readings up to its middle time."""
    # The checks for stuck samples and gravity do not apply to means of samples.
    config = CompensatorConfig(stuck_timeout_s=0.0, gravity_tolerance_m_s2=0.0)
    compensator = Compensator(calibration, config)
    # Accept any forward step of the stamps, because a partial sum spans many samples.
    compensator.leap_ns = np.iinfo(np.int64).max
    thermal = compensator.thermal
    readings = iter(readings_in_order(bag, thermal.inputs))
    reading = next(readings, None)
    for row in sums:
        stamp_ns = bag.start_ns + round(float(row['time']) * 1e9)
        while reading is not None and reading[1] <= stamp_ns:
            compensator.push(*reading)
            compensator.flush(reading[1])
            reading = next(readings, None)
        corrected = compensator.process(stamp_ns, *row['mean'].tolist())
        if corrected is None:
            row['excess'] = np.nan
            continue
        state = thermal.sample(stamp_ns)
        row['force'] = corrected[:3]
        row['variance'] = variance_along(corrected[:3], corrected[3:])
        row['excess'] = thermal.correction.excess(state, is_dynamic=False).relative
        row['swapped'] = thermal.tracker.lead.is_reversed
        row['board'], row['rate'] = state[BOARD], state[RATE]
        row['weight'], row['unknown'] = state[WEIGHT], state[UNKNOWN]
        if compensator.corrects_rate:
            row['gyro'][3:9] = compensator.correct_rate(stamp_ns, *row['gyro'][:3])
            row['gyro'][9:] = thermal.tracker.sample(stamp_ns)
