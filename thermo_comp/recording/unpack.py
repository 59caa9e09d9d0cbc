# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns decompression within limits: of chunks, of the beginning of torn ones, of files, of messages.

What a chunk or a frame claims about its size is only ever an upper limit of what is taken for it.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard

from ..errors import RecordingError
from ..files import open_regular
from ..typing import Bytes

#: A chunk that claims to hold more is refused [bytes].
MAX_CHUNK_BYTES = 1 << 26
#: A file that grows by more than this, beyond so many bytes, is not believed.
_MAX_GROWTH = 1024
_FREE_GROWTH_BYTES = 1 << 26
_MAX_WINDOW = 1 << 27
#: Up to so much before a damage is lost with it.
_STEP_BYTES = 1 << 16
_ENGINES: Mapping[str, Callable[[], Any]] = {
    'lz4': lz4.frame.LZ4FrameDecompressor,
    'bz2': bz2.BZ2Decompressor,
}


class DamagedError(Exception):
    """Bytes that are not what they should be; the text says what."""


@contextmanager
def translated(path: Path, *, is_foreign: bool = False) -> Iterator[None]:
    """Say which file it is that is damaged or cannot be read, whatever another library raises."""
    try:
        yield
    except RecordingError as error:
        raise RecordingError(error.message, path, error.key) from error
    except DamagedError as error:
        raise RecordingError(f'damaged: {error}', path) from error
    except OSError as error:
        raise RecordingError(f'cannot be read: {error.strerror or error}', path) from error
    except Exception as error:
        if not is_foreign:
            raise
        text = ' '.join(str(error).split()) or type(error).__name__
        raise RecordingError(f'the bag cannot be read: {text}', path) from error


def expand(packed: Path, target: Path) -> str | None:
    """Decompress a ``.zstd`` file of rosbag2; say where it is unreadable, None if it is whole."""
    with open_regular(packed) as source, target.open('wb') as file:
        limit = packed.stat().st_size * _MAX_GROWTH + _FREE_GROWTH_BYTES
        loss = None
        try:
            for data in _pieces('zstd', source, limit, _STEP_BYTES):
                file.write(data)
        except zstandard.ZstdError as error:
            n_bytes = file.tell()
            loss = f'{packed.name} is unreadable behind {n_bytes} bytes of its content ({error})'
        if not file.tell():
            raise DamagedError(loss or 'it holds nothing that can be decompressed')
        return loss


def inflate(
    compression: str, packed: Any, limit: int, step: int = _STEP_BYTES, *, is_torn: bool = False
) -> Bytes:
    """Decompress bytes, a torn piece as far as they go; DamagedError for more than the limit."""
    if not compression:
        return np.asarray(packed)
    pieces: list[bytes] = []
    try:
        pieces.extend(_pieces(compression, memoryview(packed), limit, step))
    except (zstandard.ZstdError, RuntimeError, EOFError, OSError) as error:
        if not is_torn:
            raise DamagedError(f'{compression}: {error}') from error
    return np.frombuffer(b''.join(pieces), np.uint8)


def inflate_message(packed: bytes) -> bytes:
    """Decompress one message that rosbag2 has compressed by itself."""
    return inflate('zstd', packed, _FREE_GROWTH_BYTES).tobytes()


def inflate_ros1_chunk(packed: bytes) -> bytes:
    """Decompress a chunk of a ROS 1 bag, which begins as its compression does."""
    compression = {b'BZh': 'bz2', b'\x04\x22\x4d': 'lz4'}.get(packed[:3], '')
    return inflate(compression, packed, MAX_CHUNK_BYTES).tobytes() if compression else packed


def _pieces(compression: str, source: Any, limit: int, step: int) -> Iterator[bytes]:
    """Decompress bytes, or with zstd a file, so many at a time; DamagedError beyond the limit."""
    n_left = limit
    for piece in iter(partial(_reader(compression, source), step), b''):
        n_left -= len(piece)
        if n_left < 0:
            raise DamagedError(f'it holds more than the {limit} bytes that it may')
        yield piece


def _reader(compression: str, source: Any) -> Callable[[int], bytes]:
    """Give what decompresses so many bytes; none at the end."""
    if compression == 'zstd':
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
        return decompressor.stream_reader(source, read_across_frames=True).read
    if compression not in _ENGINES:
        raise DamagedError(f'unknown compression {compression!r}, expected zstd, lz4 or none')
    engine, left = _ENGINES[compression](), [source]

    def read(n_bytes: int) -> bytes:
        if not left and (engine.eof or engine.needs_input):
            return b''
        data: bytes = engine.decompress(left.pop() if left else b'', max_length=n_bytes)
        return data

    return read
