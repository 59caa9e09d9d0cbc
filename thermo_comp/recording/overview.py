# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the survey of a recording before a fit: duration, rates, temperatures, rests and gaps, and
warnings about samples that an accelerometer at rest does not send.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..thermal.settings import ADVISED_SPAN_K, RAMP_K_MIN
from ..thermal.thermometer import COLDEST, HOTTEST
from ..topics import TEMPERATURE
from ..typing import Ints
from ..unit.gravity import STANDARD_GRAVITY
from ..unit.metrics import means_by
from .blocks import LONGEST_PAUSE_NS, Block, Readings, RecordingInfo, unstamped
from .fields import temperature_fields
from .reader import RecordingReader, open_recording
from .stillness import STILL_SD, CellAccumulator, Cells, still_intervals, why_restless
from .topics import PLAIN, Topics, shown

KELVINS = (180.0, 480.0)  # range of readings taken for kelvins: no board is above 180 degC
_RAMP_WINDOW_S = 120.0  # time over which the rate of a ramp is averaged [s]
_CELL_S, _MIN_REST_S = 0.5, 3.0  # lengths of a cell and of the shortest still interval [s]
_GAP_INTERVALS = 5.0  # shortest gap between samples / median interval in the first block
_GLITCH_SHARE = 0.01  # largest share of samples of exactly 0 that is taken for glitches
_FAULT_SHARE = 0.5  # largest accepted share of messages marked as without acceleration
_WITH_GRAVITY = (0.8, 1.25)  # range of |sample| / gravity at rest if samples contain gravity
_WITHOUT_GRAVITY = 0.3  # largest |sample| / gravity at rest if gravity is subtracted
_NO_SAMPLES = (
    'no accelerometer samples: record accel/counts or imu/uncompensated, or name another topic '
    'with --topic counts=TOPIC or --topic imu=TOPIC'
)


@dataclass(frozen=True)
class ThermometerSurvey:
    """A thermometer: range [degC], largest rates of its 2-min means [K/min], quantum [K]."""

    n: int
    rate_hz: float
    lowest: float
    highest: float
    steepest_heating_k_min: float
    steepest_cooling_k_min: float
    quantum: float


@dataclass(frozen=True)
class Survey:
    """Summary of a recording with `n` samples."""

    info: RecordingInfo
    n: int
    duration_s: float
    rate_hz: float  # inverse of the median interval between samples of the first block
    n_still: int  # number of still intervals of 3 s or more
    still_s: float  # sum of the lengths of the still intervals [s]
    thermometers: Mapping[str, ThermometerSurvey]
    findings: list[str]  # problems of the recording, and data that a fit lacks


def thermal_findings(
    thermometers: Mapping[str, ThermometerSurvey], candidates: Sequence[str] = ()
) -> list[str]:
    """List faulty and missing thermometers and ramps; `candidates`: unused temperature topics."""
    findings = []
    among = f': {", ".join(candidates)}' if candidates else ''
    board = thermometers.get('board')
    if board is None:
        findings.append(
            'no board temperature: a thermal fit needs temperature/board, or another topic given '
            f'with --topic board=TOPIC{among}'
        )
    else:
        heating, cooling = board.steepest_heating_k_min, -board.steepest_cooling_k_min
        span = board.highest - board.lowest
        if span < ADVISED_SPAN_K:
            findings.append(
                f'board temperature spans {span:.1f} K: {ADVISED_SPAN_K:g} K or more are advised'
            )
        for name, rate in (('heating', heating), ('cooling', cooling)):
            if rate < RAMP_K_MIN:
                findings.append(
                    f'no {name} ramp: {name} will be corrected by extrapolation; record a ramp'
                )
    for name, thermometer in thermometers.items():
        reads = f'{name} reads {thermometer.lowest:.4g} .. {thermometer.highest:.4g}'
        if thermometer.lowest < COLDEST or thermometer.highest > HOTTEST:
            findings.append(f'{reads}: this is not in degC')
        elif KELVINS[0] < thermometer.lowest and thermometer.highest < KELVINS[1]:
            findings.append(f'temperature/{reads} degC: that looks like kelvins')
    if 'case' not in thermometers:
        findings.append(
            'no case temperature: the regime will be detected from the slower board thermometer; '
            f'name a case thermometer with --topic case=TOPIC{among}'
        )
    return findings


def unused_thermometers(reader: RecordingReader) -> list[str]:
    """List unused topics that may hold a temperature, such as a barometer's temperature."""
    candidates = []
    paths = {role: field.path for role, field in reader.fields.items()}
    used = {(name, paths.get(role)) for role, name in reader.topics.items()}
    for name, (kind, count) in sorted(reader.info.topics.items()):
        # Messages of the types Temperature, Float32 and Float64 need no field name.
        if not count or not used.isdisjoint({(name, None), (name, PLAIN.get(kind))}):
            continue
        if kind == TEMPERATURE or (kind in PLAIN and 'temp' in name.lower()):
            candidates.append(shown(name))
            continue
        fields = temperature_fields(kind, reader.definitions)
        candidates += [shown(f'{name}:{field}') for field in fields if (name, field) not in used]
    return candidates


def survey_recording(
    path: str | Path, topics: Topics | None = None, progress: Callable[[float], None] | None = None
) -> Survey:
    """Read and describe a recording in bounded memory; `progress` gets the fraction read."""
    with open_recording(path, topics, require=()) as reader:
        topic = reader.topics.get('accel')
        total = reader.info.topics[topic][1] if topic else 0
        accumulator, causes = CellAccumulator(_CELL_S, None), CauseCounter()
        readings: dict[str, list[Readings]] = {}  # kept in memory: far fewer than samples
        clock = _Clock()
        for block in reader.blocks():
            for name, temperature in block.temperatures.items():
                readings.setdefault(name, []).append(temperature)
            if not len(block):
                continue
            clock.add(block.accel_stamp_ns)
            rate = None if block.imu is None else block.imu.angular_velocity
            accumulator.add(block.accel_stamp_ns, block.accel, rate)
            causes.add(block)
            if progress is not None and total:
                progress(clock.n / total)
        info, candidates = reader.info, unused_thermometers(reader)
    n = clock.n
    reduced = accumulator.cells()
    still = still_intervals(reduced, _MIN_REST_S) if n > 1 else []
    cause = causes.cause(reduced, STILL_SD) if n > 1 else ''
    surveys = ((name, survey_thermometer(parts)) for name, parts in readings.items())
    thermometers = {name: survey for name, survey in surveys if survey is not None}
    if n and not still and not cause:
        why = why_restless(reduced)
        cause = f'the unit never rests for 3 s, and a fit needs rests: {why}'
    findings = [f'cut off: {info.truncated}'] * bool(info.truncated)
    findings += ['a fit needs one clock for the stamps of all topics'] * bool(reader.apart)
    findings += [_NO_SAMPLES] * (not n) + thermal_findings(thermometers, candidates)
    findings += [cause] * bool(cause) + clock.findings()
    rate_hz = 1e9 / clock.step_ns if clock.step_ns else float('nan')
    duration_s = (clock.latest_ns - clock.earliest_ns) * 1e-9
    # The last cell may extend beyond the samples: limit the time at rest to the duration.
    still_s = min(sum((upper - lower) * reduced.cell_s for lower, upper in still), duration_s)
    return Survey(info, n, duration_s, rate_hz, len(still), still_s, thermometers, findings)


@dataclass
class _Clock:
    """Statistics of the samples' stamps: their median interval, gaps and backward steps."""

    n: int = 0
    earliest_ns: int = 0
    latest_ns: int = 0
    last_ns: int = 0
    newest_ns: int = 0  # newest stamp since the last restart of the clock
    step_ns: float = 0.0  # median interval of the first stamps that rise
    n_backwards: int = 0  # number of stamps not above the newest stamp since a restart
    n_restarts: int = 0  # number of steps back by more than `LONGEST_PAUSE_NS`
    n_gaps: int = 0
    longest_gap_s: float = 0.0

    def add(self, stamp_ns: Ints) -> None:
        """Add the next stamps; `stamp_ns` must not be empty."""
        if not self.n:
            self.earliest_ns = self.latest_ns = self.last_ns = self.newest_ns = int(stamp_ns[0])
        later = stamp_ns[not self.n :]
        steps = np.diff(later, prepend=self.last_ns)
        self.n, self.last_ns = self.n + len(stamp_ns), int(stamp_ns[-1])
        self.earliest_ns = min(self.earliest_ns, int(stamp_ns.min()))
        self.latest_ns = max(self.latest_ns, int(stamp_ns.max()))
        # After a step back by an hour or less, a fit uses only samples after the newest stamp.
        restarts = np.flatnonzero(steps < -LONGEST_PAUSE_NS)
        self.n_restarts += len(restarts)
        for number, part in enumerate(np.split(later, restarts)):
            before = int(part[0]) - 1 if number else self.newest_ns
            newest = np.maximum.accumulate(np.concatenate(([before], part)))
            self.n_backwards += int((part <= newest[:-1]).sum())
            self.newest_ns = int(newest[-1])
        rising = steps[steps > 0]
        if not self.step_ns and len(rising):
            self.step_ns = float(np.median(rising))
        gaps = rising[rising > _GAP_INTERVALS * self.step_ns]
        self.n_gaps += len(gaps)
        self.longest_gap_s = max(self.longest_gap_s, float(np.max(gaps, initial=0)) * 1e-9)

    def findings(self) -> list[str]:
        """List the gaps between samples, and the numbers of stamps that do not rise."""
        texts = {
            f'samples with a stamp not later than an earlier stamp: {self.n_backwards}; these '
            'samples are left out': self.n_backwards,
            f'the stamps go back by more than an hour ({self.n_restarts} times): a fit takes '
            'each jump for a pause of an hour': self.n_restarts,
            f'gaps between samples: {self.n_gaps}, the longest {self.longest_gap_s:.3g} s': (
                self.n_gaps
            ),
        }
        return [text for text, count in texts.items() if count]


def survey_thermometer(readings: Sequence[Readings]) -> ThermometerSurvey | None:
    """Describe a thermometer by its readings, given in pieces; None without a finite reading."""
    if not readings:
        return None
    stamp_ns = np.concatenate([reading.stamp_ns for reading in readings])
    celsius = np.concatenate([reading.celsius for reading in readings])
    use = np.isfinite(celsius)
    stamp_ns, celsius = stamp_ns[use], celsius[use]
    if not len(celsius):
        return None
    # Rates of temperature are taken between two-minute means, so that a quantum step is no ramp.
    time = (stamp_ns - stamp_ns[0]) * 1e-9
    bins = np.maximum(time // _RAMP_WINDOW_S, 0).astype(np.int64)
    mean_time, mean = means_by(bins, np.column_stack((time, celsius))).T
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


class CauseCounter:
    """Counts samples that a working accelerometer at rest does not send, block by block."""

    def __init__(self) -> None:
        self._n = self._n_zero = self._n_absent = 0
        self._is_imu = False
        self._stamps_ns: set[int] = set()

    def add(self, block: Block) -> None:
        """Count zero samples, messages marked as without acceleration, and stamps of a block."""
        self._n += len(block.accel_stamp_ns)
        self._n_zero += int(np.count_nonzero(~block.accel.any(axis=1)))
        if block.imu is not None:
            self._is_imu = True
            is_absent = block.imu.linear_acceleration_covariance[:, 0] == -1.0
            self._n_absent += int(np.count_nonzero(is_absent))
        if len(self._stamps_ns) < 2:  # two different stamps show that the clock runs
            self._stamps_ns |= set(np.unique(block.accel_stamp_ns)[:2].tolist())

    def cause(self, cells: Cells, still_sd: float) -> str:
        """Describe why these samples cannot come from an accelerometer at rest; '' if they can."""
        if self._n_absent > _FAULT_SHARE * self._n:
            return (
                'the messages are marked as without acceleration '
                '(linear_acceleration_covariance[0] = -1): use another topic of the driver'
            )
        if self._n > 1 and len(self._stamps_ns) == 1:
            return unstamped(next(iter(self._stamps_ns)))
        if self._n_zero == self._n and self._n:
            return 'all samples are exactly zero: the sensor does not answer'
        if self._n_zero > _GLITCH_SHARE * self._n:
            return (
                f'{100.0 * self._n_zero / self._n:.0f} % of the samples are exactly zero, between '
                'other samples: the topic has two sources, or messages without an acceleration'
            )
        return self._unit_of(cells, still_sd) if self._is_imu else ''

    def _unit_of(self, cells: Cells, still_sd: float) -> str:
        """Name the fault if |sample| at rest is near 1 (g), 1000 (mg), 0 (no gravity); else ''."""
        scatter = cells.variance.max(axis=1, initial=0.0)
        quiet = (cells.count > 1) & (scatter <= np.quantile(scatter, 0.5) if len(scatter) else 0)
        if not quiet.any():
            return ''
        norm = float(np.median(np.linalg.norm(cells.mean[quiet], axis=1)))
        sd = float(np.sqrt(np.median(scatter[quiet])))
        for unit, one_g in (('g', 1.0), ('mg', 1000.0)):
            if _WITH_GRAVITY[0] < norm / one_g < _WITH_GRAVITY[1] and sd < still_sd * one_g:
                return (
                    f'samples at rest have the norm {norm:.4g}, not {STANDARD_GRAVITY:.2f} m/s^2: '
                    f'the samples are in {unit}, convert them to m/s^2 with thermo_comp convert'
                )
        if norm < _WITHOUT_GRAVITY * STANDARD_GRAVITY and sd < still_sd * STANDARD_GRAVITY:
            return (
                f'samples at rest have the norm {norm:.2g} m/s^2: gravity is subtracted (linear '
                'or free acceleration), but the fit needs gravity: use another topic of the driver'
            )
        return ''
