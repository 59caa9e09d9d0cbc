# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Updates calibrations with real recordings, for the benchmark `field.py`.

No recording lasts for days, so each recording is cut into parts: a fit of the first part replaces
the calibration of a laboratory, and each further part counts as the recording of a separate
turn-on. On each part, an update with all earlier parts is compared with the fit of the first part.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from recorded.data import GRAVITY, freezer_bag, handheld_bag

import thermo_comp as tc
from thermo_comp.api import Columns
from thermo_comp.field import gather
from thermo_comp.field.rest import Rest, Start
from thermo_comp.field.series import series_of
from thermo_comp.field.update import update
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.sources import fit_sources
from thermo_comp.online.compensator import Compensator
from thermo_comp.recording.topics import BagPart, Topics
from thermo_comp.unit.calibration import Calibration


def part(of: Columns, begin: float, end: float) -> Columns:
    """Return the part of a recording from `begin` to `end` [s]."""

    def cut(time_s: np.ndarray, *values: np.ndarray) -> tuple[np.ndarray, ...]:
        is_in = (time_s >= begin) & (time_s < end)
        return tuple(column[is_in] for column in (time_s, *values))

    time_s, counts = cut(of.time_s, of.counts)
    temperatures = {name: cut(*both) for name, both in of.temperatures.items()}
    return Columns(time_s, counts, temperatures, of.start_ns, of.serial, of.name)


def rests_of(of: Columns, calibration: Calibration, start_ns: int) -> list[tuple[Start, Rest]]:
    """Return the rests that a node logs if it starts at the beginning of the recording."""
    compensator = Compensator(calibration)
    correction = compensator.thermal.correction
    start = Start(
        start_ns,
        calibration.unit.serial,
        calibration.unit.input,
        calibration.gravity_m_s2,
        'part',
        correction.memory,
    )

    def state_now() -> tuple[tuple[float, ...], list[float]] | None:
        thermal, now_ns = compensator.thermal, compensator.now_ns or 0
        if now_ns > thermal.fresh_until_ns:
            return None
        if thermal.is_unmeasured:
            return (*thermal.sample(now_ns), 0.0, 0.0)[:7], []
        return thermal.sample(now_ns), thermal.tracker.memory.remaining_shares(now_ns)

    finder = gather.RestFinder(
        correction.K[:, 0], np.array(correction.noise), calibration.unit.full_scale, state_now, 0.0
    )
    readings = sorted(
        (int(t * 1e9), name, float(value))
        for name, both in of.temperatures.items()
        for t, value in zip(*both, strict=True)
        if name in ('board', *calibration.sensors)
    )
    collected: list[tuple[Start, Rest]] = []
    for t, sample in zip(of.time_s, of.counts, strict=True):
        stamp = int(t * 1e9)
        while readings and readings[0][0] <= stamp:
            at, name, value = readings.pop(0)
            compensator.push(name, at, value)
        compensator.process(stamp, *sample.tolist())
        collected += [(start, rest) for rest in finder.add(np.array([stamp]), sample[np.newaxis])]
    return collected


def cases(folder: Path, work: Path) -> Iterator[tuple[str, Path, list[float], float]]:
    """Yield name, bag, edges of the parts [s] and length of a window [s] of each recording."""
    # Use the freezer run from the last jump of the readings until the sensor leaves the freezer.
    yield 'freezer', freezer_bag(folder, work), [518.5, *np.arange(900.0, 1941.0, 104.0)], 10.0
    for unit in range(3):
        yield f'handheld {unit}', handheld_bag(folder, work, unit), [0.0, *range(80, 157, 11)], 2.0


def judge_recordings(folder: Path) -> None:
    """Print for each recording the RMS of |f| - g without and with updates by earlier parts."""
    print('\nreal recordings: an update with all earlier parts, judged on the next part')
    with tempfile.TemporaryDirectory() as work:
        for name, bag, edges, window in cases(folder, Path(work)):
            gather.SECONDS = int(window)
            first = Topics(part=BagPart(edges[0], edges[1]))
            options = FitOptions(gravity=GRAVITY, input='m/s^2')
            calibration = fit(fit_sources([bag], first)[0], options).calibration
            whole = tc.read(bag)
            parts = [
                rests_of(part(whole, *both), calibration, int(both[0] * 1e9))
                for both in pairwise(edges[1:])
            ]
            parts = [rests for rests in parts if rests]
            old, new, n_written = [], [], 0
            for k in range(3, len(parts)):
                known = [rest for some in parts[:k] for rest in some]
                updated = update(series_of(known, calibration), calibration)
                n_written += updated.judged.is_better
                best = updated.calibration if updated.judged.is_better else calibration
                for rms, used in ((old, calibration), (new, best)):
                    rms.append(float(np.sqrt(np.mean(series_of(parts[k], used).residual ** 2))))
            mg = [1e3 * np.sqrt(np.mean(np.square(rms))) / GRAVITY for rms in (old, new)]
            n_worse = sum(b > 1.001 * a for a, b in zip(old, new, strict=True))
            print(
                f'  {name:11} {len(old)} updates, {n_written} written: |f| - g of the next part '
                f'{mg[0]:.2f} mg RMS before, {mg[1]:.2f} after; larger on {n_worse} parts'
            )
