# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way to the bytes of a file: so many from such a place, from any thread.
"""

from __future__ import annotations

import os
from pathlib import Path

from ..files import open_regular


class LocalFile:
    """A file of this machine; OSError if it is a FIFO or a device: these would never end."""

    def __init__(self, path: Path) -> None:
        self._file = open_regular(path)
        self.size = os.fstat(self._file.fileno()).st_size

    def read_at(self, at: int, n_bytes: int) -> bytes:
        """Read up to so many bytes, fewer only where the file ends."""
        return os.pread(self._file.fileno(), n_bytes, at)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
