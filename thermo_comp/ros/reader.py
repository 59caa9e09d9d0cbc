# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of calibrations beside the samples, in a process of its own.

A parser holds the interpreter for milliseconds at a time, which no thread can help; and whatever
a file makes of its reader, the node only hears that it has ended.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from ..errors import CalibrationError
from ..files import read_bounded
from ..unit.calibration import Calibration
from ..unit.calibration_file import SIZE_LIMIT, parse_calibration

NICENESS = 5  # added to the niceness of the process: the samples go first


@dataclass(frozen=True, slots=True)
class LoadedCalibration:
    """A calibration, its file as the user named it, and the hash of the bytes that were parsed."""

    calibration: Calibration
    path: str
    sha256: str


def read(name: str, directory: str = '') -> LoadedCalibration:
    """Read a unit's calibration; CalibrationError, which quotes nothing of what is none."""
    if not name:
        raise CalibrationError(
            'parameter `calibration_file` is not set; start with '
            '--ros-args -p calibration_file:=PATH, or launch with calibration_file:=PATH'
        )
    try:
        path = Path(name).expanduser()
        if directory:
            # Links included.
            path, root = path.resolve(), Path(directory).expanduser().resolve()
            if not path.is_relative_to(root):
                rule = 'must be in the folder that the parameter `calibration_directory` names'
                raise CalibrationError(rule, name)
        content = read_bounded(path, SIZE_LIMIT)
        calibration = parse_calibration(content, name)
    except CalibrationError as error:
        if error.rule is None:
            raise
        raise CalibrationError(error.rule, name) from error
    except Exception as error:
        # RuntimeError: the home folder of a user that there is not. Whatever else it may be, a
        # file does not end the node.
        is_told = isinstance(error, OSError) or type(error) is ValueError
        reason = getattr(error, 'strerror', None) or (is_told and str(error))
        raise CalibrationError(
            f'cannot be read: {reason or type(error).__name__}', name
        ) from error
    return LoadedCalibration(calibration, name, hashlib.sha256(content).hexdigest())


class Reader:
    """A process that reads calibrations, begun when the first is asked for."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def read(self, name: str, directory: str) -> LoadedCalibration:
        """Do what the function `read` does, there."""
        try:
            if self._process is None:
                self._pipe, theirs = Pipe()
                # The very package that runs here; a Ctrl-C is for the node, with whom this ends.
                code = f'import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve'
                with theirs:
                    self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and words
                        [sys.executable, '-c', f'{code}; serve({theirs.fileno()})'],
                        pass_fds=[theirs.fileno()],
                        start_new_session=True,
                    )
            self._pipe.send((name, directory))
            answer: LoadedCalibration | CalibrationError = self._pipe.recv()
        except (OSError, EOFError) as error:
            self.close()
            ended = 'cannot be read: the process that reads it ended'
            raise CalibrationError(ended, name) from error
        if isinstance(answer, CalibrationError):
            raise answer
        return answer

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            self._pipe.close()


def serve(handle: int) -> None:
    """Read what the process is asked for, until nobody can ask any more."""
    os.nice(NICENESS)
    pipe = Connection(handle)
    with suppress(EOFError, OSError):
        while True:
            try:
                pipe.send(read(*pipe.recv()))
            except CalibrationError as error:  # noqa: PERF203 - it is the answer
                pipe.send(error)
