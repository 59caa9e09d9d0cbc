# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from bags, with or without a calibration, to a report's evidence.

Reading and judging are apart, so that a viewer reads a bag once and judges it anew whenever the
calibration changes.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from ..fitting.reduction import ReducedBag
from ..fitting.sensors import learn_detector
from ..judging import WINDOW_S, OpenedBag, judge_bags
from ..judging.windows import raw_windows
from ..replay import check_unit
from ..simulation import CYCLOGRAM_NAMES, Cyclogram, cyclogram_preset, parse_cyclogram
from ..unit.calibration import Calibration
from .evidence import BagFacts, Evidence, ShownBag
from .trace import thermal_trace

# A recorded program is text that somebody else wrote; no real one is longer.
_LONGEST_PROGRAM = 4096
# A ramp slower than this says nothing of its direction.
_SLOWEST_RAMP_K_MIN = 0.05


def span_of(bag: ReducedBag) -> tuple[int, int]:
    """
    Give the first and the last stamp of a bag: of its samples, or of its readings without them.
    """
    if bag.n_samples:
        return bag.start_ns, bag.end_ns
    return int(bag.board.stamp_ns[0]), int(bag.board.stamp_ns[-1])


def evidence_of_bags(
    bags: Sequence[OpenedBag],
    calibration: Calibration | None = None,
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
    tolerance: float | None = None,
    serial: str | None = None,
    program: str | None = None,
) -> Evidence:
    """
    Judge bags, with a calibration or without.

    Parameters
    ----------
    bags : sequence of OpenedBag
        The bags; none reports on the calibration alone.
    calibration : Calibration or None, optional
        The unit's calibration; without it only the thermal side is reported, and ``|g|`` of a
        unit that speaks m/s^2.
    gravity : float or None, optional
        Local gravity; the calibration's by default.
    window_s, tolerance : float, optional
        As for `judging.evaluate`.
    serial : str or None, optional
        Serial of the unit, instead of the bags'; empty accepts any calibration.
    program : str or None, optional
        The chamber's program, as `simulation.parse_cyclogram` reads it; by default what a
        simulated bag says of itself.

    Returns
    -------
    Evidence
        For `write_report`.

    Raises
    ------
    CalibrationError
        If the calibration is for another unit.
    RecordingError
        If a bag's samples are too slow for such windows.
    ValueError
        If `program` cannot be read.

    """
    reduced = [bag.reduced for bag in bags]
    judgement = None
    unit = 'counts'
    if calibration is not None:
        for bag in bags:
            check_unit(calibration, bag.info, serial)
        unit = calibration.unit.input
        gravity = calibration.gravity_m_s2 if gravity is None else gravity
        judgement = judge_bags(
            reduced, calibration, gravity=gravity, window_s=window_s, tolerance=tolerance
        )
        windows = None if judgement is None else judgement.windows
    else:
        if any(bag.info.input == 'imu' for bag in bags):
            unit = 'm/s^2'
        windows = raw_windows(reduced, np.nan if gravity is None else gravity, window_s)
    return Evidence(
        serial=_serial(bags, calibration, serial),
        unit=unit,
        gravity=gravity,
        calibration=calibration,
        bags=tuple(bag_facts(bag.reduced, bag.info.truncated) for bag in bags),
        shown=shown_of(reduced, calibration, program, [bag.info.metadata for bag in bags]),
        windows=windows,
        judgement=judgement,
        findings=() if calibration is None else of_calibration(calibration),
    )


def shown_of(
    bags: Sequence[ReducedBag],
    calibration: Calibration | None,
    program: str | None,
    metadata: Sequence[object] = (),
) -> ShownBag | None:
    """
    Prepare the bag that the time figures show.

    Parameters
    ----------
    bags : sequence of ReducedBag
        The bags.
    calibration : Calibration or None
        Gives the detector; without one it is learnt from the bags.
    program : str or None
        The chamber's program, as `simulation.parse_cyclogram` reads it.
    metadata : sequence of mapping, optional
        Of each bag; what simulated ones say of their program is used without `program`.

    Returns
    -------
    ShownBag or None
        None without bags.

    Raises
    ------
    ValueError
        If `program` cannot be read.

    """
    cyclogram = None if program is None else parse_cyclogram(program)
    if not bags:
        return None
    detector = learn_detector(bags) if calibration is None else calibration.detector
    index = best_bag(bags)
    bag = bags[index]
    span_ns = span_of(bag)
    if cyclogram is None and index < len(metadata):
        cyclogram = recorded_program(metadata[index])
    return ShownBag(
        index=index,
        start_ns=span_ns[0],
        board=bag.board,
        case=bag.case,
        trace=thermal_trace(bag.board, bag.case, span_ns, detector),
        cyclogram=cyclogram,
    )


def bag_facts(bag: ReducedBag, truncated: str | None = None) -> BagFacts:
    """
    Describe a bag for the certificate's table.

    Parameters
    ----------
    bag : ReducedBag
        The bag.
    truncated : str or None, optional
        What is missing of it.

    Returns
    -------
    BagFacts
        Its line.

    """
    start_ns, end_ns = span_of(bag)
    remarks = []
    if truncated:
        remarks.append(truncated)
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


def best_bag(bags: Sequence[ReducedBag]) -> int:
    """
    Choose the bag that the time figures show: the widest in temperature, then the longest.

    Parameters
    ----------
    bags : sequence of ReducedBag
        At least one.

    Returns
    -------
    int
        Its place; the first of equals, and spans within 5 % are equal.

    """
    spans = [float(np.ptp(bag.board.value)) if len(bag.board.value) else 0.0 for bag in bags]
    wide = [i for i, span in enumerate(spans) if span >= 0.95 * max(spans)]
    return max(wide, key=lambda i: (round((bags[i].end_ns - bags[i].start_ns) / 60e9), -i))


def recorded_program(metadata: object) -> Cyclogram | None:
    """
    Find the chamber's program in a simulated bag's metadata.

    Parameters
    ----------
    metadata : mapping of str to str
        The bag's metadata; written by others, so nothing in it is believed.

    Returns
    -------
    Cyclogram or None
        The program; None where there is none that can be read.

    """
    text = metadata.get('truth', '') if isinstance(metadata, dict) else ''
    if not isinstance(text, str) or len(text) > 16 * _LONGEST_PROGRAM:
        return None
    try:
        truth = json.loads(text)
    except ValueError:
        return None
    profile = truth.get('profile') if isinstance(truth, dict) else None
    if not isinstance(profile, str) or len(profile) > _LONGEST_PROGRAM:
        return None
    try:
        if profile in CYCLOGRAM_NAMES:
            return cyclogram_preset(profile)
        return parse_cyclogram(profile)
    except ValueError:
        return None


def of_calibration(calibration: Calibration) -> tuple[str, ...]:
    """Give what speaks against a calibration by itself, but for its wish for more positions."""
    lower, upper = calibration.dynamic.rate_range_k_min
    found = [
        f'the dynamic set never saw {name}: its ramps are a guess there'
        for name, rate in (('heating', upper), ('cooling', -lower))
        if rate < _SLOWEST_RAMP_K_MIN
    ]
    if not calibration.has_uncertainty:
        found.append('the calibration says nothing of its uncertainty')
    found += [note for note in calibration.provenance.notes if not note.startswith('positions: ')]
    return tuple(dict.fromkeys(found))


def _serial(bags: Sequence[OpenedBag], calibration: Calibration | None, serial: str | None) -> str:
    if calibration is not None:
        return calibration.unit.serial
    found = sorted(
        {bag.info.metadata['serial'] for bag in bags if bag.info.metadata.get('serial')}
    )
    return serial or ', '.join(found) or 'unknown'
