# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the way from recordings to a judgement: each is read once, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from ..fitting.options import COUNTS_FULL_SCALE
from ..fitting.reduction import ReducedBag, reduce_source
from ..fitting.sources import digest, recording_source
from ..recording.columns import Input, Role
from ..recording.stillness import STILL_SD
from ..recording.topics import Topics
from ..replay import check_unit, input_for, needed_roles
from ..unit.calibration import Calibration
from ..unit.gravity import STANDARD_GRAVITY
from .judgement import Judgement, judge
from .windows import WINDOW_S, corrected_windows, sum_length

# A unit at rest scatters by no more than this many times what its calibration says of its noise.
_NOISES = 4.0


@dataclass(frozen=True)
class Evaluation:
    """What recordings tell of calibrations, by name; the notes say what was not judged."""

    bags: tuple[ReducedBag, ...]
    judgements: dict[str, Judgement]
    notes: tuple[str, ...]


def open_bags(
    paths: Sequence[str | Path],
    calibrations: Sequence[Calibration] = (),
    *,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    window_s: float = WINDOW_S,
    progress: Callable[[float], None] = lambda _: None,
) -> list[ReducedBag]:
    """
    Read bags for windows of `window_s`, as the first calibration says, else as usual.

    Raises RecordingError if one cannot be read, or has no board temperature where it needs one.
    """
    require: tuple[Role, ...] = ('board',)
    known: dict[str, Any] = {}
    if calibrations:
        unit, require = calibrations[0].unit, needed_roles(*calibrations)
        input = input_for(calibrations[0], input)  # noqa: A001 - as above
        density = max(calibrations[0].noise_density_m_s2_sqrt_hz) / STANDARD_GRAVITY
        noise = _NOISES / np.sqrt(unit.cycle_time_s) * density
        known = {'full_scale': unit.full_scale, 'still_sd': max(STILL_SD, noise)}
    found: list[ReducedBag] = []
    for path in paths:

        def told(part: float) -> None:
            progress((len(found) + part) / len(paths))

        source, info = recording_source(path, topics, input, require=require, progress=told)
        usual = {'full_scale': None if info.input == 'imu' else COUNTS_FULL_SCALE}
        source = replace(source, sha256=digest(Path(path)))
        bag = reduce_source(source, window_s=sum_length(window_s), **(usual | known))
        if 'board' in require and not len(bag.board.value):
            raise RecordingError('no board temperature in it', path=str(path))
        found.append(bag)
    return found


def judge_bags(
    bags: Sequence[ReducedBag],
    calibration: Calibration,
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
    tolerance: float | None = None,
) -> Judgement | None:
    """Judge a calibration on reduced bags; None where no window was corrected."""
    windows = corrected_windows(bags, calibration, gravity=gravity, window_s=window_s)
    known = {source.sha256 for source in calibration.provenance.sources if source.sha256}
    is_seen = all(bag.source.sha256 in known for bag in bags)
    return judge(windows, calibration, tolerance, is_seen=is_seen) if len(windows) else None


def evaluate(
    paths: Sequence[str | Path],
    calibrations: Sequence[tuple[str, Calibration]],
    *,
    gravity: float | None = None,
    window_s: float = WINDOW_S,
    tolerance: float | None = None,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    serial: str | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Evaluation:
    """
    Judge one or more calibrations of a unit, given with their names, on its recordings.

    Local gravity and what is read are those of the first calibration by default; `tolerance` is
    the largest RMS that is accepted [m/s^2]; of `serial` see `replay.check_unit`.

    Raises RecordingError if one cannot be read, or none rests for a window; CalibrationError if a
    calibration is for another unit.
    """
    if not paths or not calibrations:
        raise ValueError('`paths` and `calibrations` must hold at least one each')
    models = [one for _, one in calibrations]
    gravity = models[0].gravity_m_s2 if gravity is None else gravity
    bags = open_bags(
        paths, models, topics=topics, input=input, window_s=window_s, progress=progress
    )
    for bag in bags:
        for one in models:
            check_unit(one, bag.info, serial)
    judgements = {}
    for name, calibration in calibrations:
        judgement = judge_bags(
            bags, calibration, gravity=gravity, window_s=window_s, tolerance=tolerance
        )
        if judgement is None:
            raise RecordingError(
                f'no window of {window_s:g} s at rest was corrected: nothing to judge',
                path=', '.join(map(str, paths)),
            )
        judgements[name] = judgement
    judged = set(next(iter(judgements.values())).windows.bag.tolist())
    notes = tuple(
        f'{path}: no window of {window_s:g} s at rest was corrected: not judged'
        for number, path in enumerate(paths)
        if number not in judged
    )
    return Evaluation(tuple(bags), judgements, notes)
