# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the windows that a judgement rests on: means at rest of exactly the stated length.

A window is a run of whole sums of one still interval. Its mean goes through the compensator as a
sample does, with the readings that came before it, so that force, covariance and regime are the
node's; what is kept of a bag of any length is a row per window.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from ..errors import RecordingError
from ..fitting.history import readings_in_order
from ..fitting.reduction import ReducedBag, StillInterval
from ..online.compensator import Compensator
from ..online.gravity_check import variance_along
from ..online.snapshot import take_snapshot
from ..online.status import CompensatorConfig
from ..thermal.state import Layout
from ..typing import Bools, Floats, Ints, Stamps
from ..unit.calibration import Calibration
from ..unit.gravity import MICRO_G
from ..unit.metrics import norm_residual

#: Headings of `csv_of`.
COLUMNS = (
    *('bag', 'position', 'start_ns', 'time_s', 'window_s', 'samples'),
    *('board_c', 'board_rate_k_min', 'regime', 'is_inside'),
    *('force_x_m_s2', 'force_y_m_s2', 'force_z_m_s2'),
    *('raw_residual_ug', 'residual_ug', 'claimed_sd_ug'),
)
#: Length of a window unless the user says otherwise [s].
WINDOW_S = 60.0
# The sums that windows are made of are no longer than this [s]: the thermal state moves little.
_LONGEST_SUM_S = 10.0
# Less than this beyond a calibrated range, in half ranges, is its edge: thermometers have noise.
_EDGE = 0.02
# A sum of fewer than this part of the usual samples does not last as long.
_LEAST_FILLED = 0.9


@dataclass(frozen=True)
class Windows:
    """
    Windows at rest, of all bags, in order; arrays of n rows.

    Each is `window_s` long, and begins at `start_ns`; `time` is its middle since the bag's first
    sample [s], `count` and `mean` are of its raw samples. A position is a still interval, counted
    through all bags. The rate is the board's [K/s]. Dynamic are those in which the dynamic set
    prevails, inside those that lie inside the calibrated ranges as a whole. `raw` is the specific
    force by the constants at the reference temperature, `force` that by the calibration, shapes
    (n, 3); `claimed_sd` is claimed for the norm of `force`: the calibration's error and the white
    noise of the mean, which is `noise_sd` alone. `gyro` is for `rates` to read: a row of the
    angular rate, raw and corrected, of its claimed variances and of the thermal state; empty
    where the calibration has no gyroscope.
    """

    window_s: float
    gravity: float
    bag: Ints
    position: Ints
    start_ns: Stamps
    time: Floats
    count: Floats
    mean: Floats
    board: Floats
    rate: Floats
    is_dynamic: Bools
    is_inside: Bools
    raw: Floats
    force: Floats
    claimed_sd: Floats
    noise_sd: Floats
    gyro: Floats

    def __len__(self) -> int:
        """Count the windows."""
        return len(self.time)

    def select(self, rows: Bools) -> Windows:
        """Keep some of the windows."""
        kept = {
            one.name: getattr(self, one.name)[rows]
            for one in fields(self)
            if one.name not in ('window_s', 'gravity')
        }
        return replace(self, **kept)

    @cached_property
    def raw_residual(self) -> Floats:
        """``|f| - g`` by the constants alone, shape (n,)."""
        return norm_residual(self.raw, self.gravity)

    @cached_property
    def residual(self) -> Floats:
        """``|f| - g`` by the calibration, shape (n,)."""
        return norm_residual(self.force, self.gravity)


def sum_length(window_s: float) -> float:
    """Choose the longest part of a window up to ten seconds; raises ValueError if not positive."""
    if not 0.0 < window_s < np.inf:
        raise ValueError(f'`window_s` must be positive, got {window_s:g}')
    return window_s / float(np.ceil(window_s / _LONGEST_SUM_S))


def usual_window(bags: Sequence[ReducedBag]) -> float:
    """Choose the length [s] of the windows of a fit's bags: 60 s, or what next their sums fill."""
    longest = max(bag.window_s for bag in bags)
    return float(np.ceil(WINDOW_S / longest - 1e-6)) * longest


def corrected_windows(
    bags: Sequence[ReducedBag],
    calibration: Calibration,
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
    config: CompensatorConfig | None = None,
) -> Windows:
    """
    Correct the windows of bags of the calibration's unit; local gravity is its own by default.

    Raises RecordingError if the samples of a bag are too slow for such windows.
    """
    # A window's mean is no sample: what looks for stuck or too large ones would misread it.
    config = replace(
        config or CompensatorConfig(), stuck_timeout_s=0.0, gravity_tolerance_m_s2=0.0
    )

    def correct(bag: ReducedBag, sums: Floats) -> None:
        _correct(Compensator(calibration, config), bag, sums)

    thermal = Compensator(calibration, config).thermal
    n_gyro = 9 + Layout(thermal.correction.memory).width if thermal.rate_correction else 0
    table = _table(bags, window_s, correct, n_gyro)
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    K, bias = np.array([(axis.scale_factor, axis.bias) for axis in axes]).T
    M = np.array(calibration.misalignment)
    along = table[:, _FORCE] / np.linalg.norm(table[:, _FORCE], axis=1, keepdims=True) @ M
    noise = along**2 @ np.array(thermal.correction.noise)
    # Of a message's noise the rounding is carried on to the next: a mean has none of it.
    white = along**2 @ np.square(calibration.noise_density_m_s2_sqrt_hz)
    mean_white = white / (calibration.unit.cycle_time_s * table[:, _COUNT])
    return _windows(
        bags,
        table,
        window_s,
        calibration.gravity_m_s2 if gravity is None else gravity,
        raw=np.asarray((table[:, _MEAN] - bias) / K @ M.T),
        claimed_sd=np.sqrt(np.maximum(table[:, _VARIANCE] - noise, 0.0) + mean_white),
        noise_sd=np.sqrt(mean_white),
    )


def raw_windows(bags: Sequence[ReducedBag], gravity: float, window_s: float) -> Windows:
    """
    Take the windows as they are: static, inside any range, without a claim.

    Raises RecordingError as `corrected_windows` does; unknown gravity is NaN.
    """

    def keep(bag: ReducedBag, sums: Floats) -> None:
        since = (bag.board.stamp_ns - bag.start_ns) * 1e-9
        sums[:, _BOARD] = np.interp(sums[:, _TIME], since, bag.board.value)
        sums[:, _FORCE] = sums[:, _MEAN]
        sums[:, [_RATE, _WEIGHT, _EXCESS, _VARIANCE]] = 0.0

    table = _table(bags, window_s, keep)
    nothing = np.full(len(table), np.nan)
    return _windows(
        bags, table, window_s, gravity, table[:, _MEAN], claimed_sd=nothing, noise_sd=nothing
    )


def csv_of(windows: Windows, bags: Sequence[str]) -> str:
    """Write windows as CSV with all digits: a line of headings, then one per window."""
    columns = (
        [bags[number] for number in windows.bag.tolist()],
        (windows.position + 1).tolist(),
        windows.start_ns.tolist(),
        windows.time.tolist(),
        [windows.window_s] * len(windows),
        windows.count.astype(int).tolist(),
        windows.board.tolist(),
        (windows.rate * 60.0).tolist(),
        ['dynamic' if dynamic else 'static' for dynamic in windows.is_dynamic.tolist()],
        windows.is_inside.astype(int).tolist(),
        *windows.force.T.tolist(),
        (windows.raw_residual / MICRO_G).tolist(),
        (windows.residual / MICRO_G).tolist(),
        (windows.claimed_sd / MICRO_G).tolist(),
    )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue()


def means_by(labels: Ints, values: Floats) -> Floats:
    """Average rows that have the same label, in the order of the labels."""
    _, place = np.unique(labels, return_inverse=True)
    total = np.zeros((int(place.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(total, place, values)
    return np.asarray(total / np.bincount(place).reshape(-1, *[1] * (values.ndim - 1)))


# Columns of a sum and of a window. Averaged over a window's sums are all from the time on.
_BAG, _POSITION, _START, _COUNT, _EXCESS, _TIME, _BOARD, _RATE, _WEIGHT, _VARIANCE = range(10)
_MEAN, _FORCE, _WIDTH = slice(10, 13), slice(13, 16), 16
# What a calibration with a gyroscope adds: the rate, and what `Windows.gyro` says.
_ANGULAR = slice(_WIDTH, _WIDTH + 3)


def _table(
    bags: Sequence[ReducedBag],
    window_s: float,
    correct: Callable[[ReducedBag, Floats], None],
    n_gyro: int = 0,
) -> Floats:
    """Put the sums of bags together to windows, a row each."""
    parts = [np.zeros((0, _WIDTH + n_gyro))]
    first_position = 0
    for number, bag in enumerate(bags):
        per = max(1, round(window_s / bag.window_s))
        if abs(per * bag.window_s - window_s) > 1e-6 * window_s:
            raise RecordingError(
                f'its samples are too slow for windows of {window_s:g} s: {bag.window_s:g} s or '
                'a multiple of it are needed',
                path=bag.source.name,
            )
        sums = [
            _sums(interval, bag.window_s, interval.n_whole // per * per, n_gyro)
            for interval in bag.intervals
        ]
        for place, one in enumerate(sums):
            one[:, _BAG], one[:, _POSITION] = number, first_position + place
        first_position += len(sums)
        if any(map(len, sums)):
            whole = np.concatenate(sums)
            correct(bag, whole)
            # Messages were lost, or the bag ends within it.
            usual = np.median(whole[:, _COUNT])
            whole[whole[:, _COUNT] < _LEAST_FILLED * usual, _EXCESS] = np.nan
            parts.append(_joined(whole, per))
    return np.concatenate(parts)


def _sums(interval: StillInterval, sum_s: float, n: int, n_gyro: int) -> Floats:
    sums = np.full((n, _WIDTH + n_gyro), np.nan)
    sums[:, _START] = interval.begin_s + sum_s * np.arange(n)
    sums[:, _COUNT] = interval.count[:n]
    sums[:, _TIME] = interval.time[:n]
    sums[:, _MEAN] = interval.mean[:n]
    if n_gyro and interval.angular_rate is not None:
        sums[:, _ANGULAR] = interval.angular_rate[:n]
    return sums


def _joined(sums: Floats, per: int) -> Floats:
    """Join so many sums to a window each; out are those that were not corrected as a whole."""
    grouped = sums.reshape(-1, per, sums.shape[1])
    count = grouped[:, :, _COUNT]
    result = np.array(grouped[:, 0])
    result[:, _COUNT] = count.sum(axis=1)
    result[:, _EXCESS] = grouped[:, :, _EXCESS].max(axis=1)
    share = count / count.sum(axis=1, keepdims=True)
    result[:, _TIME:] = np.einsum('nk,nkc->nc', share, grouped[:, :, _TIME:])
    return np.asarray(result[np.isfinite(result[:, _EXCESS])])


def _windows(
    bags: Sequence[ReducedBag],
    table: Floats,
    window_s: float,
    gravity: float,
    raw: Floats,
    claimed_sd: Floats,
    noise_sd: Floats,
) -> Windows:
    bag = table[:, _BAG].astype(np.int64)
    origin = np.array([one.start_ns for one in bags], dtype=np.int64)
    return Windows(
        window_s=window_s,
        gravity=gravity,
        bag=bag,
        position=table[:, _POSITION].astype(np.int64),
        start_ns=np.rint(table[:, _START] * 1e9).astype(np.int64) + origin[bag],
        time=table[:, _TIME],
        count=table[:, _COUNT],
        mean=table[:, _MEAN],
        board=table[:, _BOARD],
        rate=table[:, _RATE],
        is_dynamic=table[:, _WEIGHT] > 0.5,
        is_inside=table[:, _EXCESS] <= _EDGE,
        raw=raw,
        force=table[:, _FORCE],
        claimed_sd=claimed_sd,
        noise_sd=noise_sd,
        gyro=table[:, _WIDTH:],
    )


def _correct(compensator: Compensator, bag: ReducedBag, sums: Floats) -> None:
    """Run sums through the compensator, with the readings that came before each."""
    names, stamps, values = readings_in_order(bag, compensator.thermal.inputs)
    readings = zip(names, stamps.tolist(), values.tolist(), strict=True)
    reading = next(readings, None)
    for row in sums:
        stamp_ns = bag.start_ns + round(float(row[_TIME]) * 1e9)
        while reading is not None and reading[1] <= stamp_ns:
            compensator.push(*reading)
            compensator.flush(reading[1])
            reading = next(readings, None)
        corrected = compensator.process(stamp_ns, *row[_MEAN].tolist())
        status = take_snapshot(compensator)
        if corrected is None or status.state is None:
            continue
        row[_FORCE] = corrected[:3]
        row[_VARIANCE] = variance_along(corrected[:3], corrected[3:])
        row[_EXCESS] = status.relative_excess
        state = status.state
        row[_BOARD], row[_RATE], row[_WEIGHT] = state.board, state.rate, state.weight
        if compensator.corrects_rate:
            row[_WIDTH + 3 : _WIDTH + 9] = compensator.correct_rate(stamp_ns, *row[_ANGULAR])
            row[_WIDTH + 9 :] = compensator.thermal.tracker.sample(stamp_ns)
