# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the moment in which a finished output takes its name: all of it at once, or not at all.

"""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
from pathlib import Path

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def partial_sibling(path: Path) -> Path:
    """
    Name the unfinished output beside `path`; it keeps the suffix, so that tools open it.

    """
    return path.with_name(
        f'.{path.stem}.{os.getpid()}-{secrets.token_hex(3)}.partial{path.suffix}'
    )


def publish(partial: Path, path: Path) -> None:
    """
    Give a finished file or directory its name, replacing what bore it.

    Parameters
    ----------
    partial : Path
        The finished output, flushed to disk.
    path : Path
        Its name-to-be on the same file system.

    Raises
    ------
    OSError
        The old output is still there then.

    """
    if path.is_dir():
        _replace_directory(partial, path)
    else:
        partial.replace(path)
    sync_directory(path.parent)


def sync_directory(path: Path) -> None:
    """
    Flush a directory's entries to disk.

    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _replace_directory(partial: Path, path: Path) -> None:
    """
    Exchange two directories in one step where the system can, in two steps where not.

    """
    if _exchange(partial, path):
        shutil.rmtree(partial)
        return
    old = partial_sibling(path)
    path.rename(old)
    try:
        partial.rename(path)
    except OSError:
        old.rename(path)
        raise
    shutil.rmtree(old)


def _exchange(one: Path, other: Path) -> bool:
    rename = getattr(ctypes.CDLL(None, use_errno=True), 'renameat2', None)
    if rename is None:
        return False
    done: int = rename(
        _AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE
    )
    return done == 0
