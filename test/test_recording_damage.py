# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Damage: a torn bag is read up to its last whole message and said to be torn; a corrupt one is one
clear error; nothing crashes, hangs or takes memory that the file does not justify.

"""

from __future__ import annotations

import os
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
from recording_helpers import (
    ACCEL,
    BOARD,
    CASE,
    OTHER,
    Message,
    assert_columns,
    regular_messages,
    serialize,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

from thermo_comp.errors import RecordingError
from thermo_comp.recording import (
    BagWriter,
    Recording,
    Topics,
    inspect_recording,
    open_recording,
    read_recording,
)

HEAD_BYTES = 31


def read(path: Path) -> Recording:
    return read_recording(path, require=())


def outcome(path: Path) -> Recording | RecordingError:
    """
    Read a bag that may be damaged; any other exception than the right one fails the test.

    """
    try:
        return read(path)
    except RecordingError as error:
        return error


def chunk_places(path: Path) -> list[tuple[int, int]]:
    """
    Position and length of each chunk record, by the `mcap` library's reading of the summary.

    """
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [(c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes]


@lru_cache(maxsize=8)
def small_bag(compression: str, use_chunking: bool = True) -> tuple[bytes, int, int]:
    """
    Bytes of a bag of 24 counts in three chunks, and the last chunk's position and length.

    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap')
        write_mcap(
            path,
            regular_messages(24),
            chunk_size=600,
            compression=compression,
            use_chunking=use_chunking,
        )
        position, length = chunk_places(path)[-1] if use_chunking else (0, 0)
        return path.read_bytes(), position, length


def every_cut(content: bytes, position: int, length: int) -> list[int]:
    """
    Every byte of the last chunk, and every 17th of the indexes and the summary behind it.

    """
    end = position + length
    return [*range(position, end), *range(end, len(content), 17), len(content) - 1]


def test_cut_at_every_byte_of_the_last_chunk(tmp_path: Path) -> None:
    content, position, length = small_bag('none')
    messages = regular_messages(24)
    # Where each message ends in the file, counted by hand from the layout of a chunk.
    at = position + 9 + 40
    last: list[int] = []
    while at < position + length:
        size = struct.unpack_from('<Q', content, at + 1)[0] + 9
        at += size
        last.append(at)
    n_before = len(messages) - len(last)
    assert 0 < n_before < len(messages)
    path = tmp_path / 'bag.mcap'
    for cut in every_cut(content, position, length):
        path.write_bytes(content[:cut])
        n_whole = n_before + sum(end <= cut for end in last)
        recording = read(path)
        assert_columns(recording.columns, messages[:n_whole])
        assert recording.info.truncated is not None, cut
        assert recording.info.truncated.startswith(f'the file is cut off at byte {cut}: ')
        assert recording.info.n_messages == n_whole
        if position + 49 <= cut < position + length:
            assert f'the first {n_whole - n_before} messages are read' in recording.info.truncated
    path.write_bytes(content)
    assert read(path).info.truncated is None


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_cut_inside_a_compressed_chunk_gives_a_prefix(tmp_path: Path, compression: str) -> None:
    content, position, length = small_bag(compression)
    messages = regular_messages(24)
    path = tmp_path / 'bag.mcap'
    counts: list[int] = []
    for cut in every_cut(content, position, length):
        path.write_bytes(content[:cut])
        recording = read(path)
        counts.append(recording.info.n_messages)
        assert_columns(recording.columns, messages[: counts[-1]])
        assert recording.info.truncated is not None
    assert counts == sorted(counts)  # a longer piece never holds less
    assert counts[-1] == len(messages)


def test_most_of_a_large_torn_chunk_is_saved(tmp_path: Path) -> None:
    """
    A streaming decompressor gives what stands before the cut: not the chunk is lost, but a block.

    """
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
        # Incompressible numbers: half of the bytes hold nearly half of the messages. A block of
        # zstd is 128 KiB of content, 1700 messages.
        assert 0.4 * n < len(columns) < 0.6 * n
        assert (columns.accel == xyz[: len(columns)]).all()


@settings(max_examples=60, deadline=None)
@given(data=st.data(), compression=st.sampled_from(['none', 'lz4', 'zstd', 'unchunked']))
def test_cut_anywhere(data: st.DataObject, compression: str) -> None:
    is_chunked = compression != 'unchunked'
    content, _, _ = small_bag(compression if is_chunked else 'none', is_chunked)
    cut = data.draw(st.integers(0, len(content) - 1))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap')
        path.write_bytes(content[:cut])
        found = outcome(path)
        if isinstance(found, RecordingError):
            assert cut < 60, found  # only a file without a whole header holds nothing at all
        else:
            assert found.info.truncated is not None
            assert_columns(found.columns, regular_messages(24)[: found.info.n_messages])


def test_zeros_at_the_end_are_no_messages(tmp_path: Path) -> None:
    """
    WHY: after a power failure a file may have its full length and zeros for its last pages.
    PROMISE: no message with a zeroed part is given out.

    """
    messages = regular_messages(24)
    path = tmp_path / 'bag.mcap'
    for is_chunked in (True, False):
        content, position, _ = small_bag('none', is_chunked)
        for at in range(position + 60 if is_chunked else 700, len(content), 37):
            path.write_bytes(content[:at] + bytes(4096))
            found = outcome(path)
            if isinstance(found, Recording):
                assert found.info.truncated is not None
                n = len(found.columns) + len(found.columns.board) + len(found.columns.case)
                assert_columns(found.columns, messages[:n])


def test_a_torn_directory_says_which_file(tmp_path: Path) -> None:
    messages = regular_messages(40)
    write_rosbag2(tmp_path / 'bag', messages[:20])
    write_mcap(tmp_path / 'bag' / 'bag_1.mcap', messages[20:])
    metadata = tmp_path / 'bag' / 'metadata.yaml'
    metadata.write_text(
        metadata.read_text().replace('- bag.mcap', '- bag.mcap\n  - bag_1.mcap', 1)
    )
    torn = tmp_path / 'bag' / 'bag_1.mcap'
    torn.write_bytes(torn.read_bytes()[:-20])
    info = inspect_recording(tmp_path / 'bag')
    assert str(info.truncated).startswith('bag_1.mcap: the file is cut off at byte ')
    assert 'no message is' in str(info.truncated)


@settings(max_examples=500, deadline=None)
@given(
    data=st.data(),
    compression=st.sampled_from(['none', 'lz4', 'zstd', 'unchunked']),
    n_changes=st.integers(1, 6),
)
def test_changed_bytes_are_an_error_or_harmless(
    data: st.DataObject, compression: str, n_changes: int
) -> None:
    is_chunked = compression != 'unchunked'
    content = bytearray(small_bag(compression if is_chunked else 'none', is_chunked)[0])
    for _ in range(n_changes):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap')
        path.write_bytes(content)
        found = outcome(path)
        if isinstance(found, RecordingError):
            assert '\n' not in str(found)
            assert 'bag.mcap' in str(found)
        else:
            assert len(found.columns) <= 24


@settings(max_examples=200, deadline=None)
@given(content=st.binary(max_size=300), has_magic=st.booleans())
def test_any_bytes_are_an_error_or_an_empty_bag(content: bytes, has_magic: bool) -> None:
    magic = b'\x89MCAP0\r\n' + b'\x01' + struct.pack('<Q', 8) + bytes(8)
    with tempfile.TemporaryDirectory() as folder:
        for name in ('bag.mcap', 'bag.db3', 'bag.bag'):
            path = Path(folder, name)
            path.write_bytes(magic + content if has_magic else content)
            found = outcome(path)
            if isinstance(found, RecordingError):
                assert '\n' not in str(found)
            else:
                assert len(found.columns) == 0


def chunk_record(content: bytes, compression: str, size: int, checksum: int = 0) -> bytes:
    name = compression.encode()
    head = struct.pack('<QQQII', 1, 2, size, checksum, len(name)) + name
    body = head + struct.pack('<Q', len(content)) + content
    return struct.pack('<BQ', Opcode.CHUNK, len(body)) + body


def whole_file(*records: bytes) -> bytes:
    magic = b'\x89MCAP0\r\n'
    header = struct.pack('<BQ', Opcode.HEADER, 8) + bytes(8)
    end = struct.pack('<BQI', Opcode.DATA_END, 4, 0)
    footer = struct.pack('<BQQQI', Opcode.FOOTER, 20, 0, 0, 0)
    return magic + header + b''.join(records) + end + footer + magic


HUGE = 1 << 60
#: A record of 100 bytes that means nothing.
PADDING = b'\x0f' + struct.pack('<Q', 91) + bytes(91)


@pytest.mark.parametrize(
    ('record', 'reason'),
    [
        (chunk_record(b'x' * 50, '', HUGE), 'claim to hold'),
        (chunk_record(zstandard.compress(bytes(1000)), 'zstd', HUGE), 'claim to hold'),
        (chunk_record(lz4.frame.compress(bytes(1000)), 'lz4', HUGE), 'claim to hold'),
        (chunk_record(zstandard.compress(bytes(1 << 22)), 'zstd', 1000), 'more than the 1000'),
        (chunk_record(lz4.frame.compress(bytes(1 << 22)), 'lz4', 1000), 'more than the 1000'),
        (chunk_record(zstandard.compress(bytes(100)), 'zstd', 2000), '100 bytes after'),
        (chunk_record(b'not zstd at all', 'zstd', 100), 'zstd'),
        (chunk_record(b'not lz4 at all', 'lz4', 100), 'lz4'),
        (chunk_record(b'x', 'brotli', 100), "unknown compression 'brotli'"),
        (chunk_record(bytes(100), '', 100), 'opcode 0'),
        (chunk_record(b'\x05' + struct.pack('<Q', HUGE) + bytes(91), '', 100), 'ends too early'),
        (chunk_record(b'\x05' + struct.pack('<Q', 3) + bytes(91), '', 100), '3 bytes'),
        (chunk_record(b'\x0f' + struct.pack('<Q', 91) + bytes(91), '', 100, 99), 'checksum'),
        (struct.pack('<BQ', Opcode.CHUNK, 10) + bytes(10), 'shorter than its content'),
        (struct.pack('<BQ', Opcode.CHUNK, 40) + bytes(28) + b'\xff' * 12, 'damaged head'),
        (struct.pack('<BQ', Opcode.CHUNK, HUGE) + bytes(10), 'not whole'),
        (struct.pack('<BQ', Opcode.MESSAGE, 3) + bytes(3), 'message record has 3 bytes'),
        (struct.pack('<BQ', Opcode.SCHEMA, 3) + bytes(3), 'shorter than its content'),
        (struct.pack('<BQ', 0, 3) + bytes(3), 'not whole'),
    ],
)
def test_claims_are_not_believed(tmp_path: Path, record: bytes, reason: str) -> None:
    path = tmp_path / 'bag.mcap'
    path.write_bytes(whole_file(record))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RecordingError, match=reason):
        read(path)
    # In KiB: no claim makes the reader take more than a whole ordinary chunk (64 MiB).
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


@pytest.mark.parametrize(
    ('record', 'reason'),
    [
        (chunk_record(zstandard.compress(PADDING * 90), 'zstd', 5000), 'more than the 5000'),
        (chunk_record(zstandard.compress(b'\x0f' + bytes(8)), 'zstd', 5000), '9 bytes after'),
        (chunk_record(b'not zstd at all', 'zstd', 5000), 'decompression: zstd'),
        (chunk_record(b'x', 'brotli', 5000), "unknown compression 'brotli'"),
        (
            chunk_record(b'\x0f' + struct.pack('<Q', 4991) + bytes(4991), '', 5000, 99),
            'the checksum does not fit',
        ),
        (
            chunk_record(b'\x05' + struct.pack('<Q', HUGE) + bytes(4991), '', 5000),
            f'a record of {HUGE} bytes',
        ),
    ],
)
def test_claims_of_large_chunks_are_not_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: bytes, reason: str
) -> None:
    monkeypatch.setattr('thermo_comp.recording.survey.MAX_CHUNK_BYTES', 2000)
    monkeypatch.setattr('thermo_comp.recording.chunk.WINDOW_BYTES', 1000)
    path = tmp_path / 'bag.mcap'
    path.write_bytes(whole_file(record))
    with pytest.raises(RecordingError, match=reason):
        read(path)


def test_a_torn_file_of_large_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('thermo_comp.recording.survey.MAX_CHUNK_BYTES', 200)
    monkeypatch.setattr('thermo_comp.recording.chunk.WINDOW_BYTES', 300)
    path = tmp_path / 'bag.mcap'
    for compression in ('none', 'zstd', 'lz4'):
        content, position, length = small_bag(compression)
        for cut in range(position - 100, position + length + 100, 11):
            path.write_bytes(content[:cut])
            recording = read(path)
            assert recording.info.truncated is not None
            n = recording.info.n_messages
            assert_columns(recording.columns, regular_messages(24)[:n])


def test_a_damaged_compressed_end_is_left_out(tmp_path: Path) -> None:
    content, position, length = small_bag('zstd')
    damaged = bytearray(content[: position + length])
    damaged[position + length // 2] ^= 255
    path = tmp_path / 'bag.mcap'
    path.write_bytes(damaged)
    recording = read(path)
    assert str(recording.info.truncated).endswith('; its last chunk is damaged and left out')
    assert_columns(recording.columns, regular_messages(24)[: recording.info.n_messages])
    # The same chunk torn as well: what its decompressor gives before the damage.
    path.write_bytes(damaged[:-5])
    assert 'ends inside a chunk' in str(read(path).info.truncated)


def test_a_summary_that_is_nonsense(tmp_path: Path) -> None:
    content = bytearray(small_bag('none')[0])
    path = tmp_path / 'bag.mcap'
    footer = len(content) - 37
    (summary,) = struct.unpack_from('<Q', content, footer + 9)
    for at in (summary, summary + 9):  # the first record's opcode; its schema's number and name
        changed = bytearray(content)
        changed[at : at + 8] = b'\xff' * 8
        path.write_bytes(changed)
        assert_columns(read(path).columns, regular_messages(24))
    for claim in (1, HUGE):
        struct.pack_into('<Q', content, footer + 9, claim)
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=f'puts the summary at byte {claim}'):
            read(path)


def test_small_records_are_small(tmp_path: Path) -> None:
    path = tmp_path / 'bag.mcap'
    large = bytes((1 << 22) + 1)
    path.write_bytes(whole_file(struct.pack('<BQ', Opcode.METADATA, len(large)) + large))
    assert read(path).info.metadata == {}
    path.write_bytes(whole_file(struct.pack('<BQ', Opcode.SCHEMA, len(large)) + large))
    with pytest.raises(RecordingError, match=f'has {len(large)} bytes'):
        read(path)


def test_a_wrong_message_index_is_only_a_hint(tmp_path: Path) -> None:
    """
    WHY: offsets of a damaged index can point into a payload that looks like a record.
    PROMISE: the records themselves decide, whatever the index says.

    """
    messages = regular_messages(24)
    path = tmp_path / 'bag.mcap'
    content, position, length = small_bag('none')
    index_at = position + length
    assert content[index_at] == Opcode.MESSAGE_INDEX
    first_row = index_at + 9 + 2 + 4
    for offset in (0, 1, 7, 80, 10_000, 1 << 62, (1 << 64) - 1):
        changed = bytearray(content)
        struct.pack_into('<Q', changed, first_row + 8, offset)
        path.write_bytes(changed)
        assert_columns(read(path).columns, messages)
    changed = bytearray(content)
    struct.pack_into('<I', changed, index_at + 11, 3)  # a length that is no multiple of a row
    path.write_bytes(changed)
    assert_columns(read(path).columns, messages)


def test_false_times_of_a_chunk_are_found(tmp_path: Path) -> None:
    content, position, _ = small_bag('none')
    path = tmp_path / 'bag.mcap'
    start, end = struct.unpack_from('<QQ', content, position + 9)
    changed = content.replace(struct.pack('<QQ', start, end), struct.pack('<QQ', start + 5, end))
    path.write_bytes(changed)
    with pytest.raises(RecordingError, match='outside the time it claims'):
        read(path)


def test_a_changed_number_is_found_by_the_checksum(tmp_path: Path) -> None:
    content, position, length = small_bag('none')
    changed = bytearray(content)
    changed[position + length - 3] ^= 1
    path = tmp_path / 'bag.mcap'
    path.write_bytes(changed)
    with pytest.raises(RecordingError, match='checksum does not fit'):
        read(path)


def short_message(data: bytes) -> bytes:
    record = struct.pack('<HIQQ', 1, 0, 1, 1) + data
    return struct.pack('<BQ', Opcode.MESSAGE, len(record)) + record


def text(value: str) -> bytes:
    return struct.pack('<I', len(value.encode())) + value.encode()


def declared(encoding: str = 'cdr', kind: str = 'geometry_msgs/msg/Vector3Stamped') -> bytes:
    schema = struct.pack('<H', 1) + text(kind) + text('ros2msg') + text('')
    channel = struct.pack('<HH', 1, 1) + text(ACCEL) + text(encoding) + text('')
    return b''.join(
        struct.pack('<BQ', opcode, len(body)) + body
        for opcode, body in ((Opcode.SCHEMA, schema), (Opcode.CHANNEL, channel))
    )


@pytest.mark.parametrize(
    ('data', 'reason'),
    [
        (b'', 'its size does not fit'),
        (b'\x00\x01\x00\x00' + bytes(12), 'its size does not fit'),
        (b'\x00\x01\x00\x00' + bytes(8) + struct.pack('<I', 1 << 31) + bytes(40), 'does not fit'),
        (b'\x00\x07\x00\x00' + bytes(48), 'representation 0x0007'),
        (b'\x00\x01\x00\x00' + bytes(80), 'does not fit'),
    ],
)
def test_messages_of_another_layout_are_named(tmp_path: Path, data: bytes, reason: str) -> None:
    path = tmp_path / 'bag.mcap'
    path.write_bytes(whole_file(declared(), short_message(data)))
    with pytest.raises(RecordingError, match=rf'bag\.mcap: {ACCEL}: .*{reason}'):
        read(path)


def test_ros_1_messages_in_an_mcap_file(tmp_path: Path) -> None:
    path = tmp_path / 'bag.mcap'
    numbers = struct.pack('<3d', 1.5, -2.5, 3.5)
    data = struct.pack('<IIII', 9, 12, 34, 4) + b'link' + numbers
    path.write_bytes(
        whole_file(declared('ros1', 'geometry_msgs/Vector3Stamped'), short_message(data))
    )
    with open_recording(path, require=('accel',)) as reader:
        (block,) = reader.blocks(raw=True)
    assert block.accel.tolist() == [[1.5, -2.5, 3.5]]
    assert block.accel_stamp_ns.tolist() == [12 * 10**9 + 34]
    assert block.frame_id == 'link'
    # Given out raw, it is CDR like any other.
    message = Message(ACCEL, 1, 12 * 10**9 + 34, 'link', (1.5, -2.5, 3.5))
    assert block.raw[0].data.tobytes() == serialize(message)


def test_messages_in_another_encoding_are_named(tmp_path: Path) -> None:
    path = tmp_path / 'bag.mcap'
    both = declared() + declared('ros1').replace(
        struct.pack('<HH', 1, 1), struct.pack('<HH', 2, 1)
    )
    message = Message(ACCEL, 1, 1, '', (1.0, 2.0, 3.0))
    path.write_bytes(whole_file(both, short_message(serialize(message))))
    with pytest.raises(RecordingError, match=f'{ACCEL}: its messages have several encodings'):
        read(path)
    path.write_bytes(whole_file(declared('json'), short_message(b'{}')))
    with pytest.raises(RecordingError, match="encoded as 'json', expected cdr"):
        read(path)


def test_what_is_no_bag(tmp_path: Path) -> None:
    def refused(path: Path, reason: str) -> None:
        with pytest.raises(RecordingError, match=reason):
            open_recording(path)

    refused(tmp_path / 'nowhere', 'nowhere: no such file or directory')
    refused(tmp_path / ('x' * 300), 'cannot be opened: File name too long')
    os.mkfifo(tmp_path / 'pipe.mcap')
    refused(tmp_path / 'pipe.mcap', 'not a bag: neither a file nor a directory')
    (tmp_path / 'notes.txt').write_text('hello')
    refused(tmp_path / 'notes.txt', r'not a bag: expected a directory, \.mcap, \.db3 or \.bag')
    (tmp_path / 'text.mcap').write_text('hello, this is no bag at all')
    refused(tmp_path / 'text.mcap', 'not an MCAP file')
    (tmp_path / 'empty.mcap').write_bytes(b'')
    refused(tmp_path / 'empty.mcap', 'the file is empty')
    (tmp_path / 'begun.mcap').write_bytes(b'\x89MCAP0\r\n\x01')
    refused(tmp_path / 'begun.mcap', 'cut off inside its header')
    (tmp_path / 'odd.mcap').write_bytes(b'\x89MCAP0\r\n\x02' + bytes(50))
    refused(tmp_path / 'odd.mcap', 'does not begin with a header')
    (tmp_path / 'text.bag').write_text('hello')
    refused(tmp_path / 'text.bag', r'text\.bag: the bag cannot be read')
    (tmp_path / 'text.db3').write_text('hello')
    refused(tmp_path / 'text.db3', r'text\.db3: the bag cannot be read')
    (tmp_path / 'folder').mkdir()
    refused(tmp_path / 'folder', r'not a bag: the directory has no metadata\.yaml')
    for content, reason in (
        ('{', 'not valid YAML'),
        ('a: 1', 'not the metadata of a rosbag2 bag'),
        ('- 1', 'not the metadata of a rosbag2 bag'),
        ('rosbag2_bagfile_information: {relative_file_paths: []}', 'not the metadata'),
        (
            'rosbag2_bagfile_information: {relative_file_paths: [a.mcap], storage_identifier: m}',
            r'the file a\.mcap of the bag is missing',
        ),
        ('[' * 5000, 'not valid YAML'),
    ):
        (tmp_path / 'folder' / 'metadata.yaml').write_text(content)
        refused(tmp_path / 'folder', reason)


def test_topics_that_are_not_there_or_are_something_else(tmp_path: Path) -> None:
    path = tmp_path / 'bag.mcap'
    messages = regular_messages(8)
    write_mcap(path, messages)
    with pytest.raises(RecordingError, match=r'counts: no such topic; the bag has /accel/counts '):
        open_recording(path, Topics(counts='my/counts'), input='counts')
    with pytest.raises(
        RecordingError, match=r'or x/imu: no such topic.*--counts-topic or --imu-t'
    ):
        open_recording(path, Topics(counts='x/counts', imu='x/imu'))
    with pytest.raises(RecordingError, match='name another with --case-topic'):
        open_recording(path, Topics(case='other/case'))
    with pytest.raises(RecordingError, match='has type sensor_msgs/msg/Temperature, expected geo'):
        open_recording(path, Topics(counts=BOARD))
    write_mcap(path, [m for m in messages if m.topic != CASE])
    with pytest.raises(RecordingError, match='temperature/case: no such topic'):
        open_recording(path)
    with open_recording(path, require=('accel', 'board')) as reader:
        (block,) = reader.blocks()
        assert (len(block), len(block.board), len(block.case)) == (8, 1, 0)
    write_mcap(path, [])
    with pytest.raises(RecordingError, match='the bag holds no messages'):
        open_recording(path)
    assert inspect_recording(path).input is None
    assert len(read(path).columns) == 0


def test_a_required_topic_without_messages(tmp_path: Path) -> None:
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        bag.write_counts('accel/counts', [1, 2], np.zeros((2, 3)))
        bag.write_temperature('temperature/board', [1], [20.0])
        bag.write_temperature('temperature/case', [], [])
    with pytest.raises(RecordingError, match='/temperature/case: the topic has no messages'):
        open_recording(path)


def test_two_topics_that_fit_are_ambiguous(tmp_path: Path) -> None:
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        for unit in ('a', 'b'):
            bag.write_counts(f'{unit}/accel/counts', [1], np.zeros((1, 3)))
    with pytest.raises(RecordingError, match=r'several topics end in it: /a/.*, /b/.*--counts-to'):
        open_recording(path)
    with open_recording(path, Topics(counts='b/accel/counts'), require=('accel',)) as reader:
        assert reader.topics == {'accel': '/b/accel/counts'}


def test_names_from_a_bag_cannot_forge_lines(tmp_path: Path) -> None:
    """
    WHY: a topic's name is whatever stands in the file; an error is one line of a terminal.

    """
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        for row in range(30):
            bag.write_bool(f'a\nb\x1b[31m{row:02}' + 'x' * 1000, [1], [True])
    with pytest.raises(RecordingError, match=r'/a\\nb\\x1b\[31m00x.* and 10 more; name') as caught:
        open_recording(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 3000


def test_torn_bags_of_other_storages_are_one_line(tmp_path: Path) -> None:
    messages = [*regular_messages(400), Message(OTHER, 0)]
    write_rosbag2(tmp_path / 'bag', messages, storage='sqlite3')
    write_rosbag1(tmp_path / 'bag.bag', messages)
    for path in (tmp_path / 'bag' / 'bag.db3', tmp_path / 'bag.bag'):
        content = path.read_bytes()
        path.write_bytes(content[: len(content) * 2 // 3])
        with pytest.raises(RecordingError, match='cannot be read') as caught:
            read(path)
        assert '\n' not in str(caught.value)


def test_wire_sizes_are_as_the_layout_says() -> None:
    # 4 encapsulation + align8(12 + 6) = 24 + 3 * 8: the sizes that the tests above rely on.
    assert len(serialize(Message(ACCEL, 0, 0, 'accel', (1.0, 2.0, 3.0)))) == 52
