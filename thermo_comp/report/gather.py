# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from bags, with or without a calibration, to a report's evidence.

Bags are read block by block and reduced to windows at rest, as the fit does; nothing of the size
of a bag's samples stays in memory. Reading and judging are apart, so that a viewer reads a bag
once and judges it anew whenever the calibration changes.

"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..fitting import FitOptions, FitSource
from ..fitting.fit_sources import digest
from ..fitting.options import COUNTS_FULL_SCALE
from ..fitting.reduction import ReducedBag, reduce_source
from ..fitting.sensors import learn_detector
from ..recording import Block, Input, RecordingInfo, Topics, open_recording
from ..replay import check_unit
from ..simulation import CYCLOGRAM_NAMES, Cyclogram, cyclogram_preset, parse_cyclogram
from ..thermal import tracker as thermal
from ..thermal.settings import DetectorSettings
from ..typing import Floats, Ints
from ..unit.calibration import Calibration
from ..unit.correction import Correction
from ..unit.gravity import STANDARD_GRAVITY
from .evidence import CHOSEN, RAW, STATIC_ALONE, BagFacts, Evidence, ShownBag, Windows
from .trace import ThermalTrace, thermal_trace

Progress = Callable[[float], None]

# A recorded program is text that somebody else wrote; no real one is longer.
_LONGEST_PROGRAM = 4096
_STANDARD = FitOptions(gravity=STANDARD_GRAVITY)


@dataclass(frozen=True)
class OpenedBag:
    """
    A bag that was read once.

    Parameters
    ----------
    info : RecordingInfo
        What it holds.
    reduced : ReducedBag
        Its windows at rest and its temperature readings.
    span_ns : (int, int)
        First and last stamp of samples and readings.

    """

    info: RecordingInfo
    reduced: ReducedBag
    span_ns: tuple[int, int]


def open_bag(
    path: str | Path,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    *,
    number: int = 0,
    full_scale: float | None = None,
    progress: Progress | None = None,
) -> OpenedBag:
    """
    Read one bag, in bounded memory.

    Parameters
    ----------
    path : str or Path
        The bag; it needs a board temperature, the rest may be missing.
    topics : Topics or None, optional
        Names of the inputs.
    input : {'auto', 'counts', 'imu'}, optional
        Which accelerometer topic is read.
    number : int, optional
        Its place among several.
    full_scale : float or None, optional
        Magnitude of a saturated sample; None takes 32767 for counts.
    progress : callable or None, optional
        Told the fraction read.

    Returns
    -------
    OpenedBag
        The bag.

    Raises
    ------
    RecordingError
        If it cannot be read or has no board temperature.

    """
    path = Path(path)
    with open_recording(path, topics, input, require=['board']) as reader:
        info = reader.info
        if full_scale is None and info.input != 'imu':
            full_scale = COUNTS_FULL_SCALE
        name = reader.topics.get('accel')
        total = info.topics[name][1] if name else 0
        source = FitSource(
            name=path.name,
            blocks=lambda: _told(reader.blocks(), total, progress),
            sha256=digest(path),
            serial=info.metadata.get('serial'),
        )
        reduced = reduce_source(
            source,
            number,
            window_s=_STANDARD.window_s,
            cell_s=_STANDARD.cell_s,
            min_still_s=_STANDARD.min_still_s,
            full_scale=full_scale,
        )
    if not len(reduced.board.value):
        raise RecordingError('no board temperature in it: nothing to report', path=str(path))
    return OpenedBag(info, reduced, span_of(reduced))


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
    ValueError
        If `program` cannot be read.

    """
    if calibration is not None:
        for bag in bags:
            check_unit(calibration, bag.info, serial)
        gravity = calibration.gravity_m_s2 if gravity is None else gravity
    detector = (
        learn_detector([bag.reduced for bag in bags])
        if calibration is None
        else calibration.detector
    )
    cyclogram = None if program is None else parse_cyclogram(program)
    parts: list[tuple[ThermalTrace, _BagWindows]] = [
        _judge(bag, number, calibration, detector) for number, bag in enumerate(bags)
    ]
    shown = None
    if bags:
        index = best_bag([bag.reduced for bag in bags])
        bag = bags[index]
        shown = ShownBag(
            index=index,
            start_ns=bag.span_ns[0],
            board=bag.reduced.board,
            case=bag.reduced.case,
            trace=parts[index][0],
            cyclogram=cyclogram or recorded_program(bag.info.metadata),
        )
    unit = 'counts'
    if calibration is not None:
        unit = calibration.unit.input
    elif any(bag.info.input == 'imu' for bag in bags):
        unit = 'm/s^2'
    return Evidence(
        serial=_serial(bags, calibration, serial),
        unit=unit,
        gravity=gravity,
        calibration=calibration,
        bags=tuple(bag_facts(bag.reduced, bag.info.truncated) for bag in bags),
        shown=shown,
        windows=_join([part for _, part in parts], calibration, unit),
        findings=_notes(calibration),
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


@dataclass(frozen=True)
class _BagWindows:
    number: int
    position: Ints
    time: Floats
    mean: Floats
    states: tuple[Floats, ...]


def _judge(
    bag: OpenedBag, number: int, calibration: Calibration | None, detector: DetectorSettings
) -> tuple[ThermalTrace, _BagWindows]:
    reduced = bag.reduced
    intervals = reduced.intervals
    time = np.concatenate([i.time for i in intervals]) if intervals else np.zeros(0)
    start_ns = bag.span_ns[0]
    trace, states = thermal_trace(
        reduced.board,
        reduced.case,
        bag.span_ns,
        detector,
        memory_time_constants_s=() if calibration is None else calibration.memory_time_constants_s,
        query_ns=start_ns + np.rint(time * 1e9).astype(np.int64),
    )
    counts = [len(interval.time) for interval in intervals]
    return trace, _BagWindows(
        number=number,
        position=np.repeat(np.arange(len(intervals)), counts),
        time=time,
        mean=np.concatenate([i.mean for i in intervals]) if intervals else np.zeros((0, 3)),
        states=states,
    )


def _join(parts: Sequence[_BagWindows], calibration: Calibration | None, unit: str) -> Windows:
    first = 0
    positions = []
    for part in parts:
        positions.append(part.position + first)
        first += int(part.position[-1]) + 1 if len(part.position) else 0
    if not parts:
        return Windows(
            *(np.zeros(0, np.int64),) * 2, *_EMPTY, np.zeros(0), np.zeros(0, np.bool_), {}
        )
    states = tuple(
        np.concatenate(column) for column in zip(*(p.states for p in parts), strict=True)
    )
    mean = np.concatenate([part.mean for part in parts])
    known = np.isfinite(states[thermal.BOARD])
    states = tuple(column[known] for column in states)
    mean = mean[known]
    forces: dict[str, Floats] = {}
    if calibration is not None:
        forces = _ladder(calibration, mean, states)
    elif unit == 'm/s^2':
        forces = {RAW: mean}
    return Windows(
        bag=np.concatenate([np.full(len(p.time), p.number) for p in parts])[known],
        position=np.concatenate(positions)[known],
        time=np.concatenate([part.time for part in parts])[known],
        mean=mean,
        board=states[thermal.BOARD],
        is_dynamic=np.asarray(states[thermal.WEIGHT] > 0.5),
        forces=forces,
    )


_EMPTY = (np.zeros(0), np.zeros((0, 3)))


def _ladder(
    calibration: Calibration, mean: Floats, states: tuple[Floats, ...]
) -> dict[str, Floats]:
    """
    Specific force without temperature, with the static set alone, and as calibrated.

    """
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    bias = np.array([axis.bias for axis in axes])
    K = np.array([axis.scale_factor for axis in axes])
    M = np.array(calibration.misalignment)
    correction = Correction(calibration)

    def corrected(state: tuple[Floats, ...]) -> Floats:
        columns = [(mean[:, i] - b) / s for i, (b, s) in enumerate(correction.bias_scale(state))]
        return np.asarray(np.column_stack(columns) @ M.T)

    blind = list(states)
    blind[thermal.WEIGHT] = np.zeros(len(mean))
    forces = {RAW: np.asarray((mean - bias) / K @ M.T)}
    if calibration.static != calibration.dynamic:
        forces[STATIC_ALONE] = corrected(tuple(blind))
    forces[CHOSEN] = corrected(states)
    return forces


def _notes(calibration: Calibration | None) -> tuple[str, ...]:
    """
    Give what the fit had to say against the calibration, but for its wish for more positions.

    """
    notes = () if calibration is None else calibration.provenance.notes
    return tuple(note for note in notes if not note.startswith('positions: '))


def _serial(bags: Sequence[OpenedBag], calibration: Calibration | None, serial: str | None) -> str:
    if calibration is not None:
        return calibration.unit.serial
    found = sorted(
        {bag.info.metadata['serial'] for bag in bags if bag.info.metadata.get('serial')}
    )
    return serial or ', '.join(found) or 'unknown'


def _told(blocks: Iterator[Block], total: int, progress: Progress | None) -> Iterator[Block]:
    n_read = 0
    for block in blocks:
        yield block
        n_read += len(block)
        if progress is not None and total:
            progress(min(n_read / total, 1.0))
