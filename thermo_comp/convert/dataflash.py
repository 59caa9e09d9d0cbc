# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ArduPilot's DataFlash files (``.BIN``), behind the extra ``ardupilot``.

One message type per IMU in old logs (``IMU``, ``IMU2``, ``IMU3``), one type with an instance
number ``I`` in new ones; its temperature is called ``T`` or ``Temp``. The readings are those after
ArduPilot's own correction, so a log made with ``INS_TCALn_ENABLE = 1`` is refused: its thermal
drift is already taken out.

The messages: https://ardupilot.org/copter/docs/logmessages.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import RecordingError
from ..files import open_regular
from ..typing import Bools, Ints
from .autopilot import chosen, stamps_ns
from .log import ForeignLog, Readings

_HEADER_BYTES = 3
# What struct calls a field -> what numpy calls it; strings and arrays are kept as bytes.
_TYPES = {
    'b': 'i1', 'B': 'u1', 'h': '<i2', 'H': '<u2', 'i': '<i4', 'I': '<u4', 'q': '<i8', 'Q': '<u8',
    'e': '<f2', 'f': '<f4', 'd': '<f8',
}  # fmt: skip
_VECTORS = ('AccX', 'AccY', 'AccZ', 'GyrX', 'GyrY', 'GyrZ')

_Columns = dict[str, npt.NDArray[Any]]


def read_dataflash(
    path: str | Path,
    imu: int | None = None,
    baro: int | None = None,
    allow_compensated: bool = False,
) -> ForeignLog:
    """Read an IMU of an ArduPilot log, counted from 0: the old type ``IMU2`` is 1."""
    try:
        from pymavlink.DFReader import DFReader_binary
    except ImportError as failure:
        raise RecordingError(
            "an ArduPilot log needs pymavlink: pip install 'thermo_comp[ardupilot]'", path=path
        ) from failure
    path = Path(path)
    with open_regular(path) as file:
        magic = file.read(2)
    if magic != b'\xa3\x95':
        raise RecordingError('not a DataFlash log: it does not begin with a3 95', path=path)
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        # It raises whatever a damaged file makes Python raise.
        try:
            reader = DFReader_binary(str(path))
        except Exception as failure:
            raise RecordingError(f'not a DataFlash log ({failure})', path=path) from failure
    imus: dict[int, ForeignLog] = {}
    baros: dict[int, Readings] = {}
    try:
        metadata = {}
        if any(str(key).startswith('SIM_') for key in reader.params):
            metadata['ardupilot_simulated'] = 'it has SIM_ parameters: a simulator wrote this log'
        for name in sorted(reader.name_to_id):
            if not re.fullmatch(r'IMU\d?|BARO|BAR\d', name):
                continue
            columns, n_short = _messages(reader, name, path)
            is_imu = name.startswith('IMU')
            for number, stamp_ns, rows in _instances(name, columns):
                celsius = columns.get('T', columns.get('Temp', np.full(len(rows), np.nan)))
                readings = Readings(stamp_ns[rows], celsius[rows].astype(np.float64))
                if not is_imu:
                    baros[number] = readings
                elif all(title in columns for title in _VECTORS):
                    both = np.column_stack([columns[title][rows] for title in _VECTORS])
                    accel, gyro = both.astype(np.float64).reshape(-1, 2, 3).swapaxes(0, 1)
                    imus[number] = ForeignLog(
                        str(path),
                        stamp_ns[rows],
                        accel,
                        gyro,
                        {'imu': readings},
                        n_short=n_short,
                        metadata=metadata,
                    )
    finally:
        reader.close()
    compensated = {
        number: f'{name} was 1: ArduPilot has already taken the thermal drift out of these '
        'readings; set it to 0 and record again'
        for number in imus
        if reader.params.get(name := f'INS_TCAL{number + 1}_ENABLE') == 1.0
    }
    return chosen(path, imus, baros, compensated, imu, baro, allow_compensated)


def _messages(reader: Any, name: str, path: Path) -> tuple[_Columns, int]:
    """Gather one message type: its columns, and how many of its messages were cut off."""
    number = reader.name_to_id[name]
    layout = reader.formats[number]
    offsets = np.asarray(reader.offsets[number], dtype=np.int64)
    whole = offsets[offsets + layout.len <= reader.data_len]
    codes = re.findall(r'(\d*)([a-zA-Z])', layout.msg_struct)
    fields = [
        (title, _TYPES.get(code, f'S{size or 1}'))
        for title, (size, code) in zip(layout.columns, codes, strict=False)
    ]
    if len(dict(fields)) < len(fields):
        raise RecordingError(f'damaged: the format of {name} has a column twice', path=path)
    kind = np.dtype(fields)
    if _HEADER_BYTES + kind.itemsize > layout.len:
        raise RecordingError(f'damaged: the format of {name} is longer than it says', path=path)
    raw = np.memmap(path, dtype=np.uint8, mode='r')
    span = np.arange(_HEADER_BYTES, _HEADER_BYTES + kind.itemsize)
    rows = np.ascontiguousarray(raw[whole[:, None] + span]).view(kind).ravel()
    columns = {
        title: rows[title] if factor is None else rows[title] * factor
        for title, factor in zip(layout.columns, layout.msg_mults, strict=False)
    }
    return columns, len(offsets) - len(whole)


def _instances(name: str, columns: _Columns) -> Iterator[tuple[int, Ints, Bools]]:
    """Give number, stamps and rows of each sensor; of messages without a time, of none."""
    if 'TimeUS' in columns:
        stamp_ns = stamps_ns(columns['TimeUS'])
    elif 'TimeMS' in columns:
        stamp_ns = stamps_ns(columns['TimeMS'].astype(np.uint64) * np.uint64(1000))
    else:
        return
    if 'I' in columns:
        for number in np.unique(columns['I']):
            yield int(number), stamp_ns, columns['I'] == number
    elif len(stamp_ns):
        # The second IMU's old type is IMU2: counted from 1, the first without its number.
        number = int(name[-1]) - 1 if name[-1].isdigit() else 0
        yield number, stamp_ns, np.ones(len(stamp_ns), dtype=np.bool_)
