# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the state of a test during recording: its positions, the expected accuracy, missing data.

Blocks of samples are added in the order of arrival. A rest whose force direction differs from the
direction of the present position begins the next position, which has no earlier samples.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..fitting import coverage
from ..fitting.unknowns import misalignment_scale
from ..recording.blocks import Block, Readings
from ..recording.overview import ThermometerSurvey, survey_thermometer, thermal_findings
from ..recording.stillness import CellAccumulator, Cells, still_intervals
from ..typing import Floats, Ints
from ..unit.gravity import STANDARD_GRAVITY

# Minimum length of a rest [s], unless the wanted soak is shorter.
_REST_S = 10.0
# Shortest length of a cell [s]; number of first samples whose interval gives the cells' length.
_CELL_S, _SAMPLES_TO_BEGIN = 0.5, 30
# Number of earlier cells that each search for rests includes, besides the new cells.
_LOOKED_BACK = 200
# Sd of a position's mean force due to hysteresis, mounting and drift, even in a long rest [g].
_FLOOR_SD = 2e-5
# A position is 'restless' if its noise is above `_RESTLESS` times the median of all positions.
# A still interval after the known rests is a rest if its noise is below `_NOISIEST` times the
# noise of the known rests.
_RESTLESS, _NOISIEST = 3.0, 10.0
# Smallest backward step of the stamps that shows a restart of the driver [ns].
_STEP_BACK_NS = 10**9
# A stamp earlier than any stamp of a sample [ns].
_FIRST_NS = -(1 << 62)

Surveys = Mapping[str, ThermometerSurvey]


@dataclass(frozen=True)
class Position:
    """
    A position: direction of the specific force (NaN before the first rest), total time at rest,
    number of rests, sd of the mean force [g], thermometers, why the position is not good, or ''.
    """

    up: Floats
    still_s: float
    n_rests: int
    sd_g: float
    thermometers: Surveys
    reason: str


@dataclass(frozen=True)
class Account:
    """
    State of a test, and the missing data.
    The last of the `positions` is unfinished. `worst_sd_g` is the sd of the corrected force in
    the attitude with the largest sd; `constants_sd` are the sds of bias [g], scale and
    misalignment [rad]. `now` is the direction of the newest samples, NaN without samples.
    `next_up` is the direction recommended for the next position, `next_deg` the angle between
    `next_up` and `now` [deg]. `farthest_up` is the direction with the largest angle to the nearest
    position, `farthest_deg` this angle [deg].
    """

    positions: tuple[Position, ...]
    n_good: int
    is_complete: bool
    worst_sd_g: float
    constants_sd: Floats
    next_up: Floats
    next_deg: float
    farthest_up: Floats
    farthest_deg: float
    thermometers: Surveys
    now: Floats
    is_still: bool
    findings: tuple[str, ...]


@dataclass(frozen=True)
class _Rest:
    """Statistics of a position: its samples at rest, in input units, and its thermometers."""

    surveys: Surveys
    mean: Floats = field(default_factory=lambda: np.full(3, np.nan))
    noise: float = math.nan
    n: int = 0
    still_s: float = 0.0
    n_rests: int = 0


class Acquisition:
    """A running test; `soak_s`: wanted time at rest per position [s], `offset`: reading at 0 g."""

    def __init__(self, n_positions: int, soak_s: float, offset: float = 0.0) -> None:
        self._n_wanted, self._soak_s, self._offset = n_positions, soak_s, offset
        self._rest_s = min(_REST_S, soak_s)
        self._rests: list[_Rest] = []
        self._centre = np.zeros(3)
        self._start()

    def _start(self) -> None:
        """Restart the search for rests; the stamps of the next samples may be of another clock."""
        self._accumulator = CellAccumulator(_CELL_S, None)
        # Stamps and samples until `_SAMPLES_TO_BEGIN` samples have arrived, None afterwards.
        self._held: list[tuple[Ints, Floats]] | None = []
        self._readings: dict[str, list[Readings]] = {}
        #: Earliest stamp at which the next position can begin [ns].
        self.settled_ns = self._newest_ns = self._begin_ns = _FIRST_NS
        self._n_looked = 0
        # Mean sample of the first rest of the position. A later search may miss this rest, because
        # the limit of the variance follows from the quietest tenth of the cells searched.
        self._first: Floats | None = None

    def add(self, block: Block) -> list[int]:
        """Take a block of samples; return the stamps [ns] at which further positions begin."""
        for name, readings in block.temperatures.items():
            self._readings.setdefault(name, []).append(readings)
        if not len(block):
            return []
        begins: list[int] = []
        stamp_ns, samples = block.accel_stamp_ns, block.accel - self._offset
        if self._newest_ns - int(stamp_ns[0]) > _STEP_BACK_NS:
            self.begin()
            begins.append(int(stamp_ns[0]))
        self._newest_ns = int(stamp_ns[-1])
        if block.imu is not None:
            samples = np.hstack([samples, block.imu.angular_velocity])
        if self._held is not None:
            self._held.append((stamp_ns, samples))
            stamp_ns, samples = (np.concatenate(part) for part in zip(*self._held, strict=True))
        if len(stamp_ns) >= _SAMPLES_TO_BEGIN or self._held is None:
            self._held = None
            rates = samples[:, 3:] if samples.shape[1] > 3 else None
            self._accumulator.add(stamp_ns, samples[:, :3], rates)
        cells = self._cells()
        while (begin_ns := self._next_position_ns(cells)) is not None:
            begins.append(max(begin_ns, self.settled_ns))
            self._close(begins[-1])
            self._accumulator.forget(begins[-1])
            cells = self._cells()
        margin_ns = round((self._rest_s + 3.0 * max(cells.cell_s, _CELL_S)) * 1e9)
        self.settled_ns = max(self.settled_ns, self._newest_ns - margin_ns)
        return begins

    def begin(self) -> None:
        """End the present position; the stamps of later blocks may be of another clock."""
        self._close(-_FIRST_NS)
        self._start()

    def _cells(self) -> Cells:
        cells = self._accumulator.cells()
        begin_s = (self._begin_ns - cells.start_ns) * 1e-9
        return cells.part(slice(int(np.searchsorted(cells.time, begin_s)), None))

    def _next_position_ns(self, cells: Cells) -> int | None:
        """Return the stamp at which a rest in another direction begins [ns], or None."""
        n_looked, self._n_looked = self._n_looked, len(cells.count)
        cells = cells.part(slice(max(n_looked - _LOOKED_BACK, 0), None))
        ranges = still_intervals(cells, self._rest_s)
        if not ranges:
            return None
        # Search the cells after the last rest again, with a variance limit from these cells alone.
        end = ranges[-1][1]
        later = cells.part(slice(end, None))
        ranges += [
            (end + lower, end + upper)
            for lower, upper in still_intervals(later, self._rest_s)
            if _noise(later, [(lower, upper)]) < _NOISIEST * _noise(cells, ranges)
        ]
        means = np.array([_mean(cells, [bounds]) for bounds in ranges])
        if self._first is None:
            self._first = means[0]
        ups = self._directions(means)
        up = self._directions(self._first[None])[0]
        is_elsewhere = ups @ up < math.cos(math.radians(coverage.SAME_DIRECTION_DEG))
        if not is_elsewhere.any():
            return None
        lower = ranges[int(np.argmax(is_elsewhere))][0]
        return cells.start_ns + round(float(cells.index[lower]) * cells.cell_s * 1e9)

    def _close(self, end_ns: int) -> None:
        """End the present position at a stamp [ns]; later samples belong to the next position."""
        self._rests.append(self._rest(self._cells(), end_ns))
        for name, parts in self._readings.items():
            later = (_part(part, end_ns, -_FIRST_NS) for part in parts)
            self._readings[name] = [part for part in later if len(part.stamp_ns)]
        self._begin_ns, self._n_looked, self._first = end_ns, 0, None
        means = np.array([rest.mean for rest in self._rests if rest.n_rests]).reshape(-1, 3)
        self._centre = coverage.rough_centre(means)

    def _rest(self, cells: Cells, end_ns: int) -> _Rest:
        """Combine the rests of the present position that end before `end_ns`."""
        surveys = {
            name: survey
            for name, parts in self._readings.items()
            if (survey := survey_thermometer([_part(part, _FIRST_NS, end_ns) for part in parts]))
        }
        end_s = (end_ns - cells.start_ns) * 1e-9 - 0.5 * cells.cell_s
        cells = cells.part(slice(int(np.searchsorted(cells.time, end_s))))
        ranges = still_intervals(cells, self._rest_s)
        if not ranges:
            return _Rest(surveys)
        return _Rest(
            surveys,
            mean=_mean(cells, ranges),
            noise=_noise(cells, ranges),
            n=int(sum(cells.count[a:b].sum() for a, b in ranges)),
            still_s=cells.cell_s * sum(b - a for a, b in ranges),
            n_rests=len(ranges),
        )

    def _directions(self, means: Floats) -> Floats:
        return coverage.directions(means, self._centre)

    def account(self) -> Account:
        """Return the state of the test, and the missing data."""
        cells = self._cells()
        rests = [*self._rests, self._rest(cells, -_FIRST_NS)]
        means = np.array([rest.mean for rest in rests])
        ups = self._directions(means)
        one_g = np.sum((means - self._centre) * ups, axis=1)
        noise = np.array([rest.noise for rest in rests]) / one_g
        median = float(np.median(noise[np.isfinite(noise)])) if np.isfinite(noise).any() else 0.0
        mean_sd = noise / np.sqrt([max(rest.n, 1) for rest in rests])
        density = mean_sd * np.sqrt([rest.still_s for rest in rests])
        density = density[np.isfinite(density)] * STANDARD_GRAVITY
        misalignment_sd = misalignment_scale(float(np.median(density)) if len(density) else 0.0)
        sds = np.hypot(mean_sd, _FLOOR_SD)
        # Rounding hides the noise if it is far below a count: the median may then be 0.
        ratios = noise / (median or 1.0)
        positions: list[Position] = []
        for up, rest, ratio, sd in zip(ups, rests, ratios, sds.tolist(), strict=True):
            reason = self._reason(rest, up, ratio, positions)
            positions.append(Position(up, rest.still_s, rest.n_rests, sd, rest.surveys, reason))
        known = [position for position in positions if np.isfinite(position.up).all()]
        ups = np.array([position.up for position in known]).reshape(-1, 3)
        sds = np.array([position.sd_g for position in known])
        covariance = coverage.constants_covariance(ups, sds, misalignment_sd)
        next_up = coverage.next_direction(covariance, known[-1].sd_g if known else _FLOOR_SD, ups)
        now, is_still = self._now(cells)
        farthest_up, farthest_deg = coverage.farthest(ups)
        n_good = sum(not position.reason for position in positions)
        thermometers = _combined_surveys([rest.surveys for rest in rests])
        missing = self._n_wanted - n_good
        findings = [f'positions missing: {missing} of {self._n_wanted}'] * (missing > 0)
        return Account(
            tuple(positions),
            n_good,
            n_good >= self._n_wanted,
            coverage.worst_sd(covariance),
            np.sqrt(np.diag(covariance)),
            next_up,
            float(np.degrees(np.arccos(np.clip(now @ next_up, -1.0, 1.0)))),
            farthest_up,
            farthest_deg,
            thermometers,
            now,
            is_still,
            (*findings, *thermal_findings(thermometers)),
        )

    def _reason(self, rest: _Rest, up: Floats, ratio: float, before: Sequence[Position]) -> str:
        """Return why a position is not good, '' if good; `ratio`: noise / median of positions."""
        if not rest.n_rests:
            return 'not at rest yet'
        if np.isnan(up).any():
            return 'all axes read zero'
        if ratio > _RESTLESS:
            return 'restless'
        near = math.cos(math.radians(coverage.SAME_DIRECTION_DEG))
        for number, earlier in enumerate(before, 1):
            if not earlier.reason and float(earlier.up @ up) > near:
                return f'repeats position {number}'
        if rest.still_s < self._soak_s:
            is_last = len(before) == len(self._rests)
            minutes = self._soak_s / 60.0
            soak = f'{minutes:.4g} min' if minutes > 1.5 else f'{self._soak_s:g} s'
            return f'keep at rest for {soak}' if is_last else f'left before {soak}'
        return ''

    def _now(self, cells: Cells) -> tuple[Floats, bool]:
        if not len(cells.count):
            return np.full(3, np.nan), False
        cells = cells.part(slice(-_LOOKED_BACK, None))
        ranges = still_intervals(cells, 0.0)
        # The last cell may be incomplete: take rest and direction from the cell before it.
        is_still = bool(ranges) and ranges[-1][1] >= len(cells.count) - 1
        last = cells.mean[-2:-1] if len(cells.count) > 1 else cells.mean
        return self._directions(last)[0], is_still


def _noise(cells: Cells, ranges: Sequence[tuple[int, int]]) -> float:
    variance = np.median(np.concatenate([cells.variance[a:b] for a, b in ranges]), axis=0)
    return float(np.sqrt(variance.mean()))


def _mean(cells: Cells, ranges: Sequence[tuple[int, int]]) -> Floats:
    rows = np.concatenate([np.arange(a, b) for a, b in ranges])
    return np.asarray(np.average(cells.mean[rows], axis=0, weights=cells.count[rows]))


def _part(readings: Readings, begin_ns: int, end_ns: int) -> Readings:
    return readings.take((readings.stamp_ns >= begin_ns) & (readings.stamp_ns < end_ns))


def _combined_surveys(surveys: Sequence[Surveys]) -> Surveys:
    names = dict.fromkeys(name for position in surveys for name in position)
    by_name = {name: [some[name] for some in surveys if name in some] for name in names}
    return {
        name: replace(
            parts[-1],
            n=sum(part.n for part in parts),
            lowest=min(part.lowest for part in parts),
            highest=max(part.highest for part in parts),
            steepest_heating_k_min=max(part.steepest_heating_k_min for part in parts),
            steepest_cooling_k_min=min(part.steepest_cooling_k_min for part in parts),
        )
        for name, parts in by_name.items()
    }
