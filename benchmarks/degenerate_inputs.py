# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Makes degenerate inputs: recordings and tables, each with the defect that its name states."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from damaged_files import bomb, cut, damaged, delete_rows, flip, flip_message, wipe
from pyarrow import parquet
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from thermo_comp.recording.writer import BagWriter

SECOND, YEAR = 10**9, 366 * 86400 * 10**9
START_NS = 1_767_225_600 * SECOND
RATE_HZ, POSITIONS, POSITION_S = 20, 10, 40


@dataclass
class Columns:
    """A recording during one temperature ramp, with a rest in each of several attitudes."""

    stamp_ns: np.ndarray
    counts: np.ndarray
    reading_ns: np.ndarray
    board: np.ndarray
    topic: str = 'accel/counts'
    frame_id: str = 'imu'
    serial: str = 'T-1'


def whole() -> Columns:
    """Make a recording without a defect, from which the degenerate inputs are derived."""
    rng = np.random.default_rng(20)
    n = RATE_HZ * POSITIONS * POSITION_S
    row = np.arange(n)
    up = rng.normal(size=(POSITIONS, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    counts = np.rint(2900.0 * up[row // (RATE_HZ * POSITION_S)] + rng.normal(size=(n, 3)))
    stamp_ns = START_NS + row * (SECOND // RATE_HZ)
    reading_ns = stamp_ns[:: RATE_HZ // 2]
    board = 10.0 + 30.0 * np.arange(len(reading_ns)) / len(reading_ns)
    return Columns(stamp_ns, counts, reading_ns, board)


def write(folder: Path, columns: Columns, name: str = 'bag.mcap', log: bool = False) -> Path:
    """Write a bag; with `log` the log times have equal steps and do not depend on the stamps."""
    path = folder / name
    rising = START_NS + np.arange(len(columns.stamp_ns)) * (SECOND // RATE_HZ) if log else None
    slow = None if rising is None else rising[:: RATE_HZ // 2][: len(columns.reading_ns)]
    with BagWriter(path, metadata={'serial': columns.serial}) as bag:
        bag.write_counts(
            columns.topic, columns.stamp_ns, columns.counts, columns.frame_id, log_ns=rising
        )
        for topic, offset in (('temperature/board', 0.0), ('temperature/case', 0.5)):
            bag.write_temperature(topic, columns.reading_ns, columns.board + offset, log_ns=slow)
    return path


def stamps(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], Path]:
    """Return a function that writes a recording whose stamps `change` has altered."""

    def make(folder: Path) -> Path:
        columns = whole()
        columns.stamp_ns = change(columns.stamp_ns).astype(np.int64)
        columns.reading_ns = change(columns.reading_ns).astype(np.int64)
        return write(folder, columns, log=True)

    return make


def changed(change: Callable[[Columns], object]) -> Callable[[Path], Path]:
    """Return a function that writes a recording whose columns `change` has altered."""

    def make(folder: Path) -> Path:
        columns = whole()
        change(columns)
        return write(folder, columns)

    return make


def imu(
    change: Callable[[np.ndarray], np.ndarray], claimed: float = 0.0
) -> Callable[[Path], Path]:
    """
    Return a function that writes sensor_msgs/Imu with changed samples [m/s^2]; `claimed` is the
    first element of linear_acceleration_covariance.
    """

    def make(folder: Path) -> Path:
        columns, path = whole(), folder / 'bag.mcap'
        force = change(columns.counts * (9.80665 / 2900.0))
        with BagWriter(path, metadata={'serial': columns.serial}) as bag:
            bag.write_imu('imu/data', columns.stamp_ns, force, [claimed] + 8 * [0.0])
            bag.write_temperature('temperature/board', columns.reading_ns, columns.board)
        return path

    return make


def _with_zero_rows(force: np.ndarray) -> np.ndarray:
    """Set every second sample to zero, as in a log whose every second row is of the gyroscope."""
    return force * (np.arange(len(force)) % 2)[:, None]


def _without_gravity(force: np.ndarray) -> np.ndarray:
    """Subtract from the samples of each position their mean, which is gravity."""
    positions = force.reshape(POSITIONS, -1, 3)
    return (positions - positions.mean(axis=1, keepdims=True)).reshape(-1, 3)


def _moved(sd: float, longest_s: float) -> Callable[[np.ndarray], np.ndarray]:
    """Add noise of `sd` [m/s^2], as on an arm or in a car, except for `longest_s` in each 20 s."""

    def change(force: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(9)
        is_moved = np.arange(len(force)) % (20 * RATE_HZ) > longest_s * RATE_HZ
        return force + sd * is_moved[:, None] * rng.normal(size=force.shape)

    return change


def _misaligned(force: np.ndarray) -> np.ndarray:
    """Set y to 0.6 x + 0.9 y: a misalignment larger than that of any real triad."""
    return force @ np.array([[1.0, 0.6, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]])


def _jumping(size_ns: int, every: int = 0) -> Callable[[np.ndarray], np.ndarray]:
    """Add a jump [ns] to the stamps: in the middle or, if `every` > 0, after each `every` rows."""

    def change(stamp_ns: np.ndarray) -> np.ndarray:
        row = np.arange(len(stamp_ns))
        jumps = row // every if every else (row >= len(row) // 2).astype(np.int64)
        return stamp_ns + size_ns * jumps

    return change


def rosbag2(storage: StoragePlugin, mode: CompressionMode | None) -> Callable[[Path], Path]:
    """Return a function that writes a recording without a defect as rosbag2."""

    def make(folder: Path) -> Path:
        bare = write(folder, whole())
        writer = Writer2(folder / 'bag', version=9, storage_plugin=storage)
        if mode is not None:
            writer.set_compression(mode, CompressionFormat.ZSTD)
        with Reader2(bare) as reader, writer:
            typestore = get_typestore(Stores.ROS2_JAZZY)
            made = {
                c.id: writer.add_connection(c.topic, c.msgtype, typestore=typestore)
                for c in reader.connections
            }
            for connection, log_ns, data in reader.messages():
                writer.write(made[connection.id], log_ns, data)
        bare.unlink()
        return folder / 'bag'

    return make


DB3 = rosbag2(StoragePlugin.SQLITE3, None)
ZSTD = rosbag2(StoragePlugin.MCAP, CompressionMode.FILE)


def with_pipe(folder: Path) -> Path:
    """Put a FIFO beside the files of a bag, and replace the bag's metadata by a second FIFO."""
    bag = DB3(folder)
    (bag / 'metadata.yaml').unlink()
    os.mkfifo(bag / 'metadata.yaml')
    os.mkfifo(bag / 'other.mcap')
    return bag


def pipe_as_file(folder: Path) -> Path:
    """Make a folder whose only file is a FIFO."""
    bag = folder / 'bag'
    bag.mkdir()
    os.mkfifo(bag / 'bag_0.mcap')
    return bag


def device_as_file(folder: Path) -> Path:
    """Make a bag whose file is a link to /dev/zero, a device without an end."""
    bag = folder / 'bag'
    bag.mkdir()
    (bag / 'bag_0.db3').symlink_to('/dev/zero')
    return bag


def other_name(folder: Path) -> Path:
    """Give a bag a name that is not UTF-8."""
    path = Path(os.fsdecode(os.fsencode(folder) + b'/b\xe9\xff.mcap'))
    return write(folder, whole()).rename(path)


def table(change: Callable[[np.ndarray], np.ndarray], kind: str) -> Callable[[Path], Path]:
    """Return a function that writes a table whose stamps `change` has altered."""

    def make(folder: Path) -> Path:
        columns = whole()
        stamp = change(columns.stamp_ns)
        celsius = np.interp(columns.stamp_ns, columns.reading_ns, columns.board)
        if kind == 'csv':
            path = folder / 'log.csv'
            rows = zip(stamp.tolist(), columns.counts.tolist(), celsius.tolist(), strict=True)
            text = (f'{s},{c[0]},{c[1]},{c[2]},{t},{t}\n' for s, c, t in rows)
            path.write_text(''.join(text), encoding='ascii')
            return path
        path = folder / 'log.parquet'
        values = [stamp, *columns.counts.T, celsius, celsius]
        named = {f'c{i}': pa.array(v) for i, v in enumerate(values)}
        parquet.write_table(pa.table(named), path)
        return path

    return make


def _set(name: str, value: object) -> Callable[[Columns], object]:
    return lambda columns: setattr(columns, name, value)


def _value(columns: Columns, value: float) -> None:
    columns.counts[len(columns.counts) // 3] = value


def _readings(columns: Columns, n: int) -> None:
    columns.reading_ns, columns.board = columns.reading_ns[:n], columns.board[:n]


def _at_one_stamp(columns: Columns) -> None:
    columns.reading_ns = np.full_like(columns.reading_ns, START_NS)


def _samples(columns: Columns, n: int) -> None:
    columns.stamp_ns, columns.counts = columns.stamp_ns[:n], columns.counts[:n]


@dataclass(frozen=True)
class Input:
    """
    A degenerate input; `is_lost`: some data of the input cannot be read, so that a command that
    ends with exit code 0 is wrong.
    """

    make: Callable[[Path], Path]
    is_lost: bool = False


INPUTS: dict[str, Input] = {
    'whole': Input(changed(lambda _: None)),
    'jump of a year': Input(stamps(_jumping(YEAR))),
    'jump from 1970': Input(
        stamps(lambda s: np.where(s < s[len(s) // 2], s - START_NS + SECOND, s))
    ),
    'jump back by a year': Input(stamps(_jumping(-YEAR))),
    'a day between samples': Input(stamps(lambda s: START_NS + (s - START_NS) * 17280 // 500)),
    'an hour after every ten samples': Input(stamps(_jumping(3600 * SECOND, 10))),
    'reversed stamps': Input(stamps(lambda s: s[::-1])),
    'equal stamps': Input(stamps(np.zeros_like)),
    'stamps of the limits': Input(stamps(lambda s: np.where(s < s[50], 0, (2**31 - 1) * SECOND))),
    'one sample': Input(changed(lambda c: _samples(c, 1))),
    'no sample': Input(changed(lambda c: _samples(c, 0))),
    'one reading': Input(changed(lambda c: _readings(c, 1))),
    'readings of one stamp': Input(changed(_at_one_stamp)),
    'a value of 1e308': Input(changed(lambda c: _value(c, 1e308))),
    'all values 1e308': Input(changed(lambda c: _set('counts', c.counts * 0 + 1e308)(c))),
    'a reading of 1e308': Input(changed(lambda c: c.board.__setitem__(9, 1e308))),
    'all NaN': Input(changed(lambda c: _set('counts', c.counts * np.nan)(c))),
    'zeros in every second row': Input(imu(_with_zero_rows)),
    'no acceleration in the messages': Input(imu(np.zeros_like, -1.0)),
    'gravity subtracted': Input(imu(_without_gravity)),
    'samples in g': Input(imu(lambda force: force / 9.80665)),
    'stamps all zero': Input(stamps(np.zeros_like)),
    'worn on a wrist': Input(imu(_moved(4.0, 2.9))),
    'a drive in a car': Input(imu(_moved(1.5, 0.0))),
    'axes not orthogonal': Input(imu(_misaligned)),
    'all zeros': Input(changed(lambda c: _set('counts', c.counts * 0)(c))),
    'a span of 1 K': Input(changed(lambda c: _set('board', 20 + c.board / 30)(c))),
    'Cyrillic serial': Input(changed(_set('serial', 'блок 7'))),
    'name not UTF-8': Input(other_name),
    'db3': Input(DB3),
    'db3 with a flipped bit': Input(damaged(DB3, '*.db3', flip), is_lost=True),
    'db3 without some rows': Input(damaged(DB3, '*.db3', delete_rows), is_lost=True),
    'db3 with a topic gone': Input(damaged(DB3, '*.db3', flip_message), is_lost=True),
    'db3 cut off': Input(damaged(DB3, '*.db3', cut), is_lost=True),
    'mcap.zstd': Input(ZSTD),
    'mcap.zstd wiped in the middle': Input(damaged(ZSTD, '*.zstd', wipe), is_lost=True),
    'mcap.zstd cut off': Input(damaged(ZSTD, '*.zstd', cut), is_lost=True),
    'mcap.zstd of 8 GB': Input(damaged(ZSTD, '*.zstd', bomb), is_lost=True),
    'FIFOs in a bag': Input(with_pipe, is_lost=True),
    'a FIFO as a bag': Input(pipe_as_file, is_lost=True),
    'a device as a bag': Input(device_as_file, is_lost=True),
    'csv': Input(table(lambda s: s, 'csv')),
    'csv before 1901': Input(table(lambda s: s - 130 * YEAR, 'csv'), is_lost=True),
    'csv after 2038': Input(table(lambda s: s + 40 * YEAR, 'csv'), is_lost=True),
    'csv of 1e30': Input(table(lambda s: s * 1e30, 'csv'), is_lost=True),
    'parquet of uint64': Input(table(lambda s: s.astype(np.uint64), 'parquet')),
    'parquet of large uint64': Input(
        table(lambda s: s.astype(np.uint64) + np.uint64(1 << 63), 'parquet'), is_lost=True
    ),
    'parquet of the year 3000': Input(
        table(lambda s: (s // SECOND).astype('M8[s]') + np.timedelta64(974 * 366, 'D'), 'parquet'),
        is_lost=True,
    ),
    'parquet of 1e30': Input(table(lambda s: s * 1e30, 'parquet'), is_lost=True),
}
