# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns a bag that somebody else is writing: what is new in it, again and again, until it is whole.

Each look reads the bag from its beginning, which any storage can, and passes over what was there
before; so looks are as far apart as they take long.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import RecordingError
from .columns import Block, Input, RecordingInfo, Role
from .reader import open_recording
from .topics import Topics


class News(NamedTuple):
    """What has come: a block with its serialized messages, and from which bag."""

    block: Block
    info: RecordingInfo | None = None


_PERIOD_S = 1.0
#: A look may take this part of the time.
_SHARE = 0.2


def growing_blocks(
    path: Path,
    topics: Topics,
    input: Input,  # noqa: A002 - the parameter's public name
    wait: Callable[[float], bool],
) -> Iterator[News | None]:
    """
    Give what is new in a bag, and None at the end of each look.

    `wait` waits so long [s] and tells whether to end. It ends by itself when the bag is whole.
    Raises RecordingError for what is no bag.
    """
    if not path.exists():
        raise RecordingError('no such file or directory', path)
    n_seen: dict[Role, int] = {}
    size = 0
    while True:
        began = time.monotonic()
        try:
            reader = open_recording(path, topics, input, require=())
        except RecordingError:
            # A recorder creates its files before it has anything to write, or whole records.
            before, size = size, _size(path)
            if n_seen or 0 < size == before:
                raise
            is_whole = False
        else:
            with reader:
                n_read: dict[Role, int] = {}
                for block in reader.blocks(raw=True):
                    is_new = {}
                    for role, log_ns in block.log_ns.items():
                        numbers = n_read.get(role, 0) + np.arange(len(log_ns))
                        is_new[role] = numbers >= n_seen.get(role, 0)
                        n_read[role] = n_read.get(role, 0) + len(log_ns)
                    yield News(block.take(is_new), reader.info)
                n_seen = n_read
                is_whole = reader.info.truncated is None and bool(n_seen)
        yield None
        if is_whole or wait(max(_PERIOD_S, (time.monotonic() - began) / _SHARE)):
            return


def _size(path: Path) -> int:
    return sum(one.stat().st_size for one in (path.iterdir() if path.is_dir() else [path]))
