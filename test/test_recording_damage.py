# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Cut bags are read up to the last complete message; corrupt bags give an error of one line."""

import resource
import struct
import tempfile
from functools import lru_cache
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from recording_helpers import assert_columns, regular_messages, write_mcap, write_rosbag2

from thermo_comp.errors import RecordingError
from thermo_comp.recording.blocks import Recording
from thermo_comp.recording.reader import inspect_recording, read_recording
from thermo_comp.recording.writer import BagWriter


def read(path):
    return read_recording(path, require=())


def outcome(path):
    """Read a damaged bag, or return its `RecordingError`; other exceptions fail the test."""
    try:
        return read(path)
    except RecordingError as error:
        return error


def chunk_places(path):
    """Return position and length of each chunk record, as stated in the summary of the file."""
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
    return [(c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes]


@lru_cache(maxsize=8)
def small_bag(compression, use_chunking=True):
    """Return a bag of 24 messages in three chunks, and the last chunk's position and length."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap')
        keys = {'compression': compression, 'use_chunking': use_chunking}
        write_mcap(path, regular_messages(24), chunk_size=600, **keys)
        position, length = chunk_places(path)[-1] if use_chunking else (0, 0)
        return path.read_bytes(), position, length


def test_a_bag_cut_in_its_last_chunk_is_read_up_to_the_cut(tmp_path):
    content, position, length = small_bag('none')
    messages = regular_messages(24)
    # `last` has the positions in the file at which messages of the last chunk end.
    at = position + 9 + 40
    last = []
    while at < position + length:
        at += struct.unpack_from('<Q', content, at + 1)[0] + 9
        last.append(at)
    n_before = len(messages) - len(last)
    assert 0 < n_before < len(messages)
    path = tmp_path / 'bag.mcap'
    # Cut the bag at each byte of the last chunk, and after this chunk at every 17th byte.
    end = position + length
    for cut in (*range(position, end), *range(end, len(content), 17), len(content) - 1):
        path.write_bytes(content[:cut])
        n_whole = n_before + sum(place <= cut for place in last)
        recording = read(path)
        assert_columns(recording.columns, messages[:n_whole])
        assert recording.info.truncated is not None, cut
        assert recording.info.truncated.startswith(f'the file is cut off at byte {cut}: ')
        assert recording.info.n_messages == n_whole
        if position + 49 <= cut < position + length:
            assert f'the first {n_whole - n_before} messages are read' in recording.info.truncated
    path.write_bytes(content)
    assert read(path).info.truncated is None


def test_the_messages_before_a_cut_in_a_large_chunk_are_read(tmp_path):
    """A compressed block that is cut is lost; the blocks before it are decompressed."""
    n = 60_000
    stamps = np.arange(n) * 2_500_000
    xyz = np.random.default_rng(3).integers(-30_000, 30_000, (n, 3))
    for compression in ('zstd', 'lz4'):
        path = tmp_path / f'{compression}.mcap'
        with BagWriter(path, compression=compression, chunk_bytes=1 << 24) as bag:
            bag.write_counts('accel/counts', stamps, xyz)
        content = path.read_bytes()
        ((position, length),) = chunk_places(path)
        path.write_bytes(content[: position + length // 2])
        columns = read(path).columns
        # Random numbers are incompressible, so half of the bytes contain half of the messages.
        assert 0.4 * n < len(columns) < 0.6 * n
        assert (columns.accel == xyz[: len(columns)]).all()


@settings(max_examples=60, deadline=None)
@given(data=st.data(), compression=st.sampled_from(['none', 'lz4', 'zstd', 'unchunked']))
def test_a_bag_cut_anywhere_is_read_or_refused(data, compression):
    is_chunked = compression != 'unchunked'
    content, _, _ = small_bag(compression if is_chunked else 'none', is_chunked)
    cut = data.draw(st.integers(0, len(content) - 1))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap')
        path.write_bytes(content[:cut])
        result = outcome(path)
        if isinstance(result, RecordingError):
            assert cut < 60, result  # only without a complete header is a file refused
        else:
            assert result.info.truncated is not None
            assert_columns(result.columns, regular_messages(24)[: result.info.n_messages])


def test_messages_overwritten_by_zeros_are_not_returned(tmp_path):
    """After a power failure a file may end in zeros, which must not give messages."""
    messages = regular_messages(24)
    path = tmp_path / 'bag.mcap'
    for is_chunked in (True, False):
        content, position, _ = small_bag('none', is_chunked)
        for at in range(position + 60 if is_chunked else 700, len(content), 37):
            path.write_bytes(content[:at] + bytes(4096))
            result = outcome(path)
            if isinstance(result, Recording):
                assert result.info.truncated is not None
                assert_columns(result.columns, messages[: result.columns.n_messages])


def test_the_message_names_the_cut_file_of_a_directory(tmp_path):
    messages = regular_messages(40)
    write_rosbag2(tmp_path / 'bag', messages[:20])
    write_mcap(tmp_path / 'bag' / 'bag_1.mcap', messages[20:])
    metadata = tmp_path / 'bag' / 'metadata.yaml'
    text = metadata.read_text()
    metadata.write_text(text.replace('- bag.mcap', '- bag.mcap\n  - bag_1.mcap', 1))
    torn = tmp_path / 'bag' / 'bag_1.mcap'
    torn.write_bytes(torn.read_bytes()[:-20])
    info = inspect_recording(tmp_path / 'bag')
    assert str(info.truncated).startswith('bag_1.mcap: the file is cut off at byte ')
    assert 'all messages are there' in str(info.truncated)


@settings(max_examples=200, deadline=None)
@given(
    data=st.data(),
    compression=st.sampled_from(['none', 'lz4', 'zstd', 'unchunked']),
    n_changes=st.integers(1, 6),
)
def test_a_bag_with_changed_bytes_is_refused_or_gives_valid_columns(data, compression, n_changes):
    is_chunked = compression != 'unchunked'
    content = bytearray(small_bag(compression if is_chunked else 'none', is_chunked)[0])
    for _ in range(n_changes):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap')
        path.write_bytes(content)
        result = outcome(path)
        if isinstance(result, RecordingError):
            assert '\n' not in str(result)
            assert 'bag.mcap' in str(result)
        else:
            assert len(result.columns) <= 24


@settings(max_examples=100, deadline=None)
@given(content=st.binary(max_size=300), has_magic=st.booleans())
def test_a_file_of_random_bytes_is_refused_or_an_empty_bag(content, has_magic):
    magic = b'\x89MCAP0\r\n' + b'\x01' + struct.pack('<Q', 8) + bytes(8)
    with tempfile.TemporaryDirectory() as folder:
        for name in ('bag.mcap', 'bag.db3', 'bag.bag'):
            path = Path(folder, name)
            path.write_bytes(magic + content if has_magic else content)
            result = outcome(path)
            if isinstance(result, RecordingError):
                assert '\n' not in str(result)
            else:
                assert len(result.columns) == 0


def chunk_record(content, compression, size, checksum=0):
    name = compression.encode()
    head = struct.pack('<QQQII', 1, 2, size, checksum, len(name)) + name
    body = head + struct.pack('<Q', len(content)) + content
    return struct.pack('<BQ', Opcode.CHUNK, len(body)) + body


def whole_file(*records):
    magic = b'\x89MCAP0\r\n'
    header = struct.pack('<BQ', Opcode.HEADER, 8) + bytes(8)
    end = struct.pack('<BQI', Opcode.DATA_END, 4, 0)
    footer = struct.pack('<BQQQI', Opcode.FOOTER, 20, 0, 0, 0)
    return magic + header + b''.join(records) + end + footer + magic


HUGE = 1 << 60


@pytest.mark.parametrize(
    ('record', 'reason'),
    [
        (chunk_record(b'x' * 50, '', HUGE), 'declare a content of'),
        (chunk_record(zstandard.compress(bytes(1000)), 'zstd', HUGE), 'declare a content of'),
        (chunk_record(lz4.frame.compress(bytes(1000)), 'lz4', HUGE), 'declare a content of'),
        (chunk_record(zstandard.compress(bytes(1 << 22)), 'zstd', 1000),
         'exceeds the limit of 1000'),
        (chunk_record(lz4.frame.compress(bytes(1 << 22)), 'lz4', 1000),
         'exceeds the limit of 1000'),
        (chunk_record(zstandard.compress(bytes(100)), 'zstd', 2000), '100 bytes after'),
        (chunk_record(b'not zstd at all', 'zstd', 100), 'zstd'),
        (chunk_record(b'not lz4 at all', 'lz4', 100), 'lz4'),
        (chunk_record(b'x', 'brotli', 100), "unknown compression 'brotli'"),
        (chunk_record(bytes(100), '', 100), 'opcode 0'),
        (chunk_record(b'\x05' + struct.pack('<Q', HUGE) + bytes(91), '', 100), 'ends too early'),
        (chunk_record(b'\x05' + struct.pack('<Q', 3) + bytes(91), '', 100), '3 bytes'),
        (chunk_record(b'\x0f' + struct.pack('<Q', 91) + bytes(91), '', 100, 99), 'checksum'),
        (chunk_record(bytes(10), '', (1 << 26) + 1), 'limit 67108864'),
        (struct.pack('<BQ', Opcode.CHUNK, 10) + bytes(10), 'damaged head'),
        (struct.pack('<BQ', Opcode.CHUNK, 40) + bytes(28) + b'\xff' * 12, 'damaged head'),
        (struct.pack('<BQ', Opcode.CHUNK, HUGE) + bytes(10), 'not complete'),
        (struct.pack('<BQ', Opcode.MESSAGE, 3) + bytes(3), 'message record has 3 bytes'),
        (struct.pack('<BQ', Opcode.SCHEMA, 3) + bytes(3), 'shorter than the lengths in it'),
        (struct.pack('<BQ', 0, 3) + bytes(3), 'not complete'),
    ],
)  # fmt: skip
def test_false_lengths_in_a_file_need_little_memory(tmp_path, record, reason):
    path = tmp_path / 'bag.mcap'
    path.write_bytes(whole_file(record))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RecordingError, match=reason):
        read(path)
    # Whatever length a record states, the reader uses less than 100 MB (ru_maxrss is in KiB).
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_a_damaged_chunk_summary_or_metadata_is_left_out_or_refused(tmp_path):
    content, position, length = small_bag('zstd')
    damaged = bytearray(content[: position + length])
    damaged[position + length // 2] ^= 255
    path = tmp_path / 'bag.mcap'
    path.write_bytes(damaged)
    recording = read(path)
    assert str(recording.info.truncated).endswith('; its last chunk is damaged and left out')
    assert_columns(recording.columns, regular_messages(24)[: recording.info.n_messages])
    path.write_bytes(damaged[:-5])
    assert 'ends inside a chunk' in str(read(path).info.truncated)
    content = bytearray(small_bag('none')[0])
    path = tmp_path / 'bag.mcap'
    footer = len(content) - 37
    (summary,) = struct.unpack_from('<Q', content, footer + 9)
    for at in (summary, summary + 9):  # the opcode and the schema of a record
        changed = bytearray(content)
        changed[at : at + 8] = b'\xff' * 8
        path.write_bytes(changed)
        assert_columns(read(path).columns, regular_messages(24))
    for claim in (1, HUGE):
        struct.pack_into('<Q', content, footer + 9, claim)
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=f'the summary cannot be at byte {claim}'):
            read(path)
    large = bytes((1 << 22) + 1)
    path.write_bytes(whole_file(struct.pack('<BQ', Opcode.METADATA, len(large)) + large))
    assert read(path).info.metadata == {}
    path.write_bytes(whole_file(struct.pack('<BQ', Opcode.SCHEMA, len(large)) + large))
    with pytest.raises(RecordingError, match=f'has {len(large)} bytes'):
        read(path)
    content, position, _ = small_bag('none')
    start, end = struct.unpack_from('<QQ', content, position + 9)
    changed = content.replace(struct.pack('<QQ', start, end), struct.pack('<QQ', start + 5, end))
    path.write_bytes(changed)
    with pytest.raises(RecordingError, match='outside its declared times'):
        read(path)
