# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns decompression within limits: of chunks, of the beginning of torn ones, of files, of messages.

What a chunk or a frame claims about its size is only ever an upper limit of what is taken for it.
"""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
_ERRORS = (zstandard.ZstdError, RuntimeError, EOFError)


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
        size = packed.stat().st_size
        limit = size * _MAX_GROWTH + _FREE_GROWTH_BYTES
        loss = None
        try:
            for data in _pieces('zstd', source, _STEP_BYTES):
                if file.tell() + len(data) > limit:
                    raise DamagedError(f'{size} bytes hold more than {limit}')
                file.write(data)
        except zstandard.ZstdError as error:
            n_bytes = file.tell()
            loss = f'{packed.name} is unreadable behind {n_bytes} bytes of its content ({error})'
        if not file.tell():
            raise DamagedError(loss or 'it holds nothing that can be decompressed')
        return loss


def unpack_message(packed: bytes) -> bytes:
    """Decompress one message that rosbag2 has compressed by itself."""
    size = zstandard.frame_content_size(packed)
    if size > _FREE_GROWTH_BYTES:
        raise DamagedError(f'a message of {size} bytes')
    decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
    return decompressor.decompress(packed, max_output_size=_FREE_GROWTH_BYTES)


def unpack_ros1_chunk(packed: bytes) -> bytes:
    """Decompress a chunk of a ROS 1 bag; DamagedError where it holds more than a chunk may."""
    engine: Any
    if packed[:3] == b'BZh':
        engine = bz2.BZ2Decompressor()
    elif packed[:4] == b'\x04\x22\x4d\x18':
        engine = lz4.frame.LZ4FrameDecompressor()
    else:
        return packed
    data: bytes = engine.decompress(packed, max_length=MAX_CHUNK_BYTES + 1)
    if len(data) > MAX_CHUNK_BYTES:
        raise DamagedError(f'a chunk of {len(packed)} bytes holds more than {MAX_CHUNK_BYTES}')
    if not engine.eof:
        raise DamagedError('a chunk is cut off')
    return data


def unpack(compression: str, packed: Bytes, size: int, checksum: int) -> Bytes:
    """Decompress a whole chunk that claims this size and CRC-32 (0 = none), or DamagedError."""
    data = packed
    if compression:
        pieces = []
        try:
            for piece in _pieces(compression, packed.data, size + 1):
                pieces.append(piece)
                if sum(map(len, pieces)) > size:
                    raise DamagedError(f'more than the {size} bytes that it claims')
        except _ERRORS as error:
            raise DamagedError(f'{compression}: {error}') from error
        data = np.frombuffer(b''.join(pieces), np.uint8)
    if len(data) != size:
        raise DamagedError(f'{len(data)} bytes after decompression, expected {size}')
    if checksum and zlib.crc32(data.data) != checksum:
        raise DamagedError('the checksum does not fit the content')
    return data


def unpack_beginning(compression: str, packed: Bytes) -> Bytes:
    """Decompress a torn chunk as far as its bytes go."""
    if compression == '':
        return packed
    pieces: list[bytes] = []
    with suppress(*_ERRORS):
        for piece in _pieces(compression, packed.data, _STEP_BYTES):
            pieces.append(piece)
            if len(pieces) * _STEP_BYTES > MAX_CHUNK_BYTES:
                break
    return np.frombuffer(b''.join(pieces), np.uint8)


def _pieces(compression: str, source: Any, step: int) -> Iterator[bytes]:
    """Decompress bytes, or with zstd a file, so many at a time."""
    if compression == 'zstd':
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
        with decompressor.stream_reader(source, read_across_frames=True) as reader:
            while piece := reader.read(step):
                yield piece
        return
    if compression != 'lz4':
        raise DamagedError(f'unknown compression {compression!r}, expected zstd, lz4 or none')
    engine = lz4.frame.LZ4FrameDecompressor()
    piece = engine.decompress(source, max_length=step)
    while piece:
        yield piece
        if engine.eof or engine.needs_input:
            return
        piece = engine.decompress(b'', max_length=step)
