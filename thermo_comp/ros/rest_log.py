# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the rest log of the node: samples at rest become lines of files, without delaying the relay.

The relay appends references to messages to a list. The messages are summed in blocks of `BLOCK`,
as arrays; a thread writes the lines, so a slow or hanging disk does not delay samples. Rests that
cannot be written are counted, and the diagnostics give the number and the reason.
"""

import os
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from queue import Full, Queue

import numpy as np

from ..errors import OutputError
from ..field.gather import RestFinder
from ..field.rest import SUFFIX, Start, counted_rests, encode, thinned
from ..online.compensator import Compensator
from ..typing import Floats, Stamps
from .reader import LoadedCalibration

#: Number of waiting messages at which the messages are summed; else they are summed every second.
BLOCK = 1024
#: Largest size of the file of a day, and of the folder [bytes]; a month takes at most 10 MB.
DAY_BYTES, FOLDER_BYTES = 320_000, 64_000_000
#: Smallest size of the files that are thinned if the folder is too large [bytes].
_UNTHINNED_BYTES = 16_000
#: Largest number of lines that wait to be written to the disk.
_WAITING = 1000
#: Stamps before 2000-01-01 [ns] are times since the start of a driver, not dates: rests with such
#: stamps get the time of this computer.
_EPOCH_NS = 946_684_800 * 10**9
#: Smallest backward step of the stamps [ns] that begins a new recording.
_JUMP_NS = 10**9
# First bytes of a message in little-endian CDR; offsets of counts, force and angular rate from the
# end of a message [bytes].
_PLAIN, _COUNTS, _FORCE, _RATE = (0, 1, 0, 0), -24, -96, -192
_SHORTEST = {False: 44, True: 316}  # length of the shortest message [bytes], by `is_imu`


class RestLog:
    """A folder of rests, written by a thread; `n_lost` rests were not written, for `reason`."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder).expanduser()
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f'parameter `rest_log`: {error.strerror}', folder) from error
        if not os.access(self._folder, os.W_OK | os.X_OK):
            raise OutputError('parameter `rest_log`: the node may not write to the folder', folder)
        self.n_rests = self.n_days = self.n_lost = 0
        self.reason = ''
        self._is_torn = True  # the file's last line may be incomplete
        self._start = b''
        self._day = ''
        self._lines: Queue[tuple[str, bytes, bytes] | None] = Queue(_WAITING)
        self._thread = threading.Thread(target=self._write_all, name='rests', daemon=True)
        self._thread.start()

    def put(self, stamp_ns: int, start: bytes, rest: bytes) -> None:
        """Queue a rest's line; in a file, the line of a node's `start` precedes its rests."""
        day = np.datetime64(stamp_ns, 'ns').astype('datetime64[D]')
        try:
            self._lines.put_nowait((str(day), start, rest))
        except Full:
            self._lose('the disk does not answer')

    def close(self, timeout_s: float = 1.0) -> None:
        """Write the waiting lines; give up if queue or disk take longer than `timeout_s`."""
        try:
            self._lines.put(None, timeout=timeout_s)
        except Full:
            return
        self._thread.join(timeout_s)

    def _lose(self, reason: str) -> None:
        self.n_lost, self.reason = self.n_lost + 1, reason

    def _write_all(self) -> None:
        try:
            files = list(self._folder.glob(f'*{SUFFIX}'))
            self.n_days = len(files)
            self.n_rests = sum(counted_rests(file.read_bytes()) for file in files)
        except OSError as error:
            self.reason = error.strerror or str(error)
        while (line := self._lines.get()) is not None:
            try:
                self._write(*line)
            except OSError as error:  # noqa: PERF203 - the next line may be written
                self._is_torn = True
                self._lose(error.strerror or str(error))

    def _write(self, day: str, start: bytes, rest: bytes) -> None:
        path = self._folder / f'{day}{SUFFIX}'
        is_new = not path.exists()
        text = b'\n' * (self._is_torn and not is_new)
        if is_new or self._is_torn or (day, start) != (self._day, self._start):
            text += start
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            text += rest
            if os.write(descriptor, text) != len(text):
                raise OSError(0, 'the disk is full')
            os.fdatasync(descriptor)
            size = os.fstat(descriptor).st_size
        finally:
            os.close(descriptor)
        self._is_torn = False
        self.n_rests, self.n_days = self.n_rests + 1, self.n_days + is_new
        if size > DAY_BYTES:
            self._thin(path)
        if is_new or start != self._start:
            self._bound_folder()
        self._day, self._start = day, start

    def _thin(self, path: Path) -> None:
        content = path.read_bytes()
        less = thinned(content)
        partial = path.with_suffix('.partial')
        partial.write_bytes(less)
        partial.replace(path)
        self.n_rests -= counted_rests(content) - counted_rests(less)

    def _bound_folder(self) -> None:
        while True:
            sizes = {path.name: path.stat().st_size for path in self._folder.glob(f'*{SUFFIX}')}
            oldest = next((day for day in sorted(sizes) if sizes[day] > _UNTHINNED_BYTES), None)
            if oldest is None or sum(sizes.values()) <= FOLDER_BYTES:
                return
            self._thin(self._folder / oldest)
            if (self._folder / oldest).stat().st_size >= sizes[oldest]:
                return


class RestKeeper:
    """Turns the samples of a node into lines of its rest log."""

    def __init__(self, folder: str) -> None:
        self.log = RestLog(folder)
        self._compensator: Compensator | None = None
        self._loaded: LoadedCalibration | None = None
        self._start_ns = time.time_ns()
        self._last_ns = 0

    def gather(
        self, messages: list[bytes], loaded: LoadedCalibration, compensator: Compensator
    ) -> None:
        """Sum messages that the compensator has processed; queue the completed rests."""
        # A rest is assigned to the present calibration, even if its messages were corrected with
        # another calibration before a reload.
        self._use(loaded, compensator)
        stamps, samples = samples_of(messages, is_imu=loaded.calibration.unit.input != 'counts')
        if len(stamps) and stamps[-1] < self._last_ns - _JUMP_NS:
            self._last_ns = 0  # a new recording begins, with earlier stamps
        before = np.maximum.accumulate(np.concatenate(([self._last_ns], stamps[:-1])))
        samples, stamps = samples[stamps > before], stamps[stamps > before]
        if not len(stamps):
            return
        self._last_ns = int(stamps[-1])
        for rest in self._finder.add(stamps, samples):
            stamp_ns = rest.stamp_ns if rest.stamp_ns >= _EPOCH_NS else time.time_ns()
            self.log.put(stamp_ns, self._start, encode(replace(rest, stamp_ns=stamp_ns)))

    def _use(self, loaded: LoadedCalibration, compensator: Compensator) -> None:
        is_new = loaded is not self._loaded
        if not is_new and compensator is self._compensator:
            return
        self._loaded, self._compensator = loaded, compensator
        calibration, correction = loaded.calibration, compensator.thermal.correction
        self._start = encode(
            Start(
                self._start_ns,
                calibration.unit.serial,
                calibration.unit.input,
                compensator.config.local_gravity_m_s2 or calibration.gravity_m_s2,
                loaded.sha256,
                correction.memory,
            )
        )
        if is_new:
            self._finder = RestFinder(
                correction.K[:, 0],
                np.array(correction.noise),
                calibration.unit.full_scale,
                self._state_now,
                calibration.unit.cycle_time_s,
            )

    def _state_now(self) -> tuple[Sequence[float], Sequence[float]] | None:
        compensator = self._compensator
        if compensator is None or compensator.now_ns is None:
            return None
        thermal, now_ns = compensator.thermal, compensator.now_ns
        if now_ns > thermal.fresh_until_ns or thermal.rate.is_too_fast:
            return None
        return thermal.sample(now_ns), thermal.tracker.memory.remaining_shares(now_ns)


def samples_of(messages: Sequence[bytes], *, is_imu: bool) -> tuple[Stamps, Floats]:
    """Read stamps [ns] and samples of the little-endian messages as long as the last message."""
    size = len(messages[-1]) if messages else 0
    # A message shorter than a message with an empty frame_id is malformed.
    if size < _SHORTEST[is_imu]:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    content = b''.join([message for message in messages if len(message) == size])
    rows = np.frombuffer(content, np.uint8).reshape(-1, size)
    is_plain = (rows[:, :4] == _PLAIN).all(axis=1)
    if not is_plain.all():
        rows = rows[is_plain]
    samples = rows[:, _COUNTS:].view('<f8')
    if is_imu:
        parts = [rows[:, size + at : size + at + 32].view('<f8') for at in (_FORCE, _RATE)]
        # The first element of a covariance is -1 if force or rate was not measured.
        samples = np.hstack([np.where(p[:, 3:] == -1.0, np.nan, p[:, :3]) for p in parts])
    seconds, rest = rows[:, 4:8].view('<i4')[:, 0], rows[:, 8:12].view('<u4')[:, 0]
    return seconds * np.int64(1_000_000_000) + rest, samples
