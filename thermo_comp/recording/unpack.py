# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns decompression of chunks: whole ones at once, large or torn ones as a stream.

What a chunk or a frame claims about its size is only ever an upper limit: memory is taken for
what the reader is willing to hold, and output beyond the claim is damage.
"""

from __future__ import annotations

import zlib
from contextlib import suppress
from pathlib import Path
from typing import IO, Protocol, cast

import lz4.frame
import numpy as np
import zstandard

from ..typing import Bytes
from .mcap_records import DamagedError
from .random_access import LocalFile, RandomAccess

#: What claims to grow by more than this, beyond so many bytes, is not believed.
_MAX_GROWTH = 1024
_FREE_GROWTH_BYTES = 1 << 26
_MAX_WINDOW = 1 << 27
_READ_BYTES = 1 << 20
#: Up to so much before a damage is lost with it.
_STEP_BYTES = 1 << 16


def growth_limit(n_packed: int) -> int:
    """Say how many bytes so many packed ones may hold at most."""
    return n_packed * _MAX_GROWTH + _FREE_GROWTH_BYTES


def expand(packed: Path, target: Path) -> str | None:
    """
    Decompress a file that rosbag2 has compressed as a whole, as far as it can be read.

    Parameters
    ----------
    packed : Path
        The ``.zstd`` file.
    target : Path
        The file to write.

    Returns
    -------
    str or None
        Where its content ends too early, in words; None where it is whole.

    Raises
    ------
    DamagedError
        It holds more than it may, or nothing.
    OSError
        The disk is full or the like.

    """
    handle = LocalFile(packed)
    limit = growth_limit(handle.size)
    stream = open_stream('zstd', Region(handle, 0, handle.size))
    n_bytes = 0
    loss = None
    try:
        with target.open('wb') as file:
            while data := stream.read(_STEP_BYTES):
                n_bytes += len(data)
                if n_bytes > limit:
                    raise DamagedError(f'{handle.size} bytes hold more than {limit}')
                file.write(data)
    except _CompressionError as error:
        loss = f'{packed.name} is unreadable behind {n_bytes} bytes of its content ({error})'
    finally:
        handle.close()
    if not n_bytes:
        raise DamagedError(loss or 'it holds nothing that can be decompressed')
    return loss


def unpack_message(packed: bytes) -> bytes:
    """
    Decompress one message that rosbag2 has compressed by itself.

    Raises
    ------
    DamagedError
        Damaged bytes, or more than a chunk may hold.

    """
    try:
        size = zstandard.frame_content_size(packed)
        if size > _FREE_GROWTH_BYTES:
            raise DamagedError(f'a message of {size} bytes')
        return zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).decompress(
            packed, max_output_size=_FREE_GROWTH_BYTES
        )
    except zstandard.ZstdError as error:
        raise DamagedError(f'zstd: {error}') from error


def unpack(compression: str, packed: Bytes, size: int, checksum: int) -> Bytes:
    """
    Decompress a whole chunk.

    Parameters
    ----------
    compression : str
        As the chunk names it: empty, ``lz4`` or ``zstd``.
    packed : ndarray of uint8
        The compressed bytes.
    size : int
        Decompressed size that the chunk claims; the caller has limited it.
    checksum : int
        CRC-32 of the decompressed bytes, 0 where there is none.

    Raises
    ------
    DamagedError
        Unknown compression, damaged bytes, wrong size or checksum.

    """
    if compression == '':
        data = packed
    elif compression == 'zstd':
        data = _unpack_zstd(packed, size)
    elif compression == 'lz4':
        data = _unpack_lz4(packed, size)
    else:
        raise DamagedError(f'unknown compression {compression!r}, expected zstd, lz4 or none')
    if len(data) != size:
        raise DamagedError(f'{len(data)} bytes after decompression, expected {size}')
    if checksum and zlib.crc32(data.data) != checksum:
        raise DamagedError('the checksum does not fit the content')
    return data


def _unpack_zstd(packed: Bytes, size: int) -> Bytes:
    with suppress(zstandard.ZstdError):
        # One frame that says how long it is, as all usual writers make it, is taken in one go.
        if zstandard.frame_content_size(packed.data) == size:
            whole = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).decompress(
                packed.data, allow_extra_data=False
            )
            return np.frombuffer(whole, np.uint8)
    data = np.empty(size, np.uint8)
    view = data.data
    try:
        with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(
            packed.data, read_across_frames=True
        ) as reader:
            while len(view) > 0 and (n_read := reader.readinto(view)):
                view = view[n_read:]
            if reader.read(1):
                raise DamagedError(f'more than the {size} bytes that it claims')
    except zstandard.ZstdError as error:
        raise DamagedError(f'zstd: {error}') from error
    return data[: size - len(view)]


def _unpack_lz4(packed: Bytes, size: int) -> Bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    try:
        data = decompressor.decompress(packed.data, max_length=size)
        if not decompressor.eof and decompressor.decompress(b'', max_length=1):
            raise DamagedError(f'more than the {size} bytes that it claims')
    except (RuntimeError, EOFError) as error:
        raise DamagedError(f'lz4: {error}') from error
    return np.frombuffer(data, np.uint8)


class _CompressionError(DamagedError):
    """Bytes that do not decompress."""


class Stream(Protocol):
    """Bytes that come in pieces."""

    def read(self, n_bytes: int) -> bytes:
        """Read up to so many bytes; none means the end."""
        ...


class Region:
    """
    A stretch of a file as a stream.

    Parameters
    ----------
    handle : RandomAccess
        The open file.
    begin, end : int
        The stretch [bytes].

    """

    def __init__(self, handle: RandomAccess, begin: int, end: int) -> None:
        self._handle = handle
        self._at = begin
        self._end = end

    def read(self, n_bytes: int = -1) -> bytes:
        """Read up to so many bytes; none means the end."""
        left = self._end - self._at
        data = self._handle.read_at(self._at, left if n_bytes < 0 else min(n_bytes, left))
        self._at += len(data)
        return data


class Lz4Stream:
    """The content of an lz4 frame as a stream."""

    def __init__(self, source: Stream) -> None:
        self._source = source
        self._decompressor = lz4.frame.LZ4FrameDecompressor()

    def read(self, n_bytes: int) -> bytes:
        """Read up to so many bytes; none means the end."""
        while not self._decompressor.eof:
            packed = self._source.read(_READ_BYTES) if self._decompressor.needs_input else b''
            if self._decompressor.needs_input and not packed:
                break
            data: bytes = self._decompressor.decompress(packed, max_length=n_bytes)
            if data:
                return data
        return b''


def open_stream(compression: str, source: Region) -> Stream:
    """
    Decompress a chunk as it comes.

    Parameters
    ----------
    compression : str
        As the chunk names it: empty, ``lz4`` or ``zstd``.
    source : Region
        The compressed bytes, possibly cut off.

    Returns
    -------
    Stream
        Its `read` raises DamagedError on damaged bytes.

    Raises
    ------
    DamagedError
        Unknown compression.

    """
    if compression == '':
        return source
    if compression == 'zstd':
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
        reader = decompressor.stream_reader(cast(IO[bytes], source), read_across_frames=True)
        return _Guarded(reader)
    if compression == 'lz4':
        return _Guarded(Lz4Stream(source))
    raise DamagedError(f'unknown compression {compression!r}, expected zstd, lz4 or none')


class _Guarded:
    def __init__(self, inner: Stream) -> None:
        self._inner = inner

    def read(self, n_bytes: int) -> bytes:
        try:
            return self._inner.read(n_bytes)
        except (zstandard.ZstdError, RuntimeError, EOFError) as error:
            raise _CompressionError(f'decompression: {error}') from error
