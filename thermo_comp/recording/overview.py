# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the look at a recording before a fit: how long, how fast, how warm, how still, how whole.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..thermal.settings import ADVISED_SPAN_K, RAMP_K_MIN
from .columns import Block, Readings, RecordingInfo
from .reader import open_recording
from .stillness import CellAccumulator, still_intervals
from .topics import Topics

# A ramp's rate is that of the board over so long.
_RAMP_WINDOW_S = 120.0
_CELL_S, _MIN_REST_S = 0.5, 3.0
# A pause of this many usual intervals is a gap.
_GAP_INTERVALS = 5.0


@dataclass(frozen=True)
class ThermometerSurvey:
    """One thermometer: degC, largest mean rates over two minutes, smallest step of readings."""

    n: int
    rate_hz: float
    lowest: float
    highest: float
    steepest_heating_k_min: float
    steepest_cooling_k_min: float
    quantum: float

    @property
    def span(self) -> float:
        """Highest minus lowest."""
        return self.highest - self.lowest


@dataclass
class Survey:
    """
    What a recording holds, as far as a fit is concerned.

    Gaps are pauses of more than five usual intervals; `n_backwards` counts samples whose stamp
    does not rise; still intervals last at least 3 s, `still_s` together.
    """

    info: RecordingInfo
    n: int = 0
    n_gaps: int = 0
    longest_gap_s: float = 0.0
    n_backwards: int = 0
    n_not_finite: int = 0
    n_still: int = 0
    still_s: float = 0.0
    thermometers: Mapping[str, ThermometerSurvey] = field(default_factory=dict)
    _step_ns: float = 0.0
    _first_ns: int = 0
    _last_ns: int = 0

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return (self._last_ns - self._first_ns) * 1e-9

    @property
    def rate_hz(self) -> float:
        """By the usual interval; NaN where there is none."""
        return 1e9 / self._step_ns if self._step_ns else float('nan')

    def add(self, block: Block) -> None:
        """Count the samples, their gaps and their disorder while they stream by."""
        stamp_ns = block.accel_stamp_ns
        self.n_not_finite += int((~np.isfinite(block.accel).all(axis=1)).sum())
        if len(stamp_ns) and not self.n:
            self._first_ns = self._last_ns = int(stamp_ns[0])
            self.n, stamp_ns = 1, stamp_ns[1:]
        if not len(stamp_ns):
            return
        steps = np.diff(stamp_ns, prepend=self._last_ns)
        self.n += len(stamp_ns)
        self._last_ns = int(stamp_ns[-1])
        rising = steps[steps > 0]
        self.n_backwards += len(steps) - len(rising)
        if not self._step_ns and len(rising):
            self._step_ns = float(np.median(rising))
        gaps = rising[rising > _GAP_INTERVALS * self._step_ns]
        self.n_gaps += len(gaps)
        self.longest_gap_s = max(self.longest_gap_s, float(np.max(gaps, initial=0)) * 1e-9)

    @property
    def findings(self) -> list[str]:
        """What stands between this recording and a fit, each with the next step."""
        said = (
            (self.info.truncated, f'cut off: {self.info.truncated}'),
            (
                not self.n,
                'no accelerometer samples: record accel/counts or imu/uncompensated, or name '
                'yours with --topic counts=TOPIC or --topic imu=TOPIC',
            ),
            *((True, one) for one in thermal_findings(self.thermometers)),
            (
                self.n and not self.n_still,
                'it never rests for 3 s: the fit works on positions at rest',
            ),
            (
                self.n_backwards,
                f'{self.n_backwards} stamps do not rise: those samples are left out',
            ),
            (self.n_gaps, f'{self.n_gaps} gaps, the longest {self.longest_gap_s:.3g} s'),
        )
        return [text for is_so, text in said if is_so]


def thermal_findings(thermometers: Mapping[str, ThermometerSurvey]) -> list[str]:
    """Say what of thermometers, span and ramps is missing."""
    found = []
    board = thermometers.get('board')
    if board is None:
        found.append(
            'no board temperature: a thermal fit needs temperature/board, or name yours with '
            '--topic board=TOPIC'
        )
    else:
        heating, cooling = board.steepest_heating_k_min, -board.steepest_cooling_k_min
        if board.span < ADVISED_SPAN_K:
            advised = f'{ADVISED_SPAN_K:g} are advised'
            found.append(f'board temperature spans {board.span:.1f} K: {advised}')
        for name, rate in (('heating', heating), ('cooling', cooling)):
            if rate < RAMP_K_MIN:
                found.append(f'no {name} ramp: the dynamic set would not know {name}')
    if 'case' not in thermometers:
        found.append(
            'no case temperature: the regime will follow the slower board sensor; name yours '
            'with --topic case=TOPIC'
        )
    return found


def survey_recording(
    path: str | Path, topics: Topics | None = None, progress: Callable[[float], None] | None = None
) -> Survey:
    """Read a recording once, in bounded memory; `progress` gets the fraction read."""
    with open_recording(path, topics, require=()) as reader:
        survey = Survey(reader.info)
        topic = reader.topics.get('accel')
        total = reader.info.topics[topic][1] if topic else 0
        cells = CellAccumulator(_CELL_S, None)
        # A thermal test has few readings beside its samples.
        readings: dict[str, list[Readings]] = {}
        for block in reader.blocks():
            survey.add(block)
            rate = None if block.imu is None else block.imu.angular_velocity
            cells.add(block.accel_stamp_ns, block.accel, rate)
            for name, one in block.temperatures.items():
                readings.setdefault(name, []).append(one)
            if progress is not None and total:
                progress(survey.n / total)
        survey.info = reader.info
    if survey.n > 1:
        reduced = cells.finish()
        still = still_intervals(reduced, _MIN_REST_S)
        # whole cells: the first and the last may reach beyond the samples
        still_s = sum((upper - lower) * reduced.cell_s for lower, upper in still)
        survey.n_still, survey.still_s = len(still), min(still_s, survey.duration_s)
    found = {name: survey_thermometer(own) for name, own in readings.items()}
    survey.thermometers = {name: one for name, one in found.items() if one is not None}
    return survey


def survey_thermometer(readings: Sequence[Readings]) -> ThermometerSurvey | None:
    """Describe one thermometer by its readings, in pieces; None where there is no number."""
    if not readings:
        return None
    stamp_ns = np.concatenate([one.stamp_ns for one in readings])
    celsius = np.concatenate([one.celsius for one in readings])
    use = np.isfinite(celsius)
    stamp_ns, celsius = stamp_ns[use], celsius[use]
    if not len(celsius):
        return None
    # Rates from means over two minutes, so that a quantum is not a ramp.
    time = (stamp_ns - stamp_ns[0]) * 1e-9
    bins = np.maximum(time // _RAMP_WINDOW_S, 0).astype(np.int64)
    _, place = np.unique(bins, return_inverse=True)
    count = np.bincount(place)
    mean_time = np.bincount(place, time) / count
    mean = np.bincount(place, celsius) / count
    rates = np.diff(mean) / np.maximum(np.diff(mean_time), 1e-9) * 60.0
    steps = np.abs(np.diff(celsius))
    intervals = np.diff(stamp_ns)
    intervals = intervals[intervals > 0]
    return ThermometerSurvey(
        n=len(celsius),
        rate_hz=1e9 / float(np.median(intervals)) if len(intervals) else float('nan'),
        lowest=float(np.min(celsius)),
        highest=float(np.max(celsius)),
        steepest_heating_k_min=max(0.0, float(np.max(rates, initial=0.0))),
        steepest_cooling_k_min=min(0.0, float(np.min(rates, initial=0.0))),
        quantum=float(np.min(steps[steps > 0.0], initial=np.inf)),
    )
