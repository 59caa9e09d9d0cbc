# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the data of a report on a fit, on bags, or on a calibration, and the data of the bag that the
figures over time show; nothing is drawn here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from ..fitting import FitResult, ResidualRow
from ..fitting.coverage import LeastKnown, distinct_directions, least_known
from ..fitting.reduction import ReducedBag
from ..fitting.sensors import learn_detector, readings_in_order
from ..judging.evaluation import Epoch, history_of, judge_bags
from ..judging.judgement import Judgement
from ..judging.verdicts import Verdict
from ..judging.windows import WINDOW_S, JudgedWindows, corrected_windows, usual_window
from ..replay import check_unit
from ..text import counted
from ..thermal.lags import BOARD_INPUT
from ..thermal.regime import Regime
from ..thermal.settings import DetectorSettings
from ..thermal.tracker import ThermalTracker
from ..typing import Floats
from ..unit.calibration import Calibration
from ..unit.gravity import ug_text
from ..unit.metrics import means_by, norm_residual
from ..unit.provenance import Source

_T = TypeVar('_T')

#: The compared corrections: the constants at the reference temperature, and the calibration.
RAW = 'raw'
CHOSEN = 'calibration'
#: The correction of each position of a fit by a calibration fitted to the other positions.
LEFT_OUT = 'left out'
# Rate from which the heating (cooling) in bags counts as a heating (cooling) ramp [K/min].
_SLOWEST_RAMP_K_MIN = 0.05
#: Key of a bag's metadata in which the simulator stores the true parameters.
_SIMULATED = 'truth'
# Largest number of points of a line; a figure has fewer pixels in a row.
_MOST_POINTS = 4000


@dataclass(frozen=True)
class Position:
    """A still position: force direction in the output frame, RMS of |f| - g by correction."""

    number: int
    bag: int
    duration_s: float
    up: tuple[float, ...]
    residual_rms: dict[str, float]


class Stretch(NamedTuple):
    """An interval [s since start] of one regime and direction (-1 cooling, +1 heating, 0 none)."""

    start: float
    stop: float
    regime: Regime
    direction: int


@dataclass(frozen=True)
class ShownBag:
    """A bag, its regimes, and temperature derivatives, NaN until their estimates have settled."""

    index: int
    bag: ReducedBag
    start_ns: int
    duration_s: float
    time: Floats
    board_rate: Floats  # [K/s]
    case_rate: Floats  # [K/s]
    acceleration: Floats  # second derivative of the temperature of the leading sensor [K/s^2]
    stretches: tuple[Stretch, ...]

    @property
    def leader(self) -> str:
        """The leading sensor: 'case' if the bag has a case thermometer, else 'board'."""
        return 'case' if len(self.bag.case.value) else 'board'


@dataclass(frozen=True)
class Evidence:
    """
    The content of a report; missing parts are None or empty.

    `windows`: windows at rest of all bags; `judgement`: judgement of `windows`; `steps`: residuals
    after each step of the model; `left_out`: error of each position of `windows` with a fit to the
    other positions [m/s^2], see `left_out_text`; `findings`: reservations about calibration or
    bags; `checks`: passed checks.
    """

    serial: str
    calibration: Calibration | None = None
    gravity: float | None = None
    bags: tuple[ReducedBag, ...] = ()
    windows: JudgedWindows | None = None
    judgement: Judgement | None = None
    steps: tuple[ResidualRow, ...] = ()
    left_out: Mapping[int, float] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    history: tuple[Epoch, ...] = ()

    @property
    def gravity_sd(self) -> float:
        """Sd of gravity that the covariance of the calibration includes [m/s^2]."""
        return 0.0 if self.calibration is None else self.calibration.gravity_sd_m_s2

    @property
    def sources(self) -> tuple[Source, ...]:
        """The bags that the calibration was fitted on."""
        return () if self.calibration is None else self.calibration.provenance.sources

    @property
    def is_seen(self) -> bool:
        """Whether the calibration was fitted on a bag of this report."""
        fitted = {source.sha256 for source in self.sources if source.sha256}
        shown = {source.sha256 for bag in self.bags for source in bag.sources}
        return bool(self.steps) or not fitted.isdisjoint(shown)

    @property
    def is_simulated(self) -> bool:
        """Whether one of the bags comes from the simulator."""
        return any(_SIMULATED in bag.info.metadata for bag in self.bags)

    @property
    def is_imu(self) -> bool:
        """Whether the raw samples are a specific force, not counts."""
        return any(bag.info.input == 'imu' for bag in self.bags)

    @property
    def headline(self) -> str:
        """The verdict with its numbers, or the reason why nothing was judged."""
        if self.judgement is not None:
            return str(self.judgement)
        if self.calibration is not None:
            if self.bags:
                return 'not judged: no recording has a rest of the length of a window'
            return 'the calibration alone: no recording was judged'
        return 'a thermal record: no calibration was judged'

    @property
    def level(self) -> Literal['good', 'reserved', 'poor', 'open']:
        """Class of the verdict; 'reserved': valid, but with reservations or a large claimed sd."""
        if self.judgement is None or self.judgement.kind in (Verdict.OUTSIDE, Verdict.NO_CLAIM):
            return 'open'
        if not self.judgement.is_valid:
            return 'poor'
        is_good = self.judgement.kind is Verdict.VALID and not self.findings
        return 'good' if is_good else 'reserved'

    @cached_property
    def shown(self) -> ShownBag | None:
        """The bag that the figures over time show, with its temperature rates and regimes."""
        if not self.bags:
            return None
        calibration, index = self.calibration, widest(self.bags)
        detector = learn_detector(self.bags) if calibration is None else calibration.detector
        return shown_bag(self.bags[index], index, detector)

    @property
    def forces(self) -> dict[str, Floats]:
        """Specific force of the windows, raw and corrected; {} for counts without calibration."""
        windows = self.windows
        if windows is None or not len(windows):
            return {}
        if self.calibration is not None:
            return {RAW: windows.raw, CHOSEN: windows.force}
        return {RAW: windows.force} if self.is_imu else {}

    @cached_property
    def residuals(self) -> dict[str, Floats]:
        """``|f| - g`` for each entry of `forces` [m/s^2]; empty if gravity is not known."""
        if self.gravity is None or self.windows is None:
            return {}
        sizes = self.windows.size
        return {name: norm_residual(force, sizes) for name, force in self.forces.items()}

    @cached_property
    def least_known(self) -> LeastKnown | None:
        """The attitude with the largest sd of |f|; None without a calibration's covariance."""
        if self.calibration is None:
            return None
        return least_known(self.calibration, np.array([rest.up for rest in self.positions]))

    @cached_property
    def positions(self) -> tuple[Position, ...]:
        """The still positions; attitudes from corrected or, without calibration, raw forces."""
        windows = self.windows
        if windows is None or not self.forces:
            return ()
        label = windows.position
        places, first, n = np.unique(label, return_index=True, return_counts=True)
        up = means_by(label, next(reversed(self.forces.values())))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        rms = {name: np.sqrt(means_by(label, x**2)) for name, x in self.residuals.items()}
        rms[LEFT_OUT] = np.array([self.left_out.get(place, np.nan) for place in places.tolist()])
        return tuple(
            Position(
                number=k + 1,
                bag=int(windows.bag[first[k]]),
                duration_s=windows.window_s * int(n[k]),
                up=tuple(up[k].tolist()),
                residual_rms={r: float(x[k]) for r, x in rms.items() if np.isfinite(x[k])},
            )
            for k in range(len(places))
        )

    @property
    def n_directions(self) -> int:
        """Number of distinct directions of the force."""
        ups = np.array([rest.up for rest in self.positions])
        return len(distinct_directions(ups.reshape(-1, 3)))

    @property
    def positions_text(self) -> str:
        """Numbers of distinct directions and, if different, of rests, as text."""
        n_rests, n = len(self.positions), self.n_directions
        text = counted(n, 'position')
        return text if n == n_rests else f'{text} ({counted(n_rests, "rest")})'

    @property
    def left_out_text(self) -> str:
        """The meaning of the left-out errors: |f| - g or, if |f| is not determined, drift."""
        drift = 'RMS drift of an axis (force less its mean in the position)'
        if self.n_directions == 1:
            return f'{drift} on data left out of the fit'
        return (
            'RMS of |f| − g of each position by a fit to the other positions, the error expected '
            f'in a new attitude; if the other positions do not determine |f|: {drift}'
        )

    def axis_residuals(self) -> dict[str, Floats]:
        """Return the force less the known |f| in the position's mean direction, shape (n, 3)."""
        windows = self.windows
        if windows is None or self.gravity is None or not self.positions:
            return {}
        _, place = np.unique(windows.position, return_inverse=True)
        true = np.array([position.up for position in self.positions])[place]
        true *= windows.size[:, np.newaxis]
        return {name: force - true for name, force in self.forces.items()}


def required(value: _T | None) -> _T:
    """Return a value that a figure needs; ValueError if the value is None."""
    if value is None:
        raise ValueError('`evidence` lacks the data of this figure')
    return value


def evidence_of_bags(
    bags: Sequence[ReducedBag],
    calibration: Calibration | None = None,
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
    tolerance: float | None = None,
    serial: str | None = None,
    others: Sequence[Calibration] = (),
) -> Evidence:
    """
    Return the evidence of bags, judged with a calibration if given, or of a calibration alone.

    `window_s`: length of a window; `tolerance`: largest accepted RMS [m/s^2], or None; an empty
    `serial` accepts any calibration; `others`: earlier or later calibrations of the unit. Raises
    CalibrationError for another unit's calibration; RecordingError if the sample rate is too low.
    """
    windows = judgement = None
    serials = sorted({bag.source.serial for bag in bags if bag.source.serial})
    if calibration is None:
        windows = corrected_windows(bags, None, gravity=gravity, window_s=window_s)
    else:
        for bag in bags:
            check_unit(calibration, bag.info, serial)
        serial = calibration.unit.serial
        gravity = calibration.gravity_m_s2 if gravity is None else gravity
        judgement = judge_bags(
            bags, calibration, gravity=gravity, window_s=window_s, tolerance=tolerance
        )
    return Evidence(
        serial=serial or ', '.join(serials) or 'unknown',
        calibration=calibration,
        gravity=gravity,
        bags=tuple(bags),
        windows=judgement.windows if judgement else windows,
        judgement=judgement,
        findings=_reservations(calibration) if calibration else (),
        history=history_of([calibration, *others]) if calibration and others else (),
    )


def evidence_of_fit(result: FitResult) -> Evidence:
    """Return the evidence of a fit on its bags."""
    rests = [(bag.source.name, rest.start_ns) for bag in result.bags for rest in bag.intervals]
    left_out = {(place.source, place.start_ns): place.left_out_rms for place in result.positions}
    window_s = usual_window(result.bags)
    judged = evidence_of_bags(result.bags, result.calibration, window_s=window_s, serial='')
    return replace(
        judged,
        steps=result.residuals,
        left_out={k: left_out[at] for k, at in enumerate(rests) if left_out.get(at, 0.0) > 0.0},
        # The finding `positions` is no reservation: it advises more positions than a fit needs.
        checks=tuple(
            note.message
            for note in result.findings
            if note.level != 'advice' or note.name == 'positions'
        ),
    )


def _reservations(calibration: Calibration) -> tuple[str, ...]:
    """Return the reservations about a calibration, except advice to record more positions."""
    lower, upper = calibration.dynamic.rate_range_k_min
    notes = [
        f'the bags have no {name} ramp: the correction in {name} ramps is extrapolated'
        for name, rate in (('heating', upper), ('cooling', -lower))
        if rate < _SLOWEST_RAMP_K_MIN
    ]
    for part in calibration.provenance.residuals:
        left_out = part.left_out_rms_m_s2
        if part.section == 'all' and left_out is not None and left_out >= part.raw_rms_m_s2:
            notes.append(
                f'the RMS on positions left out, {ug_text(left_out)}, is not below the raw RMS, '
                f'{ug_text(part.raw_rms_m_s2)}: the fit does not predict a new attitude'
            )
    if not calibration.has_uncertainty:
        notes.append('the calibration states no uncertainty')
    notes += [note for note in calibration.provenance.notes if not note.startswith('positions: ')]
    return tuple(dict.fromkeys(notes))


def span_of(bag: ReducedBag) -> tuple[int, float]:
    """Return start [ns] and length [s] of a bag's samples or, without samples, of its readings."""
    start_ns, end_ns = bag.start_ns, bag.end_ns
    if not bag.n_samples:
        start_ns, end_ns = bag.board.stamp_ns[[0, -1]].tolist()
    return start_ns, (end_ns - start_ns) * 1e-9


def widest(bags: Sequence[ReducedBag]) -> int:
    """Return the index of the bag with the widest range of T_board; of several, the longest."""
    spans = [float(np.ptp(bag.board.value)) if len(bag.board.value) else 0.0 for bag in bags]
    # Of bags with equal range (within 5 %) and duration (in whole minutes), take the first.
    candidates = [i for i, span in enumerate(spans) if span >= 0.95 * max(spans)]
    return max(candidates, key=lambda i: (round((bags[i].end_ns - bags[i].start_ns) / 60e9), -i))


def shown_bag(bag: ReducedBag, index: int, detector: DetectorSettings) -> ShownBag:
    """Run thermometers and detector over a bag's readings, as the node would."""
    tracker = ThermalTracker(detector)
    start_ns, end = span_of(bag)
    readings = readings_in_order(bag, (BOARD_INPUT, 'case'))
    rows, flags = [], []
    for reading in readings:
        tracker.read(*reading)
        b, c = tracker.board, tracker.case
        lead = b if c.stamp_ns is None else c
        rows.append((b.rate, b.var_rate, c.rate, c.var_rate, *lead.acceleration))
        flags.append((tracker.detector.regime, tracker.detector.direction))
    time: Floats = np.array([stamp_ns - start_ns for _, stamp_ns, _ in readings]) * 1e-9
    # Of several regimes at the same time, the last regime applies. Equal successive regimes are
    # joined.
    state_at = {
        0.0: (Regime.UNKNOWN, 0),
        **dict(zip(np.clip(time, 0.0, end).tolist(), flags, strict=True)),
    }
    changes = [next(run) for _, run in groupby(state_at.items(), key=itemgetter(1))]
    begins = [begin for begin, _ in changes]
    stretches = (
        Stretch(begin, stop, *state)
        for (begin, state), stop in zip(changes, [*begins[1:], end], strict=True)
        if stop > begin
    )
    every = slice(None, None, len(time) // _MOST_POINTS + 1)
    columns = np.array(rows).reshape(-1, 3, 2)[every]
    board, case, second = (_settled(*columns[:, k].T) for k in range(3))
    return ShownBag(index, bag, start_ns, end, time[every], board, case, second, tuple(stretches))


def _settled(value: Floats, variance: Floats) -> Floats:
    """Replace an estimate by NaN until its sd has fallen to three times its median sd."""
    is_known = np.isfinite(value) & np.isfinite(variance)
    if not is_known.any():
        return np.full(len(value), np.nan)
    usual = float(np.median(variance[is_known]))
    first = int(np.argmax(is_known & (variance <= 9.0 * usual)))
    return np.where(is_known & (np.arange(len(value)) >= first), value, np.nan)
