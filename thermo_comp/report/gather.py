# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the way to a report's evidence: from bags, with or without a calibration, or from a fit."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np

from ..fitting import FitResult
from ..fitting.reduction import ReducedBag
from ..fitting.sensors import learn_detector, readings_in_order
from ..fitting.verdict import Finding
from ..judging import WINDOW_S, Judgement, corrected_windows, judge_bags
from ..judging.history import history_of
from ..judging.windows import usual_window
from ..replay import check_unit
from ..thermal.memory import BOARD_INPUT
from ..thermal.regime import Regime
from ..thermal.settings import DetectorSettings
from ..thermal.tracker import ThermalTracker
from ..typing import Floats
from ..unit.calibration import Calibration
from ..unit.gravity import spoken
from .evidence import BagFacts, Evidence, ShownBag, Stretch

# A ramp slower than this says nothing of its direction.
_SLOWEST_RAMP_K_MIN = 0.05
#: The key of a bag's metadata under which our simulator tells what it simulated.
_SIMULATED = 'truth'
# A line in a figure has fewer pixels.
_MOST_POINTS = 4000


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
    Judge bags, with a calibration or without; no bags report on the calibration alone.

    Gravity is the calibration's by default; `window_s` and `tolerance` are as for `evaluate`; an
    empty `serial` accepts any calibration; `others` are further ones of the unit, for its history.

    Raises CalibrationError for a calibration of another unit; RecordingError if samples are too
    slow for such windows.
    """
    if calibration is None:
        return _evidence(
            bags,
            None,
            None,
            serial=serial,
            unit='m/s^2' if any(bag.info.input == 'imu' for bag in bags) else 'counts',
            gravity=gravity,
            windows=corrected_windows(bags, None, gravity=gravity, window_s=window_s),
        )
    for bag in bags:
        check_unit(calibration, bag.info, serial)
    gravity = calibration.gravity_m_s2 if gravity is None else gravity
    judgement = judge_bags(
        bags, calibration, gravity=gravity, window_s=window_s, tolerance=tolerance
    )
    return _evidence(
        bags,
        calibration,
        judgement,
        gravity=gravity,
        findings=_against(calibration),
        history=history_of([calibration, *others]) if others else (),
    )


def evidence_of_fit(result: FitResult, *, is_brief: bool = False) -> Evidence:
    """Gather what a fit has to show, on its own bags; a brief one lacks what only figures show."""
    calibration = result.calibration
    found = [(bag.source.name, one.start_ns) for bag in result.bags for one in bag.intervals]
    left_out = {(one.source, one.start_ns): one.left_out_rms for one in result.positions}
    against = [f'{one.name}: {one.message}' for one in result.findings if _is_reservation(one)]
    return _evidence(
        result.bags,
        calibration,
        judge_bags(result.bags, calibration, window_s=usual_window(result.bags)),
        is_brief=is_brief,
        steps=result.residuals,
        left_out={k: left_out[one] for k, one in enumerate(found) if one in left_out},
        findings=tuple(dict.fromkeys((*_against(calibration), *against))),
        checks=tuple(one.message for one in result.findings if not _is_reservation(one)),
        is_fit=True,
    )


def _evidence(
    bags: Sequence[ReducedBag],
    calibration: Calibration | None,
    judgement: Judgement | None,
    *,
    is_brief: bool = False,
    **known: Any,
) -> Evidence:
    """Add what bags, calibration and judgement tell to what else is known."""
    told: dict[str, Any] = {}
    if calibration is not None:
        told = {
            'serial': calibration.unit.serial,
            'unit': calibration.unit.input,
            'gravity': calibration.gravity_m_s2,
            'windows': None if judgement is None else judgement.windows,
        }
    known = told | known
    said = sorted({bag.source.serial for bag in bags if bag.source.serial})
    known['serial'] = known['serial'] or ', '.join(said) or 'unknown'
    return Evidence(
        calibration=calibration,
        bags=tuple(map(_facts, bags)),
        shown=None if is_brief else _shown(bags, calibration),
        judgement=judgement,
        is_simulated=any(_SIMULATED in bag.info.metadata for bag in bags),
        **known,
    )


def _is_reservation(finding: Finding) -> bool:
    # More positions than enough would be better still: no reservation.
    return finding.level == 'advice' and finding.name != 'positions'


def _against(calibration: Calibration) -> tuple[str, ...]:
    """Give what speaks against a calibration by itself, but for its wish for more positions."""
    lower, upper = calibration.dynamic.rate_range_k_min
    found = [
        f'the dynamic set never saw {name}: its ramps are a guess there'
        for name, rate in (('heating', upper), ('cooling', -lower))
        if rate < _SLOWEST_RAMP_K_MIN
    ]
    for one in calibration.provenance.residuals:
        left_out = one.left_out_rms_m_s2
        if one.section == 'all' and left_out is not None and left_out >= one.raw_rms_m_s2:
            found.append(
                f'on positions left out {spoken(left_out)} are no better than '
                f'{spoken(one.raw_rms_m_s2)} raw: the positions do not tell a new attitude'
            )
    if not calibration.has_uncertainty:
        found.append('the calibration says nothing of its uncertainty')
    found += [note for note in calibration.provenance.notes if not note.startswith('positions: ')]
    return tuple(dict.fromkeys(found))


def _span_ns(bag: ReducedBag) -> tuple[int, int]:
    """Give a bag's first and last stamp: of its samples, or of its readings without them."""
    if bag.n_samples:
        return bag.start_ns, bag.end_ns
    return int(bag.board.stamp_ns[0]), int(bag.board.stamp_ns[-1])


def _facts(bag: ReducedBag) -> BagFacts:
    start_ns, end_ns = _span_ns(bag)
    remarks = [bag.info.truncated] if bag.info.truncated else []
    if bag.n_saturated:
        remarks.append(f'{bag.n_saturated} samples saturated, left out')
    if bag.n_dropped:
        remarks.append(f'{bag.n_dropped} samples not finite or out of order, left out')
    if not bag.n_samples:
        remarks.append('no accelerometer samples')
    elif not bag.intervals:
        remarks.append('never at rest')
    elif len(bag.intervals) > 1:
        remarks.append(f'{len(bag.intervals)} still intervals')
    if not len(bag.case.value):
        remarks.append('no case temperature')
    value = bag.board.value
    return BagFacts(
        name=bag.source.name,
        sha256=bag.source.sha256 or '',
        start_ns=start_ns,
        duration_s=(end_ns - start_ns) * 1e-9,
        n_samples=bag.n_samples,
        rate_hz=1.0 / bag.cycle_s if bag.cycle_s > 0.0 else float('nan'),
        board_span=(float(np.min(value)), float(np.max(value))) if len(value) else None,
        remarks=tuple(remarks),
    )


def _shown(bags: Sequence[ReducedBag], calibration: Calibration | None) -> ShownBag | None:
    """Prepare the bag of the time figures: the widest in temperature, then the longest."""
    if not bags:
        return None
    spans = [float(np.ptp(bag.board.value)) if len(bag.board.value) else 0.0 for bag in bags]
    # Spans within 5 % are equal, and so are lengths within a minute; the first of equals.
    wide = [i for i, span in enumerate(spans) if span >= 0.95 * max(spans)]
    index = max(wide, key=lambda i: (round((bags[i].end_ns - bags[i].start_ns) / 60e9), -i))
    detector = learn_detector(bags) if calibration is None else calibration.detector
    return shown_bag(bags[index], index, detector)


def shown_bag(bag: ReducedBag, index: int, detector: DetectorSettings) -> ShownBag:
    """Run thermometers and detector over a bag's readings, as the node would."""
    tracker = ThermalTracker(detector)
    start_ns, end_ns = _span_ns(bag)
    readings = readings_in_order(bag, (BOARD_INPUT, 'case'))
    rows, flags = [], []
    for reading in readings:
        tracker.read(*reading)
        b, c = tracker.board, tracker.case
        lead = b if c.stamp_ns is None else c
        curve = lead.acceleration
        rows.append((b.rate, b.var_rate, c.rate, c.var_rate, *curve))
        flags.append((tracker.detector.regime, tracker.detector.direction))
    end = (end_ns - start_ns) * 1e-9
    time: Floats = np.array([stamp_ns - start_ns for _, stamp_ns, _ in readings]) * 1e-9
    # Of several at once the last one holds, and equal ones after each other are one stretch.
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
    columns = np.array(rows).reshape(-1, 6)[every].T
    board, case, bend = (_settled(*pair) for pair in columns.reshape(3, 2, -1))
    return ShownBag(
        index, start_ns, bag.board, bag.case, time[every], board, case, bend, tuple(stretches)
    )


def _settled(value: Floats, variance: Floats) -> Floats:
    """Leave out an estimate until it has settled: its sd has come down to thrice the usual."""
    known = np.isfinite(value) & np.isfinite(variance)
    if not known.any():
        return np.full(len(value), np.nan)
    usual = float(np.median(variance[known]))
    first = int(np.argmax(known & (variance <= 9.0 * usual)))
    return np.where(known & (np.arange(len(value)) >= first), value, np.nan)
