# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the table of every command on every degenerate input: exit code, seconds, peak memory.

Whatever a recording or a table holds, a command ends in time, in bounded memory, with a sentence
instead of a traceback, and never with 0 where something is lost. What breaks this is marked ``!``
and makes the exit code 1.

    python benchmarks/degenerate.py --only jump --json degenerate.json

"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import zstandard
from pyarrow import parquet
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from thermo_comp.recording import BagWriter

ROOT = Path(__file__).resolve().parent.parent
CALIBRATION = ROOT / 'config' / 'calibration.example.yaml'
LIMIT_S, LIMIT_MB, KILL_MB = 60.0, 300.0, 2048
SECOND, YEAR = 10**9, 366 * 86400 * 10**9
START_NS = 1_767_225_600 * SECOND
RATE_HZ, POSITIONS, POSITION_S = 20, 10, 40
ALLOW = ('span', 'positions', 'residual', 'ramps', 'model', 'case')
MAP = """\
stamp: {column: 0, unit: ns}
accel: {columns: [1, 2, 3], unit: counts, output: counts}
board: {column: 4}
case: {column: 5}
"""


@dataclass
class Columns:
    """
    A thermal test in one recording: positions at rest, one after the other, in a ramp.

    """

    stamp_ns: np.ndarray
    counts: np.ndarray
    reading_ns: np.ndarray
    board: np.ndarray
    topic: str = 'accel/counts'
    frame_id: str = 'imu'
    serial: str = 'T-1'


def whole() -> Columns:
    """
    Make the recording that the others are spoilt from.

    """
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
    """
    Write a bag; with `log`, its log times rise whatever the stamps do.

    """
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
    """
    Spoil the stamps.

    """

    def make(folder: Path) -> Path:
        columns = whole()
        columns.stamp_ns = change(columns.stamp_ns).astype(np.int64)
        columns.reading_ns = change(columns.reading_ns).astype(np.int64)
        return write(folder, columns, log=True)

    return make


def spoilt(change: Callable[[Columns], object]) -> Callable[[Path], Path]:
    """
    Spoil anything else.

    """

    def make(folder: Path) -> Path:
        columns = whole()
        change(columns)
        return write(folder, columns)

    return make


def _later(size_ns: int, every: int = 0) -> Callable[[np.ndarray], np.ndarray]:
    """
    Let the clock jump in the middle, or after every so many stamps.

    """

    def change(stamp_ns: np.ndarray) -> np.ndarray:
        row = np.arange(len(stamp_ns))
        jumps = row // every if every else (row >= len(row) // 2).astype(np.int64)
        return stamp_ns + size_ns * jumps

    return change


def rosbag2(storage: StoragePlugin, mode: CompressionMode | None) -> Callable[[Path], Path]:
    """
    Write the whole recording as another storage.

    """

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


def _damaged(
    make: Callable[[Path], Path], pattern: str, damage: Callable[[Path], object]
) -> Callable[[Path], Path]:
    """
    Damage the one file of a bag.

    """

    def made(folder: Path) -> Path:
        bag = make(folder)
        (file,) = bag.glob(pattern) if bag.is_dir() else [bag]
        damage(file)
        return bag

    return made


def flip(file: Path, place: float = 0.5) -> None:
    """
    Flip one bit.

    """
    data = bytearray(file.read_bytes())
    data[int(len(data) * place)] ^= 4
    file.write_bytes(data)


def wipe(file: Path) -> None:
    """
    Overwrite some kB in the middle.

    """
    data = bytearray(file.read_bytes())
    half = len(data) // 2
    data[half : half + 4096] = bytes(4096)
    file.write_bytes(data)


def cut(file: Path) -> None:
    """
    Leave a half.

    """
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])


def delete_rows(file: Path) -> None:
    """
    Take rows out of a database.

    """
    with sqlite3.connect(file) as database:
        database.execute('delete from messages where id between 100 and 265')


def flip_message(file: Path) -> None:
    """
    Flip a bit in the topic number of a message: it belongs to no topic then.

    """
    with sqlite3.connect(file) as database:
        database.execute('update messages set topic_id = topic_id + 64 where topic_id = 1')


def bomb(file: Path) -> None:
    """
    Put 8 GB of zeros into some hundred kB.

    """
    with file.open('wb') as out, zstandard.ZstdCompressor(19).stream_writer(out) as packed:
        for _ in range(1 << 13):
            packed.write(bytes(1 << 20))


def with_pipe(folder: Path) -> Path:
    """
    Put a FIFO beside the files of a bag, and one in the place of its metadata.

    """
    bag = DB3(folder)
    (bag / 'metadata.yaml').unlink()
    os.mkfifo(bag / 'metadata.yaml')
    os.mkfifo(bag / 'other.mcap')
    return bag


def pipe_as_file(folder: Path) -> Path:
    """
    Make a folder whose only file is a FIFO.

    """
    bag = folder / 'bag'
    bag.mkdir()
    os.mkfifo(bag / 'bag_0.mcap')
    return bag


def device_as_file(folder: Path) -> Path:
    """
    Let the file of a bag lead to an endless device.

    """
    bag = folder / 'bag'
    bag.mkdir()
    (bag / 'bag_0.db3').symlink_to('/dev/zero')
    return bag


def other_name(folder: Path) -> Path:
    """
    Give a bag a name that is no UTF-8.

    """
    path = Path(os.fsdecode(os.fsencode(folder) + b'/b\xe9\xff.mcap'))
    return write(folder, whole()).rename(path)


def table(change: Callable[[np.ndarray], np.ndarray], kind: str) -> Callable[[Path], Path]:
    """
    Write a table with spoilt stamps.

    """

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
    One degenerate input; `is_lost` = something of it cannot be read, so nobody may say 0.

    """

    make: Callable[[Path], Path]
    is_lost: bool = False


INPUTS: dict[str, Input] = {
    'whole': Input(spoilt(lambda _: None)),
    'jump of a year': Input(stamps(_later(YEAR))),
    'jump from 1970': Input(
        stamps(lambda s: np.where(s < s[len(s) // 2], s - START_NS + SECOND, s))
    ),
    'jump back by a year': Input(stamps(_later(-YEAR))),
    'a day between samples': Input(stamps(lambda s: START_NS + (s - START_NS) * 17280 // 500)),
    'an hour after every ten samples': Input(stamps(_later(3600 * SECOND, 10))),
    'reversed stamps': Input(stamps(lambda s: s[::-1])),
    'equal stamps': Input(stamps(np.zeros_like)),
    'stamps of the limits': Input(stamps(lambda s: np.where(s < s[50], 0, (2**31 - 1) * SECOND))),
    'one sample': Input(spoilt(lambda c: _samples(c, 1))),
    'no sample': Input(spoilt(lambda c: _samples(c, 0))),
    'one reading': Input(spoilt(lambda c: _readings(c, 1))),
    'readings of one stamp': Input(spoilt(_at_one_stamp)),
    'a value of 1e308': Input(spoilt(lambda c: _value(c, 1e308))),
    'all values 1e308': Input(spoilt(lambda c: _set('counts', c.counts * 0 + 1e308)(c))),
    'a reading of 1e308': Input(spoilt(lambda c: c.board.__setitem__(9, 1e308))),
    'all NaN': Input(spoilt(lambda c: _set('counts', c.counts * np.nan)(c))),
    'all zeros': Input(spoilt(lambda c: _set('counts', c.counts * 0)(c))),
    'a span of 1 K': Input(spoilt(lambda c: _set('board', 20 + c.board / 30)(c))),
    'Cyrillic serial': Input(spoilt(_set('serial', 'блок 7'))),
    'name not UTF-8': Input(other_name),
    'db3': Input(DB3),
    'db3 with a flipped bit': Input(_damaged(DB3, '*.db3', flip), is_lost=True),
    'db3 without some rows': Input(_damaged(DB3, '*.db3', delete_rows), is_lost=True),
    'db3 with a topic gone': Input(_damaged(DB3, '*.db3', flip_message), is_lost=True),
    'db3 cut off': Input(_damaged(DB3, '*.db3', cut), is_lost=True),
    'mcap.zstd': Input(ZSTD),
    'mcap.zstd wiped in the middle': Input(_damaged(ZSTD, '*.zstd', wipe), is_lost=True),
    'mcap.zstd cut off': Input(_damaged(ZSTD, '*.zstd', cut), is_lost=True),
    'mcap.zstd of 8 GB': Input(_damaged(ZSTD, '*.zstd', bomb), is_lost=True),
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

Line = Callable[[Path, Path], list[str | Path]]
COMMANDS: dict[str, Line] = {
    'info': lambda bag, _: ['info', bag],
    'evaluate': lambda bag, _: ['evaluate', bag, '-c', CALIBRATION, '--serial', ''],
    'partial': lambda bag, _: ['partial', bag, '--gravity', '9.81'],
    'replay': lambda bag, out: [
        'replay', bag, '-c', CALIBRATION, '--serial', '', '-o', out / 'out.mcap',
    ],
    'report': lambda bag, out: [
        'report', bag, '-c', CALIBRATION, '--serial', '', '-o', out / 'out.html',
    ],
    'fit': lambda bag, out: [
        'fit', bag, '--gravity', '9.81', '-o', out / 'out.yaml',
        *(word for name in ALLOW for word in ('--allow', name)),
    ],
    'fleet': lambda bag, out: [
        'fleet', 'fit', bag.parent, '-o', out / 'fleet', '--gravity', '9.81', '--workers', '1',
    ],
    'play': lambda bag, _: ['play', bag, '--rate', '0', '--wait', '0'],
    'convert': lambda log, out: [
        'convert', log, '-o', out / 'out.mcap',
        *(['--columns', out / 'map.yaml'] if log.suffix in {'.csv', '.parquet'} else []),
    ],
}  # fmt: skip
TABLES = {'convert'}


@dataclass(frozen=True)
class Run:
    """
    What one command did with one input.

    """

    input: str
    command: str
    code: int | None
    seconds: float
    megabytes: float
    said: str
    is_bad: bool


def run(name: str, command: str, path: Path, out: Path) -> Run:
    """
    Run one command to its end, or until its time is over.

    """
    program = Path(sys.executable).with_name('thermo_comp')
    log = out / 'said.txt'
    began = time.monotonic()
    with log.open('wb') as sink:
        process = subprocess.Popen(
            [program, *COMMANDS[command](path, out)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=sink,
            cwd=out, env={**os.environ, 'TMPDIR': str(out)},
        )  # fmt: skip
    resource.prlimit(process.pid, resource.RLIMIT_DATA, (KILL_MB << 20, KILL_MB << 20))
    code: int | None = None
    pid = 0
    while not pid and time.monotonic() - began < LIMIT_S:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        time.sleep(0.01)
    if pid:
        code = os.waitstatus_to_exitcode(status)
    else:
        process.kill()
        _, _, usage = os.wait4(process.pid, 0)
    process.returncode = -9 if code is None else code
    lines = log.read_text('utf-8', 'replace').strip().splitlines()
    said = ' | '.join(lines[-2:])
    megabytes = usage.ru_maxrss / 1024
    is_bad = (
        code not in {0, 1}
        or megabytes > LIMIT_MB
        or any(line.startswith('Traceback') for line in lines)
        or (code == 0 and INPUTS[name].is_lost)
    )
    return Run(name, command, code, time.monotonic() - began, megabytes, said, is_bad)


def main() -> int:
    """
    Make the inputs, run the commands, print the table.

    """
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--only', default='', help='inputs whose name contains this')
    parser.add_argument('--commands', nargs='*', choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument('--json', type=Path, help='write what was found')
    arguments = parser.parse_args()
    runs: list[Run] = []
    print(f'{"input":34}' + ''.join(f'{name:>17}' for name in arguments.commands))
    for name, given in INPUTS.items():
        if arguments.only not in name:
            continue
        folder = Path(tempfile.mkdtemp(prefix='degenerate-'))
        unit = folder / 'in' / 'unit'
        unit.mkdir(parents=True)
        path = given.make(unit)
        row = f'{name:34}'
        for command in arguments.commands:
            is_table = path.suffix in {'.csv', '.parquet'}
            if is_table and command not in TABLES:
                row += f'{"":17}'
                continue
            out = folder / command
            out.mkdir()
            (out / 'map.yaml').write_text(MAP, encoding='ascii')
            runs.append(done := run(name, command, path, out))
            code = 'hangs' if done.code is None else str(done.code)
            mark = '!' if done.is_bad else ' '
            row += f'{code:>6}{done.seconds:5.1f}{done.megabytes:5.0f}{mark}'
            shutil.rmtree(out)
        print(row, flush=True)
        shutil.rmtree(folder)
    bad = [one for one in runs if one.is_bad]
    for one in bad:
        print(f'{one.command} on {one.input}: {one.code}: {one.said[:300]}')
    print(f'{len(runs)} runs, {len(bad)} break a promise')
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(one) for one in runs], indent=1))
    return 1 if bad else 0


if __name__ == '__main__':
    sys.exit(main())
