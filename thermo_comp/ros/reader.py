# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of calibrations in a separate process, in parallel to the samples.

A parser holds the interpreter lock for milliseconds at a time, so a thread would delay samples.
If a file makes the reading process crash or hang, the node continues and refuses the file.
"""

import ctypes
import errno
import hashlib
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from ..errors import CalibrationError
from ..files import read_bounded
from ..online.trial import tried
from ..unit.calibration import Calibration
from ..unit.calibration_file import SIZE_LIMIT, parse_calibration

#: Time limit for reading a file [s]; a slower file, as on a lost network drive, is refused.
LIMIT_S = 10.0
_ENDING_S = 0.5  # time to wait for a killed process [s]
_PR_SET_PDEATHSIG = 1  # option of Linux prctl: the signal sent when the parent ends
NICENESS = 5  # added to the niceness of the reading process, so that samples have priority


@dataclass(frozen=True, slots=True)
class LoadedCalibration:
    """A calibration, the path of its file as the user gave it, and the hash of the file."""

    calibration: Calibration
    path: str
    sha256: str


def read(name: str, directory: str = '') -> LoadedCalibration:
    """Read and test a calibration; errors quote no content of a file that is no calibration."""
    if not name:
        raise CalibrationError(
            'parameter `calibration_file` is not set; start with '
            '--ros-args -p calibration_file:=PATH, or launch with calibration_file:=PATH'
        )
    try:
        path = Path(name).expanduser()
        root = Path(directory).expanduser().resolve() if directory else None
        try:
            # Links are resolved first; a file in an unreadable folder counts as outside `root`.
            if root is not None and not path.resolve().is_relative_to(root):
                raise PermissionError
            content = read_bounded(path, SIZE_LIMIT, root)
        except PermissionError as error:
            if root is None or error.errno == errno.EACCES:
                raise
            rule = 'must be in the folder that the parameter `calibration_directory` names'
            raise CalibrationError(rule, name) from error
        calibration = parse_calibration(content, name)
        tried(calibration, name)
    except CalibrationError as error:
        if error.rule is None:
            raise
        raise CalibrationError(error.rule, name) from error
    except Exception as error:
        # A wrong file must not end the node; `expanduser` raises RuntimeError for unknown users.
        has_reason = isinstance(error, OSError) or type(error) in (ValueError, RuntimeError)
        reason = getattr(error, 'strerror', None) or (has_reason and str(error))
        raise CalibrationError(
            f'cannot be read: {reason or type(error).__name__}', name
        ) from error
    return LoadedCalibration(calibration, name, hashlib.sha256(content).hexdigest())


def read_within(name: str, directory: str, limit_s: float = LIMIT_S) -> LoadedCalibration:
    """Run `read` in a thread; CalibrationError if `read` takes longer than `limit_s`."""
    answer: Future[LoadedCalibration] = Future()

    def run() -> None:
        try:
            answer.set_result(read(name, directory))
        except Exception as error:  # noqa: BLE001 - raised by `result`
            answer.set_exception(error)

    # Use a daemon thread, so that the process can end while the reading hangs.
    threading.Thread(target=run, name='first reading', daemon=True).start()
    if not wait([answer], limit_s).done:
        raise _hanging(name, limit_s)
    return answer.result()


def _hanging(name: str, limit_s: float) -> CalibrationError:
    return CalibrationError(f'cannot be read: no answer within {limit_s:g} s', name)


class Reader:
    """A process that reads calibrations; a request starts the process if none is running."""

    def __init__(self, limit_s: float = LIMIT_S) -> None:
        self._limit_s = limit_s
        self._is_closed = False
        self._process: subprocess.Popen[bytes] | None = None

    def read(self, name: str, directory: str) -> LoadedCalibration:
        """Run the function `read` in the process, within the time limit."""
        try:
            if self._process is None:
                self._begin()
            self._pipe.send((name, directory))
            if not self._pipe.poll(self._limit_s):
                self._end()
                raise _hanging(name, self._limit_s)
            answer: LoadedCalibration | CalibrationError = self._pipe.recv()
        except (OSError, EOFError) as error:
            self._end()
            ended = 'cannot be read: the process that reads it ended'
            raise CalibrationError(ended, name) from error
        if isinstance(answer, CalibrationError):
            raise answer
        return answer

    def close(self) -> None:
        """End the process and any reading in it for good; callable from any thread."""
        self._is_closed = True
        self._end()

    def _begin(self) -> None:
        if self._is_closed:
            raise EOFError
        self._pipe, theirs = Pipe()
        # The reading process gets the package path of the node's process; Ctrl-C only reaches the
        # node, which ends the reading process.
        code = f'import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve'
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 - fixed interpreter and arguments
                [sys.executable, '-c', f'{code}; serve({theirs.fileno()}, {os.getpid()})'],
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            # A process that hangs in a dead file system ends when the file system releases it.
            with suppress(subprocess.TimeoutExpired):
                process.wait(_ENDING_S)
            self._pipe.close()


def serve(handle: int, parent: int) -> None:
    """Answer requests to read calibrations until the connection closes."""
    os.nice(NICENESS)
    pipe = Connection(handle)
    with suppress(AttributeError, OSError):
        # The kernel kills the reading process when the node ends, even if the reading hangs.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        return
    with suppress(EOFError, OSError):
        while True:
            try:
                pipe.send(read(*pipe.recv()))
            except CalibrationError as error:  # noqa: PERF203 - returned as the answer
                pipe.send(error)
