# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the evaluation of calibrations on recordings, and the history of a unit's calibrations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from ..fitting.joining import joined
from ..fitting.options import COUNTS_FULL_SCALE
from ..fitting.raw_checks import constant_axes, in_kelvins
from ..fitting.reduction import ReducedBag, reduce_source
from ..fitting.sources import ForceOptions, digest, recording_source
from ..recording.blocks import Role
from ..recording.stillness import STILL_SD
from ..recording.topics import Topics
from ..replay import check_unit, needed_roles, topics_for
from ..typing import Floats
from ..unit.calibration import AXES, Calibration
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from ..unit.prediction import in_a_soak
from ..unit.provenance import Source
from .judgement import SIGNIFICANT_SDS, Judgement, judge
from .windows import WINDOW_S, corrected_windows, sum_length

# Largest accepted ratio of a unit's scatter at rest to the noise that its calibration states.
_LARGEST_NOISE_RATIO = 4.0
# Sd of the calibrated noise of a sample / converter step, above which constant samples in a rest
# are a fault.
_DEAD_NOISE = 0.5


@dataclass(frozen=True)
class Evaluation:
    """Bags, judgement of each calibration by its name, and notes on bags that were not judged."""

    bags: tuple[ReducedBag, ...]
    judgements: dict[str, Judgement]
    notes: tuple[str, ...]


def open_bags(
    paths: Sequence[str | Path],
    calibrations: Sequence[Calibration] = (),
    *,
    topics: Topics | None = None,
    window_s: float = WINDOW_S,
    force: ForceOptions | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> list[ReducedBag]:
    """
    Read bags for windows of `window_s`; the first calibration, if any, sets topics and full scale.

    Raises RecordingError if a bag cannot be read, is given twice, has a dead axis or temperatures
    in kelvins, or lacks a board temperature that is needed.
    """
    require: tuple[Role, ...] = ('board',)
    limits: dict[str, Any] = {}
    if calibrations:
        unit, require = calibrations[0].unit, needed_roles(*calibrations)
        topics = topics_for(calibrations[0], topics)
        density = max(calibrations[0].noise_density_m_s2_sqrt_hz) / STANDARD_GRAVITY
        noise = _LARGEST_NOISE_RATIO / np.sqrt(unit.cycle_time_s) * density
        limits = {'full_scale': unit.full_scale, 'still_sd': max(STILL_SD, noise)}
    bags: list[ReducedBag] = []
    for path in paths:

        def report(part: float) -> None:
            progress((len(bags) + part) / len(paths))

        source, info = recording_source(
            path, topics, require=require, progress=report, force=force
        )
        default = {'full_scale': None if info.input == 'imu' else COUNTS_FULL_SCALE}
        source = replace(source, sha256=digest(Path(path)))
        for other, other_path in zip(bags, paths, strict=False):
            if other.source.sha256 == source.sha256:
                raise RecordingError(f'has the same content as {other_path}: give only one', path)
        bag = reduce_source(source, window_s=sum_length(window_s), **(default | limits))
        if 'board' in require and not len(bag.board.value):
            raise RecordingError(
                'no reading of the board temperature: name the topic with --topic board=TOPIC',
                path=str(path),
            )
        if text := in_kelvins(bag):
            raise RecordingError(text, path=str(path))
        if calibrations and (dead := _dead_axes(bag, calibrations[0])):
            raise RecordingError(f'dead axis: {dead}', path=str(path))
        bags.append(bag)
    return joined(bags)


def _dead_axes(bag: ReducedBag, calibration: Calibration) -> str:
    """Describe axes with constant samples in a rest despite noise that would change them."""
    if not any(rest.sample_sd.any() for rest in bag.intervals):
        return ''  # a converter without visible noise: its step is unknown
    unit, density = calibration.unit, np.array(calibration.noise_density_m_s2_sqrt_hz)
    noise, step = density / np.sqrt(unit.cycle_time_s), bag.step
    if unit.input == 'counts':
        noise *= [abs(axis.scale_factor) for axis in calibration.axes]
        step = max(step, 1.0)
    return '; '.join(axis.text for axis in constant_axes([bag], noise > _DEAD_NOISE * step))


def judge_bags(
    bags: Sequence[ReducedBag],
    calibration: Calibration,
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
    tolerance: float | None = None,
) -> Judgement | None:
    """Judge a calibration on bags; return None if no window was corrected."""
    windows = corrected_windows(bags, calibration, gravity=gravity, window_s=window_s)
    fitted = {source.sha256 for source in calibration.provenance.sources if source.sha256}
    is_seen = all(source.sha256 in fitted for bag in bags for source in bag.sources)
    return judge(windows, calibration, tolerance, is_seen=is_seen) if len(windows) else None


def evaluate(
    paths: Sequence[str | Path],
    calibrations: Sequence[tuple[str, Calibration]],
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
    tolerance: float | None = None,
    topics: Topics | None = None,
    serial: str | None = None,
    force: ForceOptions | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Evaluation:
    """
    Judge calibrations of a unit, given with their names, on recordings of the unit.

    Gravity [m/s^2] and topics default to the first calibration's; `tolerance`: largest
    accepted RMS of ``|f| - g`` [m/s^2]; `serial`: serial of the unit (None: the serial in the
    recordings; '': any serial); `force`: the user's options about rests at which |f| is not g.

    Raises RecordingError if a recording cannot be read, or no window at rest is corrected, and
    CalibrationError if a calibration is for another unit.
    """
    models = [model for _, model in calibrations]
    gravity = models[0].gravity_m_s2 if gravity is None else gravity
    bags = open_bags(
        paths, models, topics=topics, window_s=window_s, force=force, progress=progress
    )
    for bag in bags:
        for model in models:
            check_unit(model, bag.info, serial)
    judgements = {}
    for name, calibration in calibrations:
        judgement = judge_bags(
            bags, calibration, gravity=gravity, window_s=window_s, tolerance=tolerance
        )
        if judgement is None:
            raise RecordingError(
                f'no window of {window_s:g} s at rest was corrected: nothing to judge; record '
                'rests longer than a window (--window), with temperatures',
                path=', '.join(map(str, paths)),
            )
        judgements[name] = judgement
    judged = set(next(iter(judgements.values())).windows.bag.tolist())
    notes = tuple(
        f'{bag.info.path}: no window of {window_s:g} s at rest was corrected: not judged'
        for number, bag in enumerate(bags)
        if number not in judged
    )
    return Evaluation(tuple(bags), judgements, notes)


@dataclass(frozen=True)
class Epoch:
    """
    Constants of a calibration in a soak at the reference temperature of the unit's first
    calibration, shape (6,): bias of x, y, z [ug], then change of the scale of x, y, z since the
    first calibration [ppm]. An unknown sd is NaN.
    """

    date: str
    value: Floats
    sd: Floats


@dataclass(frozen=True)
class Drift:
    """The change of a constant between two calibrations, significant if beyond three sd."""

    earlier: str
    later: str
    constant: str
    unit: str
    change: float
    sd: float

    @property
    def is_sure(self) -> bool:
        """Whether the change exceeds three standard deviations (`sd`)."""
        return abs(self.change) > SIGNIFICANT_SDS * self.sd


def history_of(calibrations: Sequence[Calibration]) -> tuple[Epoch, ...]:
    """
    Sort by date the calibrations with the serial number of the first given calibration. A second
    calibration from the same bags is left out, because it shows no change in time.
    """
    seen: set[tuple[Source, ...]] = set()
    ordered: list[Calibration] = []
    for cal in calibrations:
        sources = cal.provenance.sources
        if cal.unit.serial == calibrations[0].unit.serial and not (sources and sources in seen):
            ordered.append(cal)
        seen.add(sources)
    ordered.sort(key=lambda cal: (cal.provenance.date, cal.provenance.created))
    epochs: list[Epoch] = []
    first = np.ones(3)
    for number, cal in enumerate(ordered):
        bias, bias_sd, scale, scale_sd = in_a_soak(cal, ordered[0].reference_temperature_c)
        first = first if number else scale
        value = np.concatenate((bias / MICRO_G, 1e6 * (scale / first - 1.0)))
        sd = np.concatenate((bias_sd / MICRO_G, 1e6 * scale_sd))
        date = cal.provenance.date or f'no. {number + 1}'
        epochs.append(Epoch(date, value, sd if cal.has_uncertainty else np.full(6, np.nan)))
    return tuple(epochs)


def drifts_of(history: Sequence[Epoch]) -> list[Drift]:
    """List the changes from each calibration to the next; errors are taken as independent."""
    return [
        Drift(
            earlier=before.date,
            later=after.date,
            constant=f'{"scale" if k // 3 else "bias"} {AXES[k % 3]}',
            unit='ppm' if k // 3 else 'ug',
            change=float(after.value[k] - before.value[k]),
            sd=float(np.hypot(before.sd[k], after.sd[k])),
        )
        for before, after in pairwise(history)
        for k in range(6)
    ]
