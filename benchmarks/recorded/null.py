# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the null tests: where there is nothing to find, nothing is found; a wrong unit is noticed.

"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from thermo_comp.fitting.one_pose import PoseOptions, fit_branches, read_pose
from thermo_comp.fitting.partial import recording_source
from thermo_comp.fitting.triad import TriadFit

from thermo_comp.judging import Judgement, evaluate
from thermo_comp.recording import BagWriter
from thermo_comp.unit.calibration import (
    Axes,
    AxisReference,
    AxisSet,
    Calibration,
    Provenance,
    RegimeSet,
    Unit,
)
from thermo_comp.unit.functions import Polynomial

from .data import GRAVITY, samples_of
from .handheld import Handheld

#: Where the board's thermometer stands that is lent to recordings without one.
ROOM_C = 25.0


def small_spans(bag: Path) -> list[tuple[str, str]]:
    """
    Ask for a fit of parts of the freezer run that hardly change; return (part, what was said).

    """
    source, _ = recording_source(bag)
    result = []
    for begin, end in ((1200.0, 1900.0), (1500.0, 1900.0), (367.0, 460.0)):
        pose = read_pose(source, PoseOptions(gravity=GRAVITY, begin_s=begin, end_s=end))
        said = '; '.join(fit.refusal or 'fitted' for fit in fit_branches(pose))
        result.append((f'{begin:.0f}..{end:.0f} s', said))
    return result


def lend_thermometer(source_bag: Path, bag: Path, serial: str) -> Path:
    """
    Copy a recording without temperature, with a board thermometer that stands still.

    """
    source, _ = recording_source(source_bag)
    samples = samples_of(source)
    start_ns = 1_000_000_000
    stamp_ns = start_ns + np.rint(samples.time * 1e9).astype(np.int64)
    board_ns = np.arange(stamp_ns[0], stamp_ns[-1], 1_000_000_000)
    with BagWriter(bag, metadata={'serial': serial}, overwrite=True) as writer:
        writer.write_temperature('temperature/board', board_ns, np.full(len(board_ns), ROOM_C))
        writer.write_imu(
            'imu/uncompensated', stamp_ns, samples.accel, np.zeros((len(stamp_ns), 9)), 'imu'
        )
    return bag


def constant_calibration(fit: TriadFit, unit: Handheld, serial: str) -> Calibration:
    """
    Write nine constants as a calibration, for the sake of the check only.

    """
    rms = float(np.sqrt(np.mean(fit.residual**2)))
    # The biases are the sets': raw is the unit without them.
    x_set, y_set, z_set = (
        AxisSet(
            Polynomial((0.0,)),
            Polynomial((1.0,)),
            delta=float(bias),
            residual_sd_m_s2=rms,
        )
        for bias in fit.bias
    )
    one = RegimeSet(
        # Nobody knows at which temperature they hold: nothing is excused by being out of range.
        temperature_range_c=(-40.0, 85.0),
        rate_range_k_min=(-20.0, 20.0),
        x=x_set,
        y=y_set,
        z=z_set,
    )
    sample_sd = np.median([interval.sample_sd for interval in unit.intervals], axis=0)
    x, y, z = (float(v) for v in sample_sd * np.sqrt(0.01))
    matrix = tuple(tuple(float(v) for v in line) for line in fit.misalignment)
    return Calibration(
        format_version=2,
        unit=Unit(serial, 'm/s^2', 4.0 * GRAVITY, 0.01),
        reference_temperature_c=ROOM_C,
        gravity_m_s2=GRAVITY,
        axes=Axes(*(AxisReference(float(K), 0.0) for K in fit.scale)),
        static=one,
        dynamic=one,
        noise_density_m_s2_sqrt_hz=(x, y, z),
        misalignment=matrix,
        provenance=Provenance(model='constant'),
    )


@dataclass(frozen=True)
class Crossed:
    """
    One unit's data under one unit's calibration.

    """

    data: int
    calibration: int
    rms_mg: float
    verdict: str
    is_valid: bool


def wrong_units(bags: dict[int, Path], units: dict[int, Handheld], work: Path) -> list[Crossed]:
    """
    Judge every unit's recording under every unit's constants with `evaluate`.

    """
    result = []
    for data, bag in bags.items():
        lent = lend_thermometer(bag, work / f'lent{data}.mcap', f'unit-{data}')
        for number, unit in units.items():
            # The serial is made to match: what must notice is the data.
            calibration = constant_calibration(unit.ours, unit, f'unit-{data}')
            result.append(_crossed(data, number, lent, calibration, 1.0))
    return result


def freezer_under_another_unit(bag: Path, unit: Handheld) -> Crossed:
    """
    Judge the freezer run under a handheld unit's constants.

    """
    calibration = constant_calibration(unit.ours, unit, 'freezer-mpu6050')
    return _crossed(-1, unit.unit, bag, calibration, 10.0)


def _crossed(
    data: int, number: int, bag: Path, calibration: Calibration, window_s: float
) -> Crossed:
    found: Judgement = evaluate(
        [bag], [('it', calibration)], gravity=GRAVITY, window_s=window_s, input='imu'
    ).judgements['it']
    rms = found.sections['all'].rms / (GRAVITY * 1e-3)
    return Crossed(data, number, rms, found.verdict, found.is_valid)
