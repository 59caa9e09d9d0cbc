# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the windows that a judgement rests on: means at rest of exactly the stated length.

A window is a run of whole sums of one still interval. Its mean goes through the compensator as a
sample does, with the readings that came before it, so that force, covariance and regime are the
node's; what is kept of a bag of any length is a row per window.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from ..errors import RecordingError
from ..fitting.reduction import ReducedBag
from ..online.compensator import Compensator
from ..online.snapshot import take_snapshot
from ..online.status import CompensatorConfig
from ..typing import Bools, Floats, Ints, Stamps
from ..unit.calibration import Calibration
from ..unit.metrics import norm_residual

#: Length of a window unless the user says otherwise [s].
WINDOW_S = 60.0
# The sums that windows are made of are no longer than this [s]: the thermal state moves little.
_LONGEST_SUM_S = 10.0
# Less than this beyond a calibrated range, in half ranges, is its edge: thermometers have noise.
_EDGE = 0.02


@dataclass(frozen=True)
class Windows:
    """
    Windows at rest, of all bags, in order.

    Parameters
    ----------
    window_s, gravity : float
        Length of each [s], and local gravity where they were recorded.
    bag, position : ndarray of int64, shape (n,)
        Number of the bag, and of the still interval, counted through all bags.
    start_ns : ndarray of int64, shape (n,)
        Stamp at which the window begins.
    time : ndarray, shape (n,)
        Its middle since the bag's first sample [s].
    count : ndarray, shape (n,)
        Samples in it.
    mean : ndarray, shape (n, 3)
        Mean of the raw samples.
    board, rate : ndarray, shape (n,)
        Board temperature and its rate [K/s].
    is_dynamic, is_inside : ndarray of bool, shape (n,)
        Whether the dynamic set prevails; whether all of it lies inside the calibrated ranges.
    raw, force : ndarray, shape (n, 3)
        Specific force by the constants at the reference temperature, and by the calibration.
    claimed_sd : ndarray, shape (n,)
        Standard deviation claimed for the norm of `force`: the calibration's error and the white
        noise of the mean.
    noise_sd : ndarray, shape (n,)
        The white noise alone.

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

    def __len__(self) -> int:
        """
        Count the windows.

        """
        return len(self.time)

    def select(self, rows: Bools) -> Windows:
        """
        Keep some of the windows.

        """
        kept = {
            one.name: getattr(self, one.name)[rows]
            for one in fields(self)
            if one.name not in ('window_s', 'gravity')
        }
        return replace(self, **kept)

    @cached_property
    def raw_residual(self) -> Floats:
        """
        ``|f| - g`` by the constants alone, shape (n,).

        """
        return norm_residual(self.raw, self.gravity)

    @cached_property
    def residual(self) -> Floats:
        """
        ``|f| - g`` by the calibration, shape (n,).

        """
        return norm_residual(self.force, self.gravity)


def sum_length(window_s: float) -> float:
    """
    Choose the length of the sums that windows are put together from.

    Parameters
    ----------
    window_s : float
        Length of a window [s].

    Returns
    -------
    float
        The longest part of it up to ten seconds, for `fitting.reduction`.

    Raises
    ------
    ValueError
        If `window_s` is not positive.

    """
    if not 0.0 < window_s < np.inf:
        raise ValueError(f'`window_s` must be positive, got {window_s:g}')
    return window_s / float(np.ceil(window_s / _LONGEST_SUM_S))


def whole_windows(bag: ReducedBag, window_s: float) -> Iterator[tuple[int, slice, int]]:
    """
    Find the windows in a reduced bag.

    Parameters
    ----------
    bag : ReducedBag
        The bag.
    window_s : float
        Length of a window [s].

    Yields
    ------
    (int, slice, int)
        Number of the still interval, its sums that fill windows, and sums per window.

    Raises
    ------
    RecordingError
        If a window is no whole number of the bag's sums.

    """
    per = max(1, round(window_s / bag.window_s))
    if abs(per * bag.window_s - window_s) > 1e-6 * window_s:
        raise RecordingError(
            f'its samples are too slow for windows of {window_s:g} s: {bag.window_s:g} s or a '
            'multiple of it are needed',
            path=bag.source.name,
        )
    for number, interval in enumerate(bag.intervals):
        yield number, slice(0, interval.n_whole // per * per), per


def corrected_windows(
    bags: Sequence[ReducedBag],
    calibration: Calibration,
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
    config: CompensatorConfig | None = None,
) -> Windows:
    """
    Correct the windows of bags.

    Parameters
    ----------
    bags : sequence of ReducedBag
        Bags of the calibration's unit.
    calibration : Calibration
        The calibration.
    gravity : float or None, optional
        Local gravity where they were recorded; the calibration's by default.
    window_s : float, optional
        Length of a window [s].
    config : CompensatorConfig or None, optional
        The node's settings.

    Returns
    -------
    Windows
        Empty where nothing rests for as long with a temperature.

    Raises
    ------
    RecordingError
        If the samples of a bag are too slow for such windows.

    """
    # A window's mean is no sample: what looks for stuck or too large ones would misread it.
    config = replace(
        config or CompensatorConfig(), stuck_timeout_s=0.0, gravity_tolerance_m_s2=0.0
    )
    parts: list[Floats] = []
    first_position = 0
    for number, bag in enumerate(bags):
        parts += _of_bag(bag, number, first_position, calibration, config, window_s)
        first_position += len(bag.intervals)
    table = np.concatenate(parts) if parts else np.zeros((0, _WIDTH))
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    K = np.array([axis.scale_factor for axis in axes])
    bias = np.array([axis.bias for axis in axes])
    M = np.array(calibration.misalignment)
    count, mean, force = table[:, _COUNT], table[:, _MEAN], table[:, _FORCE]
    along = force / np.linalg.norm(force, axis=1, keepdims=True) @ M
    white = along**2 @ np.array(Compensator(calibration, config).correction.noise)
    sd = np.sqrt(np.maximum(table[:, _VARIANCE] - white, 0.0) + white / count)
    starts = [
        bag.start_ns + np.rint(table[table[:, _BAG] == i, _START] * 1e9).astype(np.int64)
        for i, bag in enumerate(bags)
    ]
    return Windows(
        window_s=window_s,
        gravity=calibration.gravity_m_s2 if gravity is None else gravity,
        bag=table[:, _BAG].astype(np.int64),
        position=table[:, _POSITION].astype(np.int64),
        start_ns=np.concatenate(starts) if starts else np.zeros(0, np.int64),
        time=table[:, _TIME],
        count=count,
        mean=mean,
        board=table[:, _BOARD],
        rate=table[:, _RATE],
        is_dynamic=table[:, _WEIGHT] > 0.5,
        is_inside=table[:, _EXCESS] <= _EDGE,
        raw=np.asarray((mean - bias) / K @ M.T),
        force=force,
        claimed_sd=sd,
        noise_sd=np.sqrt(white / count),
    )


# Columns of a row; averaged over a window's sums but for the first two and the excess.
_BAG, _POSITION, _COUNT, _START, _TIME, _BOARD, _RATE, _WEIGHT, _EXCESS, _VARIANCE = range(10)
_MEAN, _FORCE, _WIDTH = slice(10, 13), slice(13, 16), 16


def _of_bag(
    bag: ReducedBag,
    number: int,
    first_position: int,
    calibration: Calibration,
    config: CompensatorConfig,
    window_s: float,
) -> Iterator[Floats]:
    compensator = Compensator(calibration, config)
    readings = _Readings(bag)
    for place, rows, per in whole_windows(bag, window_s):
        interval = bag.intervals[place]
        sums = np.full((rows.stop, _WIDTH), np.nan)
        sums[:, _BAG], sums[:, _POSITION] = number, first_position + place
        sums[:, _COUNT], sums[:, _TIME] = interval.count[rows], interval.time[rows]
        sums[:, _START] = interval.begin_s + bag.window_s * np.arange(rows.stop)
        sums[:, _MEAN] = interval.mean[rows]
        for row, mean in zip(sums, interval.mean[rows].tolist(), strict=True):
            stamp_ns = bag.start_ns + round(row[_TIME] * 1e9)
            readings.until(compensator, stamp_ns)
            corrected = compensator.process(stamp_ns, *mean)
            status = take_snapshot(compensator)
            if corrected is None or status.state is None:
                continue
            state = status.state
            row[_FORCE] = corrected[:3]
            row[_BOARD], row[_RATE], row[_WEIGHT] = state.board, state.rate, state.weight
            row[_EXCESS] = status.relative_excess
            row[_VARIANCE] = _along(corrected[:3], corrected[3:])
        yield _joined(sums, per)


def _joined(sums: Floats, per: int) -> Floats:
    """
    Put sums together to windows, leaving out those that were not corrected as a whole.

    """
    grouped = sums.reshape(-1, per, _WIDTH)
    count = grouped[:, :, _COUNT]
    share = count / count.sum(axis=1, keepdims=True)
    result = np.einsum('nk,nkc->nc', share, grouped)
    result[:, [_BAG, _POSITION, _START]] = grouped[:, 0, [_BAG, _POSITION, _START]]
    result[:, _COUNT] = count.sum(axis=1)
    result[:, _EXCESS] = grouped[:, :, _EXCESS].max(axis=1)
    return np.asarray(result[np.isfinite(result[:, _EXCESS])])


def _along(force: Sequence[float], covariance: Sequence[float]) -> float:
    """
    Project a covariance xx, xy, xz, yy, yz, zz on the direction of a force.

    """
    x, y, z = force
    xx, xy, xz, yy, yz, zz = covariance
    square = x * x * xx + y * y * yy + z * z * zz + 2.0 * (x * y * xy + x * z * xz + y * z * yz)
    return square / (x * x + y * y + z * z)


class _Readings:
    """
    Hands a bag's readings to a compensator as their stamps come due, the board's first.

    """

    def __init__(self, bag: ReducedBag) -> None:
        stamps = np.concatenate((bag.board.stamp_ns, bag.case.stamp_ns))
        values = np.concatenate((bag.board.value, bag.case.value))
        is_case = np.repeat((False, True), (len(bag.board.value), len(bag.case.value)))
        order = np.argsort(stamps, kind='stable')
        columns = (stamps[order].tolist(), values[order].tolist(), is_case[order].tolist())
        self._all = list(zip(*columns, strict=True))
        self._next = 0

    def until(self, compensator: Compensator, stamp_ns: int) -> None:
        """
        Let all readings up to a stamp take effect.

        """
        while self._next < len(self._all) and self._all[self._next][0] <= stamp_ns:
            reading_ns, value, is_case = self._all[self._next]
            (compensator.push_case if is_case else compensator.push_board)(reading_ns, value)
            compensator.flush(reading_ns)
            self._next += 1
