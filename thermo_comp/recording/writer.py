# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the writing of columns to a rosbag2 directory or a bare MCAP file, or block by block to a
table in CSV or Parquet (with the optional dependency ``parquet``).

A bag or table gets its name when complete; if writing fails, an older file of this name is kept.
"""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import OutputError, RecordingError
from ..files import CSV, PARQUET, Draft, Kind, bag_kind, drafted, sync
from ..topics import IMU, N_NUMBERS, TEMPERATURE, VECTOR3_STAMPED
from ..typing import Ints
from .blocks import ImuColumns
from .mcap_out import Compression, McapOutput, dump_yaml, known_definition
from .serialized import Messages
from .wire import IMU_ACCELERATION, IMU_COLUMNS, encode_stamped

STAMP_END_NS = 2**31 * 10**9  # upper limit of ROS stamps, exclusive [ns]
_AUTO_FLUSH_BYTES = 1 << 26
TABLES: Mapping[str, Kind] = {'.csv': CSV, '.parquet': PARQUET}  # formats by the file's suffix
WriteRows = Callable[[Mapping[str, NDArray[Any]]], None]
#: One field: slice of a message's numbers, name of the field, values (one row per message).
_Column = tuple[slice, str, ArrayLike]


class BagWriter(AbstractContextManager['BagWriter']):
    """
    Write a bag, ``*.mcap`` or a rosbag2 directory; use the writer as a context manager.
    Messages are buffered until they have 64 MiB or `flush` is called, and then merged in log-time
    order. If `is_precious`, a bag that cannot be finished is kept. A killed process leaves an
    unfinished bag under a hidden name beside the target. Raises OutputError if the bag cannot or
    may not be written; ValueError for wrong shapes, and for times outside the range of ROS stamps.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: Compression = 'zstd',
        # zstd's level -1 writes a sixth faster than level 1; the bag is a few percent larger.
        level: int = -1,
        metadata: Mapping[str, str] | None = None,
        overwrite: bool = False,
        chunk_bytes: int = 1 << 20,
        is_precious: bool = False,
    ) -> None:
        self._path = Path(path)
        self._is_precious = is_precious
        self._batches: list[Messages] = []
        self._file: McapOutput | None = None
        kind = bag_kind(path)
        self._is_file = not kind.is_folder
        self._draft = Draft(path, kind, overwrite=overwrite)
        with self._translated():
            name = self._path.name if self._is_file else f'{self._path.name}_0.mcap'
            path = self._draft.partial if self._is_file else self._draft.partial / name
            self._file = McapOutput(path, compression, level, chunk_bytes, metadata or {}, name)

    def write_counts(
        self,
        topic: str,
        stamp_ns: ArrayLike,
        xyz: ArrayLike,
        frame_id: str = '',
        log_ns: ArrayLike | None = None,
    ) -> None:
        """Write geometry_msgs/Vector3Stamped messages: counts per cycle, shape (n, 3)."""
        columns = [(slice(0, 3), 'xyz', xyz)]
        self._write_stamped(topic, VECTOR3_STAMPED, stamp_ns, log_ns, frame_id, columns)

    def write_temperature(
        self,
        topic: str,
        stamp_ns: ArrayLike,
        celsius: ArrayLike,
        log_ns: ArrayLike | None = None,
        frame_id: str = '',
    ) -> None:
        """Write sensor_msgs/Temperature messages: degC, shape (n,), with unknown variance."""
        columns = [(slice(0, 1), 'celsius', np.reshape(celsius, (-1, 1)))]
        self._write_stamped(topic, TEMPERATURE, stamp_ns, log_ns, frame_id, columns)

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
        Write sensor_msgs/Imu messages: m/s^2, shape (n, 3), covariances of shape (n, 9) or (9,).
        Without `imu`, orientation and rate are marked as absent: their covariances begin with -1.
        """
        columns: list[_Column] = [
            (IMU_ACCELERATION, 'linear_acceleration', linear_acceleration),
            (IMU_COLUMNS[-1], 'linear_acceleration_covariance', linear_acceleration_covariance),
        ]
        fields = (imu or ImuColumns.of_rate(None))._asdict().items()
        others = zip(IMU_COLUMNS[:-1], fields, strict=False)
        columns += [(place, f'imu.{name}', values) for place, (name, values) in others]
        self._write_stamped(topic, IMU, stamp_ns, log_ns, frame_id, columns)

    def write_raw(
        self,
        topic: str,
        type: str,  # noqa: A002 - the parameter's public name
        log_ns: ArrayLike,
        messages: Sequence[bytes] | Messages,
        definition: tuple[str, str] | None = None,
    ) -> None:
        """Write serialized (CDR) messages; `definition` is needed for types not in ROS 2 Jazzy."""
        times = _as_times('log_ns', log_ns, len(messages))
        if not isinstance(messages, Messages):
            messages = Messages.of(messages, np.zeros(len(messages)), times)
        self._add(topic, type, replace(messages, log_ns=times), definition)

    def flush(self) -> None:
        """Merge the buffered messages in log-time order and write them."""
        if self._batches and self._file is not None:
            batches, self._batches = self._batches, []
            with self._translated():
                self._file.append(batches)

    def close(self) -> None:
        """Finish the bag and rename it to the target; if this fails, the target is unchanged."""
        if self._file is None:
            return
        try:
            self.flush()
            with self._translated():
                information = self._file.finish()
                if not self._is_file:
                    text = dump_yaml({'rosbag2_bagfile_information': information})
                    path = self._draft.partial / 'metadata.yaml'
                    path.write_bytes(text.encode())
                    sync(path)
            self._draft.publish()
            self._file = None
        except BaseException:
            self.abort()
            raise

    def abort(self) -> None:
        """Delete the unfinished bag, unless `is_precious`; an older bag of this name is kept."""
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):
                file.close()
        if not self._is_precious:
            self._draft.drop()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Finish the bag, or abort if the `with` block raised an exception."""
        if kind is None:
            self.close()
        else:
            self.abort()

    def _write_stamped(
        self,
        topic: str,
        kind: str,
        stamp_ns: ArrayLike,
        log_ns: ArrayLike | None,
        frame_id: str,
        columns: Sequence[_Column],
    ) -> None:
        stamps = _as_times('stamp_ns', stamp_ns)
        if len(stamps) and int(np.max(stamps)) >= STAMP_END_NS:
            raise ValueError(f'`stamp_ns` must be below 2**31 s, got {int(np.max(stamps))} ns')
        times = stamps if log_ns is None else _as_times('log_ns', log_ns, len(stamps))
        pieces = []
        for place, name, values in columns:
            numbers, width = np.asarray(values, np.float64), place.stop - place.start
            if numbers.shape not in {(len(stamps), width), (width,)}:
                raise ValueError(
                    f'`{name}` must have shape ({len(stamps)}, {width}), got {numbers.shape}'
                )
            pieces.append((place, numbers))
        rows = encode_stamped(stamps, frame_id, N_NUMBERS[kind], pieces)
        self._add(topic, kind, Messages.of_rows(rows, np.zeros(len(rows), np.uint16), times))

    def _add(
        self, topic: str, kind: str, messages: Messages, definition: tuple[str, str] | None = None
    ) -> None:
        name = '/' + topic.strip('/')
        if self._file is None:
            raise RecordingError('the bag is closed', self._path)
        try:
            known = (*definition, '') if definition else known_definition(kind)
            with self._translated():
                number = self._file.channel(name, kind, known)
        except RecordingError as error:
            raise RecordingError(error.message, self._path, name) from error
        if len(messages):
            channel = np.full_like(messages.channel, number)
            self._batches.append(replace(messages, channel=channel))
            if sum(len(batch.data) for batch in self._batches) > _AUTO_FLUSH_BYTES:
                self.flush()

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.abort()
            kept = f'; the part written is in {self._draft.partial.name}' * self._is_precious
            raise OutputError(
                f'cannot be written: {error.strerror or error}{kept}', self._path
            ) from error


def _as_times(name: str, values: ArrayLike, n: int | None = None) -> Ints:
    """Return a column as int64 [ns]; ValueError unless it has `n` integers of 0 or more."""
    times = np.atleast_1d(values if np.size(values) else np.empty(0, np.int64))
    if times.dtype.kind not in 'iu' or times.ndim != 1:
        raise ValueError(f'`{name}` must be one row of integers, got {times.dtype}')
    if n is not None and len(times) != n:
        raise ValueError(f'`{name}` must have {n} values, got {len(times)}')
    checked: Ints = times.astype(np.int64, copy=False)
    if len(checked) and int(np.min(checked)) < 0:
        raise ValueError(f'`{name}` must not be negative, got {int(np.min(checked))} ns')
    return checked


@contextmanager
def table_writer(
    path: str | Path, metadata: Mapping[str, str], *, overwrite: bool = False
) -> Iterator[WriteRows]:
    """
    Write a table in the format of its suffix (`TABLES`, else CSV); the file appears when complete.
    Yields a function that appends columns by name, shape (n,), with the same names in each call.
    A CSV has no metadata. Raises OutputError if the table or its format cannot be written.
    """
    kind = TABLES.get(Path(path).suffix, CSV)
    with drafted(path, kind, overwrite=overwrite) as partial, ExitStack() as stack:
        writer: Any = None
        if kind is CSV:
            text = stack.enter_context(partial.open('w', encoding='utf-8', newline=''))
            lines = csv.writer(text, lineterminator='\n')

            def write_lines(columns: Mapping[str, NDArray[Any]]) -> None:
                if not text.tell():
                    lines.writerow(columns)
                lines.writerows(zip(*(col.tolist() for col in columns.values()), strict=True))

            yield write_lines
            return
        try:
            import pyarrow as pa
            from pyarrow import parquet as pq
        except ImportError as error:
            raise OutputError("needs pyarrow: pip install 'thermo_comp[parquet]'", path) from error

        def write(columns: Mapping[str, NDArray[Any]]) -> None:
            nonlocal writer
            arrays = {name: pa.array(column) for name, column in columns.items()}
            table = pa.table(arrays, metadata=dict(metadata))
            writer = writer or stack.enter_context(pq.ParquetWriter(partial, table.schema))
            writer.write_table(table)

        yield write
