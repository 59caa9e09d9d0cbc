# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the two file operations that must not go wrong: a bounded read and an atomic write.

"""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path


def read_bounded(path: str | Path, limit: int) -> bytes:
    """
    Read a regular file of at most `limit` bytes.

    A directory, a FIFO or a device is refused before anything is read, so a reader never blocks.

    Parameters
    ----------
    path : str or Path
        The file.
    limit : int
        The largest size accepted [bytes].

    Returns
    -------
    bytes
        The content.

    Raises
    ------
    OSError
        If it cannot be opened or read.
    ValueError
        If it is not a regular file or is larger than `limit`.

    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    with os.fdopen(descriptor, 'rb') as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise ValueError('not a regular file')
        if status.st_size > limit:
            raise ValueError(f'{status.st_size} bytes, at most {limit} are accepted')
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f'more than {limit} bytes')
    return content


def write_atomically(path: str | Path, content: bytes) -> None:
    """
    Write a file so that its readers see the old content or the new one, never a part.

    Parameters
    ----------
    path : str or Path
        The file; its folder must exist.
    content : bytes
        The whole content.

    Raises
    ------
    OSError
        If it cannot be written, with `path` as its file; the old file is then untouched.

    """
    target = Path(path)
    try:
        _replace(target, content)
    except OSError as error:
        # Not the temporary file, which nobody knows of.
        raise OSError(error.errno, error.strerror, str(path)) from error


def _replace(target: Path, content: bytes) -> None:
    descriptor, name = tempfile.mkstemp(prefix=f'.{target.name}.', dir=target.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, 'wb') as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp gives 0600; a calibration is read by other users of the machine.
        temporary.chmod(0o644)
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
