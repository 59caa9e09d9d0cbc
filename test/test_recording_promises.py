# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Missing messages that a bag lists are reported; a scan of a chunk equals a plain loop."""

import os
import sqlite3
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import recording_helpers as rec
import yaml
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from thermo_comp.errors import RecordingError
from thermo_comp.recording.chunks import locate, scan_records
from thermo_comp.recording.reader import inspect_recording, open_recording, read_recording


def whole(folder, storage='mcap', compression=''):
    messages, path = rec.regular_messages(400), folder / 'bag'
    rec.write_rosbag2(path, messages, storage=storage, compression=compression)
    return path


def test_rows_deleted_from_a_database_are_reported(tmp_path, cli):
    bag = whole(tmp_path, 'sqlite3')
    with sqlite3.connect(bag / 'bag.db3') as database:
        query = 'delete from messages where id > 100 and topic_id = '
        query += '(select id from topics where name = ?)'
        n_left = 400 - database.execute(query, (rec.ACCEL,)).rowcount
    text = f'{rec.ACCEL}: {n_left} of 400 listed messages are in the bag'
    assert inspect_recording(bag).truncated == text
    assert text in cli('info', bag, code=1).stdout
    calibration = Path(__file__).parent.parent / 'config' / 'calibration.example.yaml'
    done = cli('replay', bag, '-c', calibration, '-o', tmp_path / 'o.mcap', '--serial', '', code=1)
    assert text in done.stderr
    assert (tmp_path / 'o.mcap').is_file()


def test_messages_that_a_topic_lacks_are_reported_at_the_end_of_the_first_reading(tmp_path, cli):
    messages = rec.regular_messages(400, accel=rec.IMU_IN)
    for message in messages:
        if message.topic == rec.IMU_IN:  # `convert` requires |f| = g at rest
            message.numbers = (*message.numbers[:25], 0.0, 0.0, 9.81, *message.numbers[28:])
    rec.write_rosbag2(tmp_path / 'bag', messages, storage='sqlite3')
    with sqlite3.connect(tmp_path / 'bag' / 'bag.db3') as database:
        database.execute('delete from messages where id > 400')
    topics = ('--topic', f'board={rec.BOARD}', '--topic', f'case={rec.CASE}')
    done = cli('convert', tmp_path / 'bag', '-o', tmp_path / 'o.mcap', *topics, code=1)
    assert 'listed messages are in the bag' in done.stderr
    rec.write_mcap(tmp_path / 'bag.mcap', rec.regular_messages(40))
    with open_recording(tmp_path / 'bag.mcap') as reader:
        kind = reader.info.topics[rec.ACCEL][0]
        reader.info = replace(reader.info, topics={**reader.info.topics, rec.ACCEL: (kind, 64)})
        for _ in range(2):  # a second pass must not add a second message
            assert sum(map(len, reader.blocks())) == 40
        assert reader.info.truncated == f'{rec.ACCEL}: 40 of 64 listed messages are in the bag'


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_topic_that_only_the_metadata_list_is_reported(tmp_path, storage):
    bag = whole(tmp_path, storage)
    path = bag / 'metadata.yaml'
    content = yaml.safe_load(path.read_text())
    topics = content['rosbag2_bagfile_information']['topics_with_message_count']
    topic = yaml.safe_load(yaml.safe_dump(topics[0]))
    topic['topic_metadata']['name'] = '/gone'
    topics.append({**topic, 'message_count': 7})
    path.write_text(yaml.safe_dump(content))
    assert inspect_recording(bag).truncated == '/gone: 0 of 7 listed messages are in the bag'


def test_a_compressed_file_is_read_up_to_its_damage(tmp_path):
    rec.write_rosbag2(tmp_path / 'bag', rec.regular_messages(8000), compression='FILE')
    bag = tmp_path / 'bag'
    (packed,) = bag.glob('*.zstd')
    data = packed.read_bytes()
    half = len(data) // 2
    for damaged in (data[:half], data[:half] + bytes(4096) + data[half + 4096 :]):
        packed.write_bytes(damaged)
        recording = read_recording(bag)
        message = recording.info.truncated or ''
        assert 0 < len(recording.columns) < 8000
        for topic, n_all in ((rec.ACCEL, 8000), (rec.BOARD, 1000), (rec.CASE, 1000)):
            n_read = recording.info.topics[topic][1]
            assert f'{topic}: {n_read} of {n_all} listed messages' in message
    assert f'{packed.name} is unreadable after' in message
    packed.write_bytes(data[:8])
    with pytest.raises(RecordingError, match=rf'{packed.name}: damaged: it has no content'):
        read_recording(bag)


def test_a_compressed_file_expands_within_limits_and_leaves_no_file(tmp_path, monkeypatch):
    bag = whole(tmp_path, 'mcap', 'FILE')
    temporary = tmp_path / 'temporary'
    temporary.mkdir()
    monkeypatch.setattr('tempfile.tempdir', str(temporary))
    read_recording(bag)
    assert not list(temporary.iterdir())
    (packed,) = bag.glob('*.zstd')
    with packed.open('wb') as out, zstandard.ZstdCompressor(19).stream_writer(out) as writer:
        for _ in range(128):
            writer.write(bytes(1 << 20))
    with pytest.raises(RecordingError, match=rf'{packed.name}: damaged: its content exceeds'):
        read_recording(bag)
    assert not list(temporary.iterdir())
    (tmp_path / 'messages').mkdir()
    bag = whole(tmp_path / 'messages', 'sqlite3', 'MESSAGE')
    with sqlite3.connect(bag / 'bag.db3') as database:
        bomb = zstandard.compress(bytes(1 << 28))
        database.execute('update messages set data = ? where id = 1', (bomb,))
    with pytest.raises(RecordingError, match=r'\.db3: damaged: its content exceeds .* 67108864 '):
        read_recording(bag)


@pytest.mark.parametrize('packing', ['BZ2', 'LZ4'])
def test_a_chunk_of_a_ros1_bag_expands_within_limits(tmp_path, packing, monkeypatch):
    store, kind = get_typestore(Stores.ROS1_NOETIC), 'sensor_msgs/msg/Temperature'
    header = store.types['std_msgs/msg/Header']
    stamp = store.types['builtin_interfaces/msg/Time']
    monkeypatch.setattr('thermo_comp.recording.chunks.MAX_CHUNK_BYTES', 1 << 22)
    for n_bytes, is_read in ((1 << 20, True), (1 << 23, False)):
        path = tmp_path / f'{n_bytes}.bag'
        writer = Writer(path)
        writer.set_compression(Writer.CompressionFormat[packing])
        with writer:
            board = writer.add_connection('/temperature/board', kind, typestore=store)
            other = writer.add_connection('/other', kind, typestore=store)
            head = header(seq=1, stamp=stamp(sec=5, nanosec=0), frame_id='')
            message = store.types[kind](header=head, temperature=20.5, variance=0.0)
            writer.write(board, 5, store.serialize_ros1(message, kind))
            writer.write(other, 6, bytes(n_bytes))
        assert path.stat().st_size < 1 << 20
        if is_read:
            columns = read_recording(path, require=('board',)).columns
            assert columns.temperatures['board'].celsius.tolist() == [20.5]
        else:
            with pytest.raises(RecordingError, match='its content exceeds the limit of 4194304 b'):
                read_recording(path, require=('board',))


def test_a_fifo_or_a_device_is_never_waited_for(tmp_path):
    for name in ('bag.mcap', 'bag.db3', 'bag.bag'):
        os.mkfifo(tmp_path / name)
        with pytest.raises(RecordingError, match=r'not a bag: neither a file nor a directory'):
            inspect_recording(tmp_path / name)
    folder = tmp_path / 'folder'
    folder.mkdir()
    os.mkfifo(folder / 'folder_0.mcap')
    (folder / 'folder_1.db3').symlink_to('/dev/zero')
    with pytest.raises(RecordingError, match=r'the directory has no metadata\.yaml'):
        inspect_recording(folder)
    os.mkfifo(folder / 'metadata.yaml')
    with pytest.raises(RecordingError, match=r'metadata\.yaml: .*not a regular file'):
        inspect_recording(folder)
    whole_bag = whole(tmp_path)
    os.mkfifo(whole_bag / 'beside.mcap')
    assert len(read_recording(whole_bag).columns) == 400


MESSAGE, CHANNEL = 5, 4


def message(channel, log_ns, content):
    body = struct.pack('<HIQQ', channel, 0, log_ns, log_ns) + content
    return struct.pack('<BQ', MESSAGE, len(body)) + body


def other(content):
    return struct.pack('<BQ', CHANNEL, len(content)) + content


def one_by_one(data):
    """Return place, size, channel and log time of each message; other records; end of the last."""
    at, messages, others = 0, [], []
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from('<BQ', data, at)
        if opcode == 0 or at + 9 + length > len(data) or (opcode == MESSAGE and length < 22):
            break
        if opcode == MESSAGE:
            channel, _, log_ns, _ = struct.unpack_from('<HIQQ', data, at + 9)
            messages.append((at, length - 22, channel, log_ns))
        else:
            others.append(data[at + 9 : at + 9 + length])
        at += 9 + length
    return messages, others, at


def listed(messages):
    columns = (messages.start - 31, messages.size, messages.channel, messages.log_ns)
    return list(zip(*(column.tolist() for column in columns), strict=True))


#: These contents of messages look like MCAP records.
DECEITFUL = [
    b'\x05' * 40, message(1, 5, b'\x05' * 9), (message(1, 7, b'') * 3)[:40],
    struct.pack('<BQ', MESSAGE, 22 + 40) * 4, bytes(40),
]  # fmt: skip


@st.composite
def records(draw):
    pieces = []
    for _ in range(draw(st.integers(1, 6))):
        content = draw(st.sampled_from(DECEITFUL) | st.binary(max_size=60))
        pattern = [
            message(draw(st.integers(0, 9)), draw(st.integers(0, 2**63 - 1)), content),
            message(draw(st.integers(0, 9)), 3, draw(st.binary(max_size=8))),
        ]
        if draw(st.booleans()):
            pattern.append(other(draw(st.binary(max_size=20))))
        for _ in range(draw(st.sampled_from([1, 3, 60]))):
            pieces += draw(st.permutations(pattern)) if draw(st.booleans()) else pattern
    return b''.join(pieces)


def index_of(entries):
    pieces = []
    for channel in sorted({entry[2] for entry in entries}):
        own = [entry for entry in entries if entry[2] == channel]
        rows = b''.join(struct.pack('<QQ', log_ns, at) for at, *_, log_ns in own)
        pieces.append(struct.pack('<BQHI', 7, len(rows) + 6, channel, len(rows)) + rows)
    return b''.join(pieces)


@settings(max_examples=120, deadline=None)
@given(data=records(), cut=st.integers(0, 200), tail=st.binary(max_size=30), drawn=st.data())
def test_a_scan_with_a_right_or_false_index_equals_a_plain_loop(data, cut, tail, drawn):
    """WHY: an index that points into the content of a message could give false samples."""
    others = []

    def keep(_, content):
        others.append(content)

    torn = data[: len(data) - cut] + tail
    wanted, wanted_others, wanted_end = one_by_one(torn)
    if all(log_ns < 2**63 for _, _, _, log_ns in wanted):
        others.clear()
        messages, reason = scan_records(np.frombuffer(torn, np.uint8), keep)
        # Zeros after a message may have replaced its end, too, so the scan omits the message.
        is_wiped = len(torn) >= wanted_end + 9 and torn[wanted_end] == 0
        assert listed(messages) == (wanted[:-1] if is_wiped else wanted)
        assert others == wanted_others
        assert (reason == '') == (wanted_end == len(torn))
    wanted, wanted_others, _ = one_by_one(data)
    place = st.integers(0, len(data)) | st.sampled_from([entry[0] for entry in wanted])
    places = drawn.draw(st.lists(place, max_size=20))
    kept = drawn.draw(st.sampled_from([wanted, wanted[:-1], wanted[1:], []]))
    index = index_of([*kept, *((at, 0, 1, 0) for at in places)])
    others.clear()
    assert listed(locate(np.frombuffer(data, np.uint8), memoryview(index), keep)) == wanted
    assert others == wanted_others
