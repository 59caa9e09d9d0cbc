# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ArduPilot's DataFlash files (``.BIN``), behind the extra ``ardupilot``.

One message type per IMU in old logs (``IMU``, ``IMU2``, ``IMU3``), one type with an instance
number ``I`` in new ones; its temperature is called ``T`` or ``Temp``. The readings are those after
ArduPilot's own correction, so a log made with ``INS_TCALn_ENABLE = 1`` is refused: its thermal
drift is already taken out.

References
----------
.. [1] https://ardupilot.org/copter/docs/logmessages.html

"""

from __future__ import annotations

import re
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import RecordingError
from ..files import open_regular
from ..typing import Bools, Floats, Ints
from .autopilot import AutopilotLog, ImuRows, stamps_ns
from .log import Readings

_HEADER_BYTES = 3
# What struct calls a field -> what numpy calls it; strings and arrays are kept as bytes.
_TYPES = {
    'b': 'i1', 'B': 'u1', 'h': '<i2', 'H': '<u2', 'i': '<i4', 'I': '<u4', 'q': '<i8', 'Q': '<u8',
    'e': '<f2', 'f': '<f4', 'd': '<f8',
}  # fmt: skip
_TEMPERATURES = ('T', 'Temp')


def read_dataflash(path: str | Path) -> AutopilotLog:
    """
    Read the inertial sensors of an ArduPilot log, counted from 0: the old type ``IMU2`` is 1.

    Raises RecordingError if pymavlink is not installed, or the file is no DataFlash log.
    """
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
    try:
        imus: dict[int, ImuRows] = {}
        baros: dict[int, Readings] = {}
        for name in sorted(reader.name_to_id):
            if re.fullmatch(r'IMU\d?', name):
                imus.update(_imus(name, *_messages(reader, name, path)))
            elif re.fullmatch(r'BARO|BAR\d', name):
                baros.update(_baros(name, _messages(reader, name, path)[0]))
        parameters = {
            str(key): float(value)
            for key, value in reader.params.items()
            if isinstance(value, int | float)
        }
    finally:
        reader.close()
    metadata = {}
    if any(key.startswith('SIM_') for key in parameters):
        metadata['ardupilot_simulated'] = 'it has SIM_ parameters: a simulator wrote this log'
    compensated = {
        number: f'{name} was 1: ArduPilot has already taken the thermal drift out of these '
        'readings; set it to 0 and record again'
        for number in imus
        if parameters.get(name := f'INS_TCAL{number + 1}_ENABLE') == 1.0
    }
    return AutopilotLog(str(path), imus, baros, metadata, compensated=compensated)


def _messages(reader: Any, name: str, path: Path) -> tuple[dict[str, npt.NDArray[Any]], int]:
    """
    Gather one message type: its columns, and how many of its messages the file ends inside of.
    """
    number = reader.name_to_id[name]
    layout = reader.formats[number]
    offsets = np.asarray(reader.offsets[number], dtype=np.int64)
    whole = offsets[offsets + layout.len <= reader.data_len]
    n_short = len(offsets) - len(whole)
    columns = re.findall(r'(\d*)([a-zA-Z])', layout.msg_struct)
    fields = [
        (title, _TYPES.get(code, f'S{size or 1}'))
        for title, (size, code) in zip(layout.columns, columns, strict=False)
    ]
    titles = [title for title, _ in fields]
    if len(set(titles)) < len(titles):
        raise RecordingError(f'damaged: the format of {name} has a column twice', path=path)
    kind = np.dtype(fields)
    if _HEADER_BYTES + kind.itemsize > layout.len:
        raise RecordingError(f'damaged: the format of {name} is longer than it says', path=path)
    raw = np.memmap(path, dtype=np.uint8, mode='r')
    span = np.arange(_HEADER_BYTES, _HEADER_BYTES + kind.itemsize)
    rows = np.ascontiguousarray(raw[whole[:, None] + span]).view(kind).ravel()
    scaled: dict[str, npt.NDArray[Any]] = {}
    for title, factor in zip(layout.columns, layout.msg_mults, strict=False):
        scaled[title] = rows[title] if factor is None else rows[title] * factor
    return scaled, n_short


def _stamps(columns: dict[str, npt.NDArray[Any]]) -> Ints | None:
    if 'TimeUS' in columns:
        return stamps_ns(columns['TimeUS'])
    if 'TimeMS' in columns:
        return stamps_ns(columns['TimeMS'].astype(np.uint64) * np.uint64(1000))
    return None


def _instances(name: str, columns: dict[str, npt.NDArray[Any]], n: int) -> list[tuple[int, Bools]]:
    if 'I' in columns:
        return [(int(number), columns['I'] == number) for number in np.unique(columns['I'])]
    digit = name[-1]
    # The second IMU's old type is IMU2: counted from 1, the first without its number.
    return [(int(digit) - 1 if digit.isdigit() else 0, np.ones(n, dtype=np.bool_))]


def _temperature(columns: dict[str, npt.NDArray[Any]], n: int) -> Floats:
    for title in _TEMPERATURES:
        if title in columns:
            return columns[title].astype(np.float64)
    return np.full(n, np.nan)


def _imus(name: str, columns: dict[str, npt.NDArray[Any]], n_short: int) -> dict[int, ImuRows]:
    stamp_ns = _stamps(columns)
    needed = ('AccX', 'AccY', 'AccZ', 'GyrX', 'GyrY', 'GyrZ')
    if stamp_ns is None or not len(stamp_ns) or not all(title in columns for title in needed):
        return {}
    vectors = np.column_stack([columns[title].astype(np.float64) for title in needed])
    celsius = _temperature(columns, len(stamp_ns))
    return {
        number: ImuRows(
            stamp_ns[rows], vectors[rows, :3], vectors[rows, 3:], celsius[rows], n_short=n_short
        )
        for number, rows in _instances(name, columns, len(stamp_ns))
    }


def _baros(name: str, columns: dict[str, npt.NDArray[Any]]) -> dict[int, Readings]:
    stamp_ns = _stamps(columns)
    if stamp_ns is None or not len(stamp_ns):
        return {}
    celsius = _temperature(columns, len(stamp_ns))
    return {
        number: Readings(stamp_ns[rows], celsius[rows])
        for number, rows in _instances(name, columns, len(stamp_ns))
    }
