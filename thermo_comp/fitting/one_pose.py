# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what one attitude can tell of a thermal drift: the combination along gravity, and no more.

A sensor that rests in one attitude u (a drone on its gear, a board in a freezer) reads, along u::

    |a|(T) = u . bias(T) + g u' S(T) u

One number over temperature for nine functions: bias and scale of the three axes cannot be told
apart, and what happens across u cannot be told from a mount that tilts. So the result is named
for what it is, is valid for this attitude only, and never becomes a calibration.

The order of the polynomial goes with the temperature span, because on one ramp bending and a
wandering level look alike: below 3 K nothing, below 10 K a line, below 25 K a parabola, then a
cubic. Its uncertainty counts the wander (`wander`).

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..errors import FitError
from ..thermal.settings import DetectorSettings
from ..typing import Bools, Floats
from .branches import Branch, Event, find_branches
from .history import ThermalHistory
from .pose_series import PoseSeries, pose_series
from .reduction import ReducedBag, reduce_source
from .rests import ONE_ATTITUDE_DEG, attitudes_apart, describe, milli_g
from .sensors import learn_detector
from .sources import FitSource
from .wander import Noise, WanderFit, fit_with_wander

#: Temperature span below which nothing is said, and the spans up to which an order is enough [K].
SPAN_NEEDED = 3.0
SPAN_OF_ORDER = ((10.0, 1), (25.0, 2))
_HIGHEST_ORDER = 3
# More windows than this cost time and tell nothing new of so few parameters.
_MOST_WINDOWS = 400
# A bump that is still in a still window is left out of the fit beyond this many robust sd.
_OUTLIER_SDS = 5.0
_CELL_S, _WINDOW_S = 2.0, 10.0


@dataclass(frozen=True)
class PoseOptions:
    """
    Options of a fit to one attitude.

    Parameters
    ----------
    gravity : float or None, optional
        Local gravity; without it the level is given, but not what it is off by.
    input : {'counts', 'm/s^2'}, optional
        Unit of the samples.
    reference_temperature : float, optional
        Where the thermal error is zero by definition; moved into the range that was seen.
    order : int or None, optional
        Order of the polynomial; None takes it from the temperature span.
    samples : int, optional
        Samples per mean.
    min_still_s : float, optional
        Shortest still interval [s].
    full_scale : float or None, optional
        Magnitude of a saturated sample.
    begin_s, end_s : float, optional
        Part of the recording to be used, since its first sample [s].

    Raises
    ------
    ValueError
        If a value is outside its range.

    """

    gravity: float | None = None
    input: Literal['counts', 'm/s^2'] = 'm/s^2'
    reference_temperature: float = 20.0
    order: int | None = None
    samples: int = 25
    min_still_s: float = 5.0
    full_scale: float | None = None
    begin_s: float = -np.inf
    end_s: float = np.inf

    def __post_init__(self) -> None:
        if self.samples < 2:
            raise ValueError(f'`samples` must be at least 2, got {self.samples}')
        if self.order is not None and not 0 <= self.order <= _HIGHEST_ORDER:
            raise ValueError(f'`order` must be within 0..{_HIGHEST_ORDER}, got {self.order}')
        if not self.begin_s < self.end_s:
            raise ValueError(f'`begin_s` must be before `end_s`, got {self.begin_s}')
        if not self.min_still_s > 0.0:
            raise ValueError(f'`min_still_s` must be positive, got {self.min_still_s}')


@dataclass(frozen=True)
class AlongGravity:
    """
    Reading along the specific force over temperature, in one attitude.

    Parameters
    ----------
    direction : tuple of float
        Direction of the specific force in the sensor's axes; valid near it only.
    reference_temperature : float
        T_ref.
    coefficients : tuple of float
        Level at T_ref [input units], then per K, per K^2, ...
    temperature_range : (float, float)
        Seen by the fit; held at its edges outside.
    solution : WanderFit
        The estimates with their covariance and noise, and the times of the data.
    residual_rms : float
        Of the windows of the fit [input units].

    """

    direction: tuple[float, float, float]
    reference_temperature: float
    coefficients: tuple[float, ...]
    temperature_range: tuple[float, float]
    solution: WanderFit
    residual_rms: float

    @property
    def noise(self) -> Noise:
        """
        White noise of a sample and wander of the level.

        """
        return self.solution.noise

    @property
    def order(self) -> int:
        """
        Order of the polynomial.

        """
        return len(self.coefficients) - 1

    def columns(self, temperature: Floats, extend: bool = False) -> Floats:
        """
        Powers of ``T - T_ref``, shape (n, order + 1).

        """
        at = np.asarray(temperature, dtype=np.float64)
        if not extend:
            at = np.clip(at, *self.temperature_range)
        return np.vander(at - self.reference_temperature, self.order + 1, increasing=True)

    def reading(self, temperature: Floats, extend: bool = False) -> Floats:
        """
        Predict ``|a|``.

        Parameters
        ----------
        temperature : ndarray, shape (n,)
            Board temperature.
        extend : bool, optional
            Follow the polynomial beyond the range that was seen, instead of holding its edge.

        Returns
        -------
        ndarray, shape (n,)
            Norm of the reading [input units].

        """
        return np.asarray(self.columns(temperature, extend) @ np.array(self.coefficients))

    def thermal_error(self, temperature: Floats, extend: bool = False) -> Floats:
        """
        Predict what ``|a|`` reads more than at T_ref, shape (n,) [input units].

        """
        return self.reading(temperature, extend) - self.coefficients[0]

    def thermal_error_sd(self, temperature: Floats) -> Floats:
        """
        Predict the sd of `thermal_error` as a curve, shape (n,) [input units].

        """
        columns = self.columns(temperature)[:, 1:]
        covariance = self.solution.covariance[1:, 1:]
        return np.asarray(np.sqrt(np.einsum('np,pq,nq->n', columns, covariance, columns)))


@dataclass(frozen=True)
class BranchFit:
    """
    One branch and what it tells.

    Parameters
    ----------
    branch : Branch
        The run without a step.
    model : AlongGravity or None
        The fit; None where it is refused.
    refusal : str
        Why; empty where it is not.

    """

    branch: Branch
    model: AlongGravity | None
    refusal: str


@dataclass(frozen=True)
class Pose:
    """
    A recording in one attitude, ready to be fitted.

    Parameters
    ----------
    bag : ReducedBag
        Still intervals and temperature readings.
    detector : DetectorSettings
        Learnt from it.
    series : PoseSeries
        Means.
    history : ThermalHistory
        Thermal state behind their temperatures.
    events : tuple of Event
        Steps at rest.
    branches : tuple of Branch
        Runs between them.
    options : PoseOptions
        As given.

    """

    bag: ReducedBag
    detector: DetectorSettings
    series: PoseSeries
    history: ThermalHistory
    events: tuple[Event, ...]
    branches: tuple[Branch, ...]
    options: PoseOptions

    @property
    def milli_g(self) -> float:
        """
        Input units of a thousandth of the reading at rest: of g for m/s^2.

        """
        return milli_g([self.bag], self.options.input)


def read_pose(source: FitSource, options: PoseOptions) -> Pose:
    """
    Reduce a recording in one attitude: still intervals, steps, branches, means.

    Parameters
    ----------
    source : FitSource
        The recording, streamed three times.
    options : PoseOptions
        What to use of it.

    Returns
    -------
    Pose
        Ready to be fitted.

    Raises
    ------
    FitError
        If there are no samples, no board temperature, no still interval, or several attitudes.

    """
    bag = reduce_source(
        source,
        0,
        window_s=_WINDOW_S,
        cell_s=_CELL_S,
        min_still_s=options.min_still_s,
        full_scale=options.full_scale,
    )
    if not bag.n_samples:
        raise FitError(f'{source.name}: no accelerometer samples')
    if not len(bag.board.value):
        raise FitError(f'{source.name}: no board temperature; a thermal fit needs it')
    bag = _clipped(bag, options)
    if not bag.intervals:
        raise FitError(
            f'{source.name}: no still interval of {options.min_still_s:g} s; the unit must rest'
        )
    apart = attitudes_apart([bag])
    if apart > ONE_ATTITUDE_DEG:
        raise FitError(
            f'{source.name}: it rests in several attitudes, {apart:.0f} deg apart: '
            'this fit is for one; `thermo_comp fit` tells bias and scale apart'
        )
    events, branches = find_branches(source, bag)
    detector = learn_detector([bag])
    series, history = pose_series(source, bag, branches, detector, options.samples)
    inside = (series.time >= options.begin_s) & (series.time <= options.end_s)
    return Pose(bag, detector, series.select(inside), history, events, branches, options)


def fit_whole(pose: Pose) -> AlongGravity:
    """
    Fit the whole rest, if nothing but temperature and wander changed it.

    Parameters
    ----------
    pose : Pose
        The recording.

    Returns
    -------
    AlongGravity
        The fit.

    Raises
    ------
    FitError
        If the sensor jumped, was turned or moved, or the temperature span is too small.

    """
    if pose.events:
        raise FitError(
            f'{"; ".join(describe(event, pose.milli_g) for event in pose.events)}: no function of '
            'temperature fits the whole; fit the branches between them'
        )
    if len(pose.branches) > 1:
        ends = ', '.join(f'{branch.end_s:.0f} s' for branch in pose.branches[:-1])
        raise FitError(
            f'it was moved for long after {ends}: nobody knows that it came back to the same '
            'attitude; fit the branches between them'
        )
    return fit_series(pose.series.select(pose.series.branch >= 0), pose.options)


def fit_branches(pose: Pose) -> tuple[BranchFit, ...]:
    """
    Fit each branch by itself.

    Parameters
    ----------
    pose : Pose
        The recording.

    Returns
    -------
    tuple of BranchFit
        In order; a branch that cannot carry a fit says why.

    """
    result = []
    for number, branch in enumerate(pose.branches):
        series = pose.series.select(pose.series.branch == number)
        try:
            result.append(BranchFit(branch, fit_series(series, pose.options), ''))
        except FitError as refusal:
            result.append(BranchFit(branch, None, str(refusal)))
    return tuple(result)


def fit_series(series: PoseSeries, options: PoseOptions) -> AlongGravity:
    """
    Fit the reading along gravity over temperature to one run without a step.

    Parameters
    ----------
    series : PoseSeries
        Its windows; only the still ones are used.
    options : PoseOptions
        Reference temperature and order.

    Returns
    -------
    AlongGravity
        The fit.

    Raises
    ------
    FitError
        If the temperature span or the number of windows is too small.

    """
    still = series.select(series.is_still).coarsened(_MOST_WINDOWS)
    if not len(still.time):
        raise FitError('no still window in this part')
    lower, upper = (float(f(still.temperature)) for f in (np.min, np.max))
    order = order_for(upper - lower) if options.order is None else options.order
    reference = min(max(options.reference_temperature, lower), upper)
    columns = np.vander(still.temperature - reference, order + 1, increasing=True)
    norm = still.norm
    use = _inliers(columns, norm)
    solution = fit_with_wander(columns[use], norm[use], still.time[use], still.count[use])
    left = norm - columns @ solution.parameters
    x, y, z = (float(v) for v in np.average(still.mean, axis=0, weights=still.count))
    size = float(np.sqrt(x * x + y * y + z * z))
    return AlongGravity(
        direction=(x / size, y / size, z / size),
        reference_temperature=reference,
        coefficients=tuple(solution.parameters.tolist()),
        temperature_range=(lower, upper),
        solution=solution,
        residual_rms=float(np.sqrt(np.mean(left**2))),
    )


def order_for(span: float) -> int:
    """
    Order of the polynomial that a temperature span can carry.

    Parameters
    ----------
    span : float
        Highest less lowest temperature [K].

    Returns
    -------
    int
        1, 2 or 3.

    Raises
    ------
    FitError
        If it is below 3 K.

    """
    if span < SPAN_NEEDED:
        raise FitError(
            f'temperature span {span:.1f} degC is too small, need {SPAN_NEEDED:g}: the drift of '
            'the level by itself would be taken for a function of temperature'
        )
    return next((order for limit, order in SPAN_OF_ORDER if span < limit), _HIGHEST_ORDER)


def _clipped(bag: ReducedBag, options: PoseOptions) -> ReducedBag:
    kept = []
    for interval in bag.intervals:
        use = (interval.time >= options.begin_s) & (interval.time <= options.end_s)
        if use.any():
            begin, end = (
                bag.start_ns + round(float(interval.time[use][i]) * 1e9) for i in (0, -1)
            )
            if use.all():
                begin, end = interval.start_ns, interval.end_ns
            kept.append(
                replace(
                    interval,
                    start_ns=begin,
                    end_ns=end,
                    time=interval.time[use],
                    count=interval.count[use],
                    mean=interval.mean[use],
                )
            )
    return replace(bag, intervals=tuple(kept))


def _inliers(columns: Floats, data: Floats) -> Bools:
    parameters = np.linalg.lstsq(columns, data, rcond=None)[0]
    left = data - columns @ parameters
    left = left - np.median(left)
    spread = 1.4826 * float(np.median(np.abs(left)))
    use: Bools = np.abs(left) <= _OUTLIER_SDS * max(spread, 1e-300)
    return use
