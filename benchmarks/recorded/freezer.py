# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what is found in the freezer run: jumps, branches, held-out errors, thermometer and regime.

Times here are those of the log's own clock; the bag's first sample is at 1.5 s of it.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from thermo_comp.fitting.held_out import HeldOut, held_out
from thermo_comp.fitting.one_pose import (
    AlongGravity,
    BranchFit,
    Pose,
    PoseOptions,
    fit_branches,
    fit_series,
    fit_whole,
    read_pose,
)
from thermo_comp.fitting.partial import recording_source

from thermo_comp.errors import FitError
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.sources import FitSource
from thermo_comp.thermal.regime import Regime
from thermo_comp.thermal.settings import DetectorSettings
from thermo_comp.thermal.tracker import ThermalTracker
from thermo_comp.typing import Bools, Floats, Ints

from .data import GRAVITY, freezer_column
from .peers import PEERS, residual

BLOCK_S = 20.0
HOT_C, COLD_C = 36.0, 15.0
#: The first jump; windows of the held-out test end before it.
FIRST_JUMP_S = 364.0
TRAIN_S, TEST_S = (520.0, 1200.0), (1200.0, 1900.0)
WINDOW = 25


@dataclass(frozen=True)
class Freezer:
    """
    The run, reduced.

    Parameters
    ----------
    source : FitSource
        The bag.
    pose : Pose
        Jumps, branches and 25-sample means.
    origin_s : float
        The log's clock at the bag's first sample.
    fits : tuple of BranchFit
        One per branch.
    refusal : str
        Why the whole is not fitted.
    full_refusal : str
        Why ``thermo_comp fit`` does not take it.
    die : ndarray, shape (n,)
        Mean raw reading of the die's thermometer in each 25-sample window.

    """

    source: FitSource
    pose: Pose
    origin_s: float
    fits: tuple[BranchFit, ...]
    refusal: str
    full_refusal: str
    die: Floats

    @property
    def time(self) -> Floats:
        """
        The log's clock at each window [s].

        """
        return self.pose.series.time + self.origin_s

    @property
    def per_mg(self) -> float:
        """
        Input units of a thousandth of g.

        """
        return self.pose.milli_g


def read_freezer(folder: Path, bag: Path) -> Freezer:
    """
    Reduce the run and ask for fits.

    """
    source, _ = recording_source(bag)
    pose = read_pose(source, PoseOptions(gravity=GRAVITY, samples=WINDOW))
    clock = freezer_column(folder, 'now[ms]') * 1e-3
    raw = freezer_column(folder, 'gtemp')
    n = len(raw) // WINDOW
    means = [column[: n * WINDOW].reshape(n, WINDOW).mean(axis=1) for column in (clock, raw)]
    origin_s = float(clock[0])
    return Freezer(
        source=source,
        pose=pose,
        origin_s=origin_s,
        fits=fit_branches(pose),
        refusal=_refusal(lambda: fit_whole(pose)),
        full_refusal=_refusal(lambda: fit([source], FitOptions(gravity=GRAVITY, input='m/s^2'))),
        die=np.interp(pose.series.time + origin_s, *means),
    )


def _refusal(attempt: Callable[[], object]) -> str:
    try:
        attempt()
    except FitError as refused:
        return str(refused)
    return ''


@dataclass(frozen=True)
class Split:
    """
    One way to divide the run: pairs of (training, test) windows.

    """

    name: str
    folds: tuple[tuple[Bools, Bools], ...]


def interleaved(freezer: Freezer, shift_s: float = 0.0) -> Split:
    """
    Take 20 s blocks in turn while the die falls from 36 to 15 degC.

    """
    hot = (freezer.pose.series.branch == 0) & (freezer.time < FIRST_JUMP_S)
    hot &= (freezer.die <= HOT_C) & (freezer.die >= COLD_C)
    odd = ((freezer.time + shift_s) // BLOCK_S) % 2 == 1
    return Split('interleaved 20 s blocks', ((hot & ~odd, hot & odd), (hot & odd, hot & ~odd)))


def forecast(freezer: Freezer) -> Split:
    """
    Train on 520..1200 s, predict 1200..1900 s.

    """
    time = freezer.time
    train, test = ((time > low) & (time < high) for low, high in (TRAIN_S, TEST_S))
    return Split('520..1200 s to 1200..1900 s', ((train, test),))


def ours(
    freezer: Freezer, split: Split, extend: bool, order: int | None = None
) -> tuple[HeldOut, list[AlongGravity]]:
    """
    Fit and judge on each fold, pooled.

    """
    options = replace(freezer.pose.options, order=order)
    pooled: HeldOut | None = None
    models = []
    for train, test in split.folds:
        model = fit_series(freezer.pose.series.select(train), options)
        found = held_out(model, freezer.pose.series, test, extend)
        pooled = found if pooled is None else pooled + found
        models.append(model)
    if pooled is None:
        raise ValueError('`split` must have a fold')
    return pooled, models


def peers(freezer: Freezer, split: Split, extend: bool) -> dict[str, float]:
    """
    RMS of each peer on the same folds [mg]; trained on the same still windows.

    """
    series = freezer.pose.series
    result = {}
    for name, peer in PEERS.items():
        parts = []
        for train, test in split.folds:
            use = train & series.is_still
            parts.append(
                residual(
                    peer,
                    (series.mean[use], series.temperature[use]),
                    (series.mean[test], series.temperature[test]),
                    extend,
                )
            )
        result[name] = float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) / freezer.per_mg
    return result


def peers_on_the_whole(freezer: Freezer) -> dict[str, tuple[float, float]]:
    """
    RMS and largest residual of each peer fitted over all jumps, in sample [mg].

    """
    series = freezer.pose.series
    use = series.is_still & (series.branch >= 0)
    data = (series.mean[use], series.temperature[use])
    result = {}
    for name, peer in PEERS.items():
        left = residual(peer, data, data, extend=False) / freezer.per_mg
        result[name] = (float(np.sqrt(np.mean(left**2))), float(np.max(np.abs(left))))
    return result


@dataclass(frozen=True)
class Tracked:
    """
    What the node would have known, reading by reading.

    Parameters
    ----------
    time : ndarray, shape (n,)
        The log's clock [s].
    reading, estimate, sd : ndarray, shape (n,)
        The die's thermometer: raw, estimated, and the sd claimed for the estimate.
    reference : ndarray, shape (n,)
        Parabolas through 20 s of readings around each: knows the future.
    rate : ndarray, shape (n,)
        Estimated rate [K/min].
    case : ndarray, shape (n,)
        The air's estimate.
    regime : ndarray of int, shape (n,)
        The flag.

    """

    time: Floats
    reading: Floats
    estimate: Floats
    sd: Floats
    reference: Floats
    rate: Floats
    case: Floats
    regime: Ints

    def errors(self, low_s: float, high_s: float) -> tuple[float, float, float, float]:
        """
        RMS of reading and estimate, RMS of the sd, largest error, all against the reference [K].

        """
        part = (self.time >= low_s) & (self.time < high_s)
        raw, estimated = (
            values[part] - self.reference[part] for values in (self.reading, self.estimate)
        )
        rms = [float(np.sqrt(np.mean(v**2))) for v in (raw, estimated, self.sd[part])]
        return rms[0], rms[1], rms[2], float(np.max(np.abs(estimated)))

    def slope(self, low_s: float, high_s: float) -> float:
        """
        Straight line through the raw readings of a part [K/min].

        """
        part = (self.time >= low_s) & (self.time < high_s)
        line = np.polynomial.polynomial.polyfit(self.time[part] - low_s, self.reading[part], 1)
        return float(line[1]) * 60.0

    def switches(self) -> list[tuple[float, str]]:
        """
        When the flag changed, and to what.

        """
        at = np.flatnonzero(np.diff(self.regime)) + 1
        return [(float(self.time[i]), Regime(int(self.regime[i])).name.lower()) for i in at]


def track(freezer: Freezer, detector: DetectorSettings | None = None) -> Tracked:
    """
    Run the node's thermal tracker over the run's readings, in their order.

    """
    bag = freezer.pose.bag
    tracker = ThermalTracker(detector or freezer.pose.detector)
    readings = [
        (stamp, is_case, value)
        for is_case, sensor in enumerate((bag.board, bag.case))
        for stamp, value in zip(sensor.stamp_ns, sensor.value, strict=True)
    ]
    rows = []
    for stamp, is_case, value in sorted(readings):
        if is_case:
            tracker.read('case', int(stamp), float(value))
            continue
        tracker.read('board', int(stamp), float(value))
        board = tracker.board
        rows.append(
            (
                (int(stamp) - bag.start_ns) * 1e-9 + freezer.origin_s,
                float(value),
                board.temperature,
                np.sqrt(board.var_temperature),
                board.rate * 60.0,
                tracker.case.temperature,
                float(tracker.detector.regime),
            )
        )
    time, reading, estimate, sd, rate, case, regime = np.array(rows).T
    return Tracked(
        time=time,
        reading=reading,
        estimate=estimate,
        sd=sd,
        reference=_centred(time, reading, 10.0),
        rate=rate,
        case=case,
        regime=regime.astype(np.int64),
    )


def _centred(time: Floats, values: Floats, half_s: float) -> Floats:
    """
    Fit a parabola to the readings around each time.

    """
    result = np.empty(len(values))
    low = np.searchsorted(time, time - half_s)
    high = np.searchsorted(time, time + half_s, side='right')
    for i, (first, last) in enumerate(zip(low, high, strict=True)):
        at = time[first:last] - time[i]
        result[i] = np.polynomial.polynomial.polyfit(at, values[first:last], 2)[0]
    return result


def coarser(detector: DetectorSettings, relaxed_k_min: float) -> DetectorSettings:
    """
    Ask for less stillness before a soak counts as static.

    """
    return replace(
        detector, relaxed_rate_k_min=relaxed_k_min, smallest_ramp_k_min=4.0 * relaxed_k_min
    )
