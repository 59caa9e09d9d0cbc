# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the fuzz targets that read a file: databases, compressed bags, tables."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import zstandard
from pyarrow import parquet

from thermo_comp.convert.column_map import ColumnMap, table_log
from thermo_comp.convert.log import write_log
from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import open_recording
from thermo_comp.unit.schema import build

#: Folder of all input files of a process.
FOLDER = tempfile.TemporaryDirectory(prefix='fuzz-')
METADATA = """\
rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  compression_format: zstd
  compression_mode: FILE
  relative_file_paths: [bag.mcap.zstd]
  topics_with_message_count: []
"""
MAP = {
    'stamp': {'column': 0, 'unit': 'ns'},
    'accel': {'columns': [1, 2, 3], 'unit': 'counts', 'output': 'counts'},
    'board': {'column': 4},
}
#: Largest number of messages per byte of a file: zstd expands a byte to at most 30 kB.
MOST_PER_BYTE = 1000


def _one_line(check: Callable[[], None]) -> None:
    try:
        check()
    except RecordingError as error:
        assert '\n' not in str(error), error


def check_database(data: bytes) -> None:
    """Read any bytes as a database: the result is messages, or an error of one line."""
    path = Path(FOLDER.name, 'bag.db3')
    path.write_bytes(data)
    _one_line(lambda: _read(path, len(data)))


def check_compressed(data: bytes) -> None:
    """Read any bytes as a compressed bag: the result is messages, or an error of one line."""
    folder = Path(FOLDER.name, 'bag')
    folder.mkdir(exist_ok=True)
    (folder / 'metadata.yaml').write_text(METADATA, encoding='ascii')
    (folder / 'bag.mcap.zstd').write_bytes(data)
    _one_line(lambda: _read(folder, len(data)))


def _read(path: Path, n_bytes: int) -> None:
    with open_recording(path, require=()) as reader:
        n = sum(block.n_messages for block in reader.blocks())
    assert n <= MOST_PER_BYTE * n_bytes, n


def check_csv(data: bytes) -> None:
    """Convert any bytes as a table of text: the result is a bag, or an error of one line."""
    _check_table('log.csv', data)


def check_parquet(data: bytes) -> None:
    """Convert any bytes as a Parquet table: the result is a bag, or an error of one line."""
    _check_table('log.parquet', data)


def _check_table(name: str, data: bytes) -> None:
    path, output = Path(FOLDER.name, name), Path(FOLDER.name, 'log.mcap')
    path.write_bytes(data)

    def convert() -> None:
        report = write_log(table_log(path, build(ColumnMap, MAP)), output, force=True)
        lost = (
            report.findings['short_rows'],
            report.findings['non_numeric'],
            report.findings['out_of_range'],
        )
        assert report.messages['accel'] + sum(finding.count for finding in lost) == report.rows

    _one_line(convert)


def database(messages: list[tuple[str, str, int, bytes]]) -> bytes:
    """Make a database of (topic, type, log time, content), as short as possible."""
    path = Path(FOLDER.name, 'seed.db3')
    path.unlink(missing_ok=True)
    kinds = {topic: (number, kind) for number, (topic, kind, _, _) in enumerate(messages, 1)}
    with closing(sqlite3.connect(path)) as opened, opened:
        opened.execute('pragma page_size = 512')
        opened.execute(
            'create table topics(id integer primary key, name text, type text, '
            'serialization_format text, offered_qos_profiles text)'
        )
        opened.execute(
            'create table messages(id integer primary key, topic_id integer, timestamp integer, '
            'data blob)'
        )
        opened.executemany(
            "insert into topics values(?, ?, ?, 'cdr', '')",
            [(number, topic, kind) for topic, (number, kind) in kinds.items()],
        )
        opened.executemany(
            'insert into messages(topic_id, timestamp, data) values(?, ?, ?)',
            [(kinds[topic][0], log_ns, data) for topic, _, log_ns, data in messages],
        )
    return path.read_bytes()


def tables(start_ns: int) -> tuple[bytes, bytes]:
    """Make a small table as CSV and as Parquet."""
    rows = [(start_ns + 10**7 * k, 10.0 + k, 20.0, 2900.0, 21.5) for k in range(4)]
    text = ''.join(','.join(map(str, row)) + '\n' for row in rows).encode()
    path = Path(FOLDER.name, 'seed.parquet')
    columns = {'t': pa.array([row[0] for row in rows])}
    columns |= {f'c{k}': pa.array(np.array(rows)[:, k]) for k in range(1, 5)}
    parquet.write_table(pa.table(columns), path, compression='none', store_schema=False)
    return text, path.read_bytes()


def compressed(bag: bytes) -> bytes:
    """Compress a file of a bag as rosbag2 does."""
    return zstandard.compress(bag)
