# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way out: columns to a rosbag2 directory or a bare MCAP file that other tools open.

Nothing stands under the target's name until `BagWriter.close` has succeeded; an output that was
there before stays if writing fails.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OutputError, RecordingError
from ..files import Draft, bag_kind
from ..typing import Bytes, Floats, Ints
from .columns import ImuColumns, RawMessages
from .mcap_out import McapOutput
from .messages import Messages
from .rosbag2_metadata import Definition, dump_metadata, known_definition
from .topics import BOOL, IMU, TEMPERATURE, VECTOR3_STAMPED
from .wire import N_NUMBERS, encode_stamped

Compression = Literal['none', 'lz4', 'zstd']

#: The first stamp that no ROS message can hold; none is before 0 [ns].
STAMP_END_NS = 2**31 * 10**9
_AUTO_FLUSH_BYTES = 1 << 26


class BagWriter:
    """
    Write a bag; use it as a context manager.

    ``*.mcap`` makes a bare file, anything else a rosbag2 directory. `level` is that of the
    compression (``zstd``, ``lz4`` or ``none``), by default a fast one; `chunk_bytes` counts before
    it. `RecordingInfo.metadata` gives the metadata back. What `is_precious` is not dropped where
    it cannot be finished. Raises OutputError where the output exists and is not to be overwritten,
    is no bag that may be replaced, or cannot be created.

    Messages are buffered until `flush`, which merges all topics in log-time order; 64 MiB of them
    are flushed unasked. So one group of calls whose time spans overlap and a `flush` make a file
    in log-time order, whatever order the calls had. A process that is killed loses what is
    buffered and up to four chunks; the rest stands in a hidden file beside the target and can be
    read as a torn bag.

    The writing methods raise ValueError for shapes that do not fit and times that no ROS stamp can
    hold, OutputError where the disk is full or the like. Log times are the stamps, if not given.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: Compression = 'zstd',
        level: int | None = None,
        metadata: Mapping[str, str] | None = None,
        overwrite: bool = False,
        chunk_bytes: int = 1 << 20,
        is_precious: bool = False,
    ) -> None:
        if compression not in {'zstd', 'lz4', 'none'}:
            raise ValueError(f'`compression` must be zstd, lz4 or none, got {compression!r}')
        self._path = Path(path)
        self._metadata = dict(metadata or {})
        self._is_precious = is_precious
        self._batches: list[Messages] = []
        self._file: McapOutput | None = None
        kind = bag_kind(path)
        self._is_file = not kind.is_folder
        self._draft = Draft(path, kind, overwrite=overwrite)
        with self._translated():
            name = self._path.name if self._is_file else f'{self._path.name}_0.mcap'
            self._file = McapOutput(
                self._draft.partial if self._is_file else self._draft.partial / name,
                compression,
                level,
                chunk_bytes,
                self._metadata,
                name,
            )

    def write_counts(
        self,
        topic: str,
        stamp_ns: ArrayLike,
        xyz: ArrayLike,
        frame_id: str = '',
        log_ns: ArrayLike | None = None,
    ) -> None:
        """Write geometry_msgs/Vector3Stamped: counts per cycle, shape (n, 3)."""
        stamps = _as_stamps(stamp_ns)
        pieces = [(0, _as_numbers('xyz', xyz, len(stamps), 3))]
        self._write_stamped(topic, VECTOR3_STAMPED, stamps, log_ns, frame_id, pieces)

    def write_temperature(
        self,
        topic: str,
        stamp_ns: ArrayLike,
        celsius: ArrayLike,
        log_ns: ArrayLike | None = None,
        frame_id: str = '',
        variance: ArrayLike = 0.0,
    ) -> None:
        """
        Write sensor_msgs/Temperature: degC, shape (n,), and its variance [K^2], 0 for unknown.
        """
        stamps = _as_stamps(stamp_ns)
        column = np.asarray(celsius, np.float64)
        if column.shape != stamps.shape:
            raise ValueError(f'`celsius` must have {len(stamps)} values, got {column.shape}')
        numbers = np.column_stack([column, np.broadcast_to(np.asarray(variance), column.shape)])
        self._write_stamped(topic, TEMPERATURE, stamps, log_ns, frame_id, [(0, numbers)])

    def write_imu(
        self,
        topic: str,
        stamp_ns: ArrayLike,
        linear_acceleration: ArrayLike,
        linear_acceleration_covariance: ArrayLike,
        frame_id: str = '',
        imu: ImuColumns | None = None,
        log_ns: ArrayLike | None = None,
    ) -> None:
        """
        Write sensor_msgs/Imu: m/s^2, shape (n, 3), with the covariance (n, 9) or (9,).

        Without `imu` neither orientation nor angular velocity is claimed: identity, zero rate, and
        -1 as first element of each covariance.
        """
        stamps = _as_stamps(stamp_ns)
        n = len(stamps)
        columns: list[tuple[int, str, ArrayLike, int]] = [
            (25, 'linear_acceleration', linear_acceleration, 3),
            (28, 'linear_acceleration_covariance', linear_acceleration_covariance, 9),
        ]
        if imu is None:
            nothing = np.zeros(25)
            nothing[3], nothing[[4, 16]] = 1.0, -1.0
            columns.append((0, '', nothing, 25))
        else:
            columns += [
                (0, 'imu.orientation', imu.orientation, 4),
                (4, 'imu.orientation_covariance', imu.orientation_covariance, 9),
                (13, 'imu.angular_velocity', imu.angular_velocity, 3),
                (16, 'imu.angular_velocity_covariance', imu.angular_velocity_covariance, 9),
            ]
        pieces = [(at, _as_numbers(name, value, n, width)) for at, name, value, width in columns]
        self._write_stamped(topic, IMU, stamps, log_ns, frame_id, pieces)

    def write_bool(self, topic: str, log_ns: ArrayLike, values: ArrayLike) -> None:
        """Write std_msgs/Bool."""
        times = _as_times('log_ns', log_ns)
        flags = np.atleast_1d(np.asarray(values, np.bool_))
        if flags.shape != times.shape:
            raise ValueError(f'`values` must have {len(times)} values, got {flags.shape}')
        payloads = np.zeros((len(times), 5), np.uint8)
        payloads[:, 1], payloads[:, 4] = 1, flags
        self._add_rows(self._channel(topic, BOOL), times, payloads)

    def write_raw(
        self,
        topic: str,
        type: str,  # noqa: A002 - the parameter's public name
        log_ns: ArrayLike,
        messages: Sequence[bytes] | RawMessages,
        definition: tuple[str, str] | None = None,
    ) -> None:
        """
        Write messages that are serialized (CDR) already.

        `definition` is encoding and text of the type's, as `RecordingReader.definitions` gives it;
        by default that of ROS 2 Jazzy, RecordingError where that has none.
        """
        if isinstance(messages, RawMessages):
            data, ends = messages.data, messages.ends
        else:
            data = np.frombuffer(b''.join(messages), np.uint8)
            ends = np.cumsum(np.fromiter(map(len, messages), np.int64, len(messages)))
        times = _as_times('log_ns', log_ns, len(ends))
        self._add(self._channel(topic, type, definition), times, data, np.diff(ends, prepend=0))

    def flush(self) -> None:
        """Merge what is buffered in log-time order and hand it to the file."""
        if self._batches:
            batches, self._batches = self._batches, []
            with self._translated():
                self._open_file().append(batches)

    def close(self) -> None:
        """
        Finish the bag and give it its name.

        Raises OutputError where that fails, or somebody else was first; nothing is left of it
        then.
        """
        if self._file is None:
            return
        try:
            self.flush()
            with self._translated():
                summary = self._file.finish()
                if not self._is_file:
                    text = dump_metadata(summary, self._metadata)
                    _write_text(self._draft.partial / 'metadata.yaml', text)
            self._draft.publish()
        except BaseException:
            self.abort()
            raise
        self._file = None

    def abort(self) -> None:
        """Drop the unfinished output; what stood under its name before stays."""
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):
                file.close()
        if not self._is_precious:
            self._draft.drop()

    def __enter__(self) -> BagWriter:
        """Give the open writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Finish the bag, or drop it where the block raised."""
        if kind is None:
            self.close()
        else:
            self.abort()

    def _write_stamped(
        self,
        topic: str,
        kind: str,
        stamp_ns: Ints,
        log_ns: ArrayLike | None,
        frame_id: str,
        pieces: Sequence[tuple[int, Floats]],
    ) -> None:
        times = stamp_ns if log_ns is None else _as_times('log_ns', log_ns, len(stamp_ns))
        rows = encode_stamped(stamp_ns, frame_id, N_NUMBERS[kind], pieces)
        self._add_rows(self._channel(topic, kind), times, rows)

    def _channel(self, topic: str, kind: str, definition: tuple[str, str] | None = None) -> int:
        name = '/' + topic.strip('/')
        if definition is None:
            try:
                known = known_definition(kind)
            except RecordingError as error:
                raise RecordingError(error.message, self._path, name) from error
        else:
            known = Definition(*definition, '')
        with self._translated():
            channel = self._open_file().channel(name, kind, known)
        if channel is None:
            raise RecordingError(
                f'already written with another type than {kind}', self._path, name
            )
        return channel

    def _add_rows(self, channel: int, log_ns: Ints, rows: Bytes) -> None:
        self._add(channel, log_ns, rows.ravel(), np.full(len(rows), rows.shape[1]))

    def _add(self, channel: int, log_ns: Ints, data: Bytes, size: Ints) -> None:
        if len(log_ns):
            numbers = np.full(len(log_ns), channel, np.uint16)
            self._batches.append(Messages(data, np.cumsum(size) - size, size, numbers, log_ns))
            if sum(len(one.data) for one in self._batches) > _AUTO_FLUSH_BYTES:
                self.flush()

    def _open_file(self) -> McapOutput:
        if self._file is None:
            raise RecordingError('the bag is closed', self._path)
        return self._file

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.abort()
            kept = f'; what was written is {self._draft.partial.name}' * self._is_precious
            raise OutputError(
                f'cannot be written: {error.strerror or error}{kept}', self._path
            ) from error


def _as_stamps(stamp_ns: ArrayLike) -> Ints:
    stamps = _as_times('stamp_ns', stamp_ns)
    if len(stamps) and int(np.max(stamps)) >= STAMP_END_NS:
        raise ValueError(f'`stamp_ns` must be below 2**31 s, got {int(np.max(stamps))}')
    return stamps


def _write_text(path: Path, text: str) -> None:
    with path.open('w', encoding='utf-8') as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _as_times(name: str, values: ArrayLike, n: int | None = None) -> Ints:
    """Check a column of nanoseconds: `n` integers, none negative; ValueError for another."""
    times = np.atleast_1d(np.asarray(values))
    if times.size == 0:
        times = times.astype(np.int64)
    if times.dtype.kind not in 'iu' or times.ndim != 1:
        raise ValueError(f'`{name}` must be one row of integers, got {times.dtype}')
    if n is not None and len(times) != n:
        raise ValueError(f'`{name}` must have {n} values, got {len(times)}')
    checked: Ints = times.astype(np.int64, copy=False)
    if len(checked) and int(np.min(checked)) < 0:
        raise ValueError(f'`{name}` must not be negative, got {int(np.min(checked))}')
    return checked


def _as_numbers(name: str, values: ArrayLike, n: int, width: int) -> Floats:
    """Check a column of numbers, shape (n, width) or (width,) for the same in each row."""
    numbers = np.asarray(values, np.float64)
    if numbers.shape not in {(n, width), (width,)}:
        raise ValueError(f'`{name}` must have shape ({n}, {width}), got {numbers.shape}')
    return numbers
