# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Converts recordings that other people made to bags."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from thermo_comp.convert.column_map import Accel, ColumnMap, load_column_map, table_log
from thermo_comp.convert.log import write_log
from thermo_comp.convert.table import Stamp

from . import ROOT

GRAVITY = 9.80665
FREEZER = 'freezer-mpu6050/temp-calibration.csv'
HANDHELD = 'mikoff-mpu9150/mk_imu{}.log'
FACES = 'ferraris/annotated_session.csv'
#: Sampling rate of the Ferraris session, from its authors' documentation [Hz].
FACES_RATE_HZ = 204.8


def freezer_bag(folder: Path, work: Path) -> Path:
    """Convert the recording of an MPU-6050 in a freezer with the project's column map."""
    bag = work / 'freezer.mcap'
    columns = load_column_map(ROOT / 'config' / 'columns' / 'freezer.yaml')
    write_log(table_log(folder / FREEZER, columns), bag, force=True)
    return bag


def handheld_bag(folder: Path, work: Path, unit: int) -> Path:
    """Convert the recording of handheld MPU-9150 number `unit` with the project's column map."""
    bag = work / f'handheld{unit}.mcap'
    columns = load_column_map(ROOT / 'config' / 'columns' / 'handheld.yaml')
    columns = replace(columns, serial=f'mpu9150-{unit}')
    write_log(table_log(folder / HANDHELD.format(unit), columns), bag, force=True)
    return bag


def faces_bag(folder: Path, work: Path) -> Path:
    """Convert the counts of the Ferraris session (rests on six faces); ignore its annotations."""
    bag = work / 'faces.mcap'
    columns = ColumnMap(
        serial='ferraris',
        stamp=Stamp(rate_hz=FACES_RATE_HZ),
        accel=Accel(('acc_x', 'acc_y', 'acc_z'), 'counts', 'counts', counts_per_g=2048.0),
    )
    write_log(table_log(folder / FACES, columns), bag, force=True)
    return bag
