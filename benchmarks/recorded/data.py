# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from the recordings' own files to bags and sources.

"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thermo_comp.convert import load_column_map, table_log, write_log
from thermo_comp.convert.columns import Accel, ColumnMap, Stamp
from thermo_comp.fitting.reduction import ReducedBag, reduce_source
from thermo_comp.fitting.sources import FitSource
from thermo_comp.typing import Floats

from . import ROOT

GRAVITY = 9.80665
FREEZER = 'freezer-mpu6050/temp-calibration.csv'
HANDHELD = 'mikoff-mpu9150/mk_imu{}.log'
FACES = 'ferraris/annotated_session.csv'
#: Sampling rate of the Ferraris session, from its authors' documentation [Hz].
FACES_RATE_HZ = 204.8


def freezer_bag(folder: Path, work: Path) -> Path:
    """
    Convert the freezer run with the column map that ships with the project.

    """
    bag = work / 'freezer.mcap'
    columns = load_column_map(ROOT / 'config' / 'columns' / 'freezer.yaml')
    write_log(table_log(folder / FREEZER, columns), bag, force=True)
    return bag


def freezer_column(folder: Path, name: str) -> Floats:
    """
    Read one column of the freezer run as it is.

    """
    with (folder / FREEZER).open(newline='') as file:
        return np.array([float(row[name]) for row in csv.DictReader(file)])


def handheld_bag(folder: Path, work: Path, unit: int) -> Path:
    """
    Convert one handheld unit with the column map that ships with the project.

    """
    bag = work / f'handheld{unit}.mcap'
    columns = load_column_map(ROOT / 'config' / 'columns' / 'handheld.yaml')
    columns = replace(columns, serial=f'mpu9150-{unit}')
    write_log(table_log(folder / HANDHELD.format(unit), columns), bag, force=True)
    return bag


def faces_bag(folder: Path, work: Path) -> Path:
    """
    Convert the Ferraris session: its annotations are not read, only its counts.

    """
    bag = work / 'faces.mcap'
    columns = ColumnMap(
        serial='ferraris',
        stamp=Stamp(rate_hz=FACES_RATE_HZ),
        accel=Accel(('acc_x', 'acc_y', 'acc_z'), 'counts', 'counts', counts_per_g=2048.0),
    )
    write_log(table_log(folder / FACES, columns), bag, force=True)
    return bag


@dataclass(frozen=True)
class Samples:
    """
    A recording's accelerometer in memory.

    """

    time: Floats
    accel: Floats


def samples_of(source: FitSource) -> Samples:
    """
    Read all samples of a source; time counts from its first one [s].

    """
    blocks = list(source.blocks())
    stamp_ns = np.concatenate([block.accel_stamp_ns for block in blocks])
    accel = np.concatenate([block.accel for block in blocks])
    return Samples((stamp_ns - stamp_ns[0]) * 1e-9, accel)


def still_bag(source: FitSource, min_still_s: float = 2.0, window_s: float = 1.0) -> ReducedBag:
    """
    Find the still intervals of a recording turned by hand, in windows of one second.

    """
    return reduce_source(
        source, 0, window_s=window_s, cell_s=0.5, min_still_s=min_still_s, full_scale=None
    )
