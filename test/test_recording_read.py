# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags written by other tools give columns with all messages, in the order of log times."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
import recording_helpers as rec
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import IndexType
from rosbags.rosbag2 import Reader as Reader2
from test_recording_damage import read

from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import open_recording, read_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter

WIDTHS = {rec.ACCEL: 3, rec.IMU_IN: 37, rec.BOARD: 2, rec.CASE: 2, rec.OTHER: 0}


@st.composite
def bags(draw, accel=rec.ACCEL, lowest=-3):
    """Draw messages with equal or falling log times, several frames and both byte orders."""
    frames = draw(st.lists(st.text('abcxyz_/é', max_size=24), min_size=1, max_size=3))
    topics = (accel, rec.BOARD, rec.CASE, rec.OTHER)
    messages = []
    log_ns = rec.START_NS
    for topic in draw(st.lists(st.sampled_from(topics), min_size=1, max_size=60)):
        log_ns += draw(st.integers(lowest, 4)) * 1000
        stamp_ns, frame = draw(st.integers(0, 2**31 * 10**9 - 1)), draw(st.sampled_from(frames))
        numbers = [draw(st.floats(width=64)) for _ in range(min(WIDTHS[topic], 3))]
        numbers += map(float, range(3, WIDTHS[topic]))
        is_little = draw(st.booleans()) if draw(st.booleans()) else True
        messages.append(rec.Message(topic, log_ns, stamp_ns, frame, tuple(numbers), is_little))
    return messages


def in_reading_order(messages):
    return sorted(messages, key=lambda message: message.log_ns)


@settings(max_examples=80, deadline=None)
@given(
    messages=bags(),
    chunk_size=st.sampled_from([1, 150, 400, 1000, 5000, 1 << 20]),
    use_chunking=st.sampled_from([True, True, True, False]),
    compression=st.sampled_from(['none', 'lz4', 'zstd']),
    index_types=st.sampled_from([IndexType.ALL, IndexType.CHUNK, IndexType.MESSAGE, IndexType(0)]),
    use_statistics=st.booleans(),
    repeat=st.booleans(),
    enable_crcs=st.booleans(),
)
def test_any_file_gives_its_messages_in_order_of_log_time(messages, **options):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap')
        rec.write_mcap(path, messages, **options)
        recording = read(path)
        rec.assert_columns(recording.columns, in_reading_order(messages))
        assert recording.info.truncated is None
        assert recording.info.n_messages == len(messages)
        assert recording.info.start_ns == min(message.log_ns for message in messages)
        assert recording.info.end_ns == max(message.log_ns for message in messages)
        is_indexed = options['index_types'] == IndexType.ALL
        if options['use_chunking'] and is_indexed and options['repeat']:
            # Versions of rosbags differ in the order of messages with equal log times.
            with Reader2(path) as reader:
                order = [(log_ns, link.topic) for link, log_ns, _ in reader.messages()]
            wanted = [(m.log_ns, m.topic) for m in in_reading_order(messages)]
            assert [log_ns for log_ns, _ in order] == [log_ns for log_ns, _ in wanted]
            assert sorted(order) == sorted(wanted)


@settings(max_examples=25, deadline=None)
@given(messages=bags(accel=rec.IMU_IN), chunk_size=st.sampled_from([500, 3000, 1 << 20]))
def test_every_number_of_an_imu_message_arrives(messages, chunk_size):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap')
        rec.write_mcap(path, messages, chunk_size=chunk_size, compression='lz4')
        columns = read(path).columns
        ordered = in_reading_order(messages)
        rec.assert_columns(columns, ordered)
        numbers = [m.numbers for m in ordered if m.topic == rec.IMU_IN]
        if not numbers:
            assert columns.imu is None or len(columns.imu.orientation) == 0
            return
        together = np.hstack(
            [
                columns.imu.orientation, columns.imu.orientation_covariance,
                columns.imu.angular_velocity, columns.imu.angular_velocity_covariance,
                columns.accel, columns.imu.linear_acceleration_covariance,
            ],
        )  # fmt: skip
        assert together.tobytes() == np.array(numbers).tobytes()


@settings(max_examples=12, deadline=None)
@given(
    messages=bags(lowest=0),
    storage=st.sampled_from(['mcap', 'sqlite3']),
    compression=st.sampled_from(['', 'FILE', 'MESSAGE', 'STORAGE']),
)
def test_directories_written_by_rosbags_are_read(messages, storage, compression):
    compression = '' if storage == 'sqlite3' and compression == 'STORAGE' else compression
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag')
        rec.write_rosbag2(path, messages, storage=storage, compression=compression)
        recording = read(path)
        rec.assert_columns(recording.columns, messages)
        assert (recording.info.storage, recording.info.n_messages) == (storage, len(messages))


@settings(max_examples=10, deadline=None)
@given(messages=bags(lowest=1))
def test_bags_of_ros_1_are_read(messages):
    # A ROS 1 bag has no order between topics for equal log times, so all log times differ.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.bag')
        rec.write_rosbag1(path, messages)
        recording = read(path)
        rec.assert_columns(recording.columns, messages)
        assert recording.info.storage == 'ros1'


@pytest.mark.parametrize('accel', [rec.ACCEL, rec.IMU_IN])
def test_raw_messages_have_the_bytes_of_the_bag(tmp_path, accel):
    messages = rec.regular_messages(accel=accel)
    rec.write_mcap(tmp_path / 'bag.mcap', messages, chunk_size=900)
    rec.write_rosbag2(tmp_path / 'bag', messages, storage='sqlite3')
    rec.write_rosbag1(tmp_path / 'bag.bag', messages)
    for name in ('bag.mcap', 'bag', 'bag.bag'):
        with open_recording(tmp_path / name) as reader:
            (block,) = reader.blocks(raw=True)
            content = {reader.topics[role]: raw for role, raw in block.raw.items()}
        assert set(content) == {accel, rec.BOARD, rec.CASE}
        for topic, raw in content.items():
            wanted = [m for m in messages if m.topic == topic]
            assert list(raw) == [rec.serialize(m) for m in wanted]
            assert raw.log_ns.tolist() == [m.log_ns for m in wanted]


def test_blocks_end_where_the_frame_changes_and_together_have_all_messages(tmp_path):
    messages = rec.regular_messages(60)
    for row, message in enumerate(messages):
        message.frame_id = 'front' if row % 30 < 11 else 'a_longer_name'
    rec.write_mcap(tmp_path / 'bag.mcap', messages, chunk_size=1500)
    with open_recording(tmp_path / 'bag.mcap') as reader:
        blocks = list(reader.blocks())
    frames = [message.frame_id for message in messages if message.topic == rec.ACCEL]
    assert [frame for block in blocks for frame in [block.frame_id] * len(block)] == frames
    before, n_accel = 0, 0
    for block in blocks:
        # For each reading, `after` is the index in its block of the first sample after it.
        after = block.temperatures['board'].after
        assert ((after >= 0) & (after <= len(block))).all()
        before += len(after)
        n_accel += len(block)
    assert (before, n_accel) == (8, 60)
    rec.assert_columns(read(tmp_path / 'bag.mcap').columns, messages)


def test_overlapping_chunks_are_read_by_log_time_and_too_many_are_refused(tmp_path, monkeypatch):
    messages = rec.regular_messages(60)
    shuffled = [m for pair in zip(messages[1::2], messages[::2], strict=False) for m in pair]
    for row, message in enumerate(messages):
        message.frame_id = 'abc'[row % 3] * (1 + row % 5)
    rec.write_mcap(tmp_path / 'bag.mcap', shuffled, chunk_size=250)
    with open_recording(tmp_path / 'bag.mcap') as reader:
        blocks = list(reader.blocks(raw=True))
    serialized = [content for block in blocks for content in block.raw.get('accel', ())]
    wanted = [m for m in sorted(shuffled, key=lambda m: m.log_ns) if m.topic == rec.ACCEL]
    assert serialized == [rec.serialize(m) for m in wanted]
    frames = [block.frame_id for block in blocks for _ in range(len(block))]
    assert frames == [m.frame_id for m in wanted]
    monkeypatch.setattr('thermo_comp.recording.mcap_file._MAX_HELD_BYTES', 4000)
    messages = rec.regular_messages(200)
    combed = [message for begin in range(40) for message in messages[begin::40]]
    rec.write_mcap(tmp_path / 'bag.mcap', combed, chunk_size=400)
    with pytest.raises(RecordingError, match=r'too many of its chunks overlap in time'):
        read(tmp_path / 'bag.mcap')


def test_the_files_of_a_split_bag_are_read_in_order(tmp_path):
    messages = rec.regular_messages(90)
    rec.write_rosbag2(tmp_path / 'bag', messages[:50])
    rec.write_mcap(tmp_path / 'bag' / 'bag_1.mcap', messages[50:80])
    rec.write_mcap(tmp_path / 'bag' / 'bag_10.mcap', messages[80:])
    metadata = tmp_path / 'bag' / 'metadata.yaml'
    text = metadata.read_text()
    listed = text.replace(
        'relative_file_paths:\n  - bag.mcap',
        'relative_file_paths:\n  - bag.mcap\n  - ../elsewhere/bag_1.mcap\n  - bag_10.mcap',
    )
    assert listed != text
    metadata.write_text(listed)
    recording = read(tmp_path / 'bag')
    rec.assert_columns(recording.columns, messages)
    assert recording.info.truncated is None
    assert recording.info.n_messages == len(messages)
    # Without metadata.yaml, as after a kill of the recorder, numbers in file names give the order.
    (tmp_path / 'bag' / 'bag.mcap').rename(tmp_path / 'bag' / 'bag_0.mcap')
    (tmp_path / 'bag' / 'bag_1.mcap').rename(tmp_path / 'bag' / 'bag_2.mcap')
    for text in (None, ''):
        metadata.unlink(missing_ok=True)
        if text is not None:
            metadata.write_text(text)
        recording = read(tmp_path / 'bag')
        rec.assert_columns(recording.columns, messages)
        assert recording.info.truncated == (
            'metadata.yaml is missing, the recording was not finished'
        )


def test_databases_without_metadata_are_read_and_a_folder_of_several_bags_is_refused(tmp_path):
    for name in ('01.mcap', '02.mcap'):
        (tmp_path / name).write_bytes(b'')
    with pytest.raises(RecordingError, match=r'folder of several bags: name its 2 \*\.mcap'):
        read(tmp_path)
    messages = rec.regular_messages()
    rec.write_rosbag2(tmp_path / 'bag', messages, storage='sqlite3')
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    recording = read(tmp_path / 'bag')
    rec.assert_columns(recording.columns, messages)
    assert 'metadata.yaml is missing' in str(recording.info.truncated)
    shutil.copy(tmp_path / 'bag' / 'bag.db3', tmp_path / 'bare.db3')
    rec.assert_columns(read(tmp_path / 'bare.db3').columns, messages)


def written(path, *topics, counts='accel/counts'):
    with BagWriter(path) as bag:
        bag.write_counts(counts, rec.START_NS + np.arange(3), np.zeros((3, 3)))
        for row, topic in enumerate(topics):
            bag.write_temperature(topic, [rec.START_NS + 1], [20.0 + row])
    return path


def celsius_of(temperatures):
    return {name: part.celsius.tolist() for name, part in temperatures.items()}


def test_topics_can_be_named_by_input_and_further_thermometers_are_found(tmp_path):
    path = written(tmp_path / 'bag', 't1', 't2', 't3', 'temperature/lid', counts='raw')
    names = {'counts': '/raw', 'board': 't1', 'temperature/case': 't2', 'temperature/magnet': 't3'}
    found = read_recording(path, Topics.named(names))
    assert found.info.chosen is None
    expected = {'board': [20.0], 'case': [21.0], 'lid': [23.0], 'magnet': [22.0]}
    assert celsius_of(found.columns.temperatures) == expected
    with pytest.raises(RecordingError, match=r'/t9: no such topic.*--topic temperature/magnet='):
        open_recording(path, Topics.named({**names, 'temperature/magnet': '/t9'}))
    with pytest.raises(RecordingError, match=r'/raw: the topic has type geometry_msgs/msg/Vector'):
        open_recording(path, Topics.named({**names, 'temperature/magnet': '/raw'}))
    for wrong in ('bord', 'temperature/', 'temperature/A b', 'magnet'):
        reason = f'`{wrong}` is not an input; expected counts, imu, bo'
        with pytest.raises(ValueError, match=reason):
            Topics.named({wrong: '/t1'})
    with pytest.raises(ValueError, match='`case` needs the name of a topic'):
        Topics.named({'case': '/'})
    names = ('board', 'case', 'lid', 'Tip', 'accel', 'a/b')
    topics = [f'imu0/temperature/{name}' for name in names]
    path = written(tmp_path / 'imu0', *topics, 'temperature/lid', counts='imu0/accel/counts')
    temperatures = read_recording(path).columns.temperatures
    assert celsius_of(temperatures) == {'board': [20.0], 'case': [21.0], 'lid': [22.0]}
    assert temperatures['lid'].after.tolist() == [2]


def test_the_only_topic_of_a_type_is_used_and_of_two_both_are_named(tmp_path):
    path = written(tmp_path / 'one', 'imu/die', counts='imu/ticks')
    with open_recording(path, require=('accel', 'board')) as reader:
        assert reader.topics == {'accel': '/imu/ticks', 'board': '/imu/die'}
        assert reader.info.chosen == (
            '/imu/ticks, the only Vector3Stamped of the bag, is taken for counts; '
            '/imu/die, the only Temperature of the bag, is taken for board'
        )
    # By its type a board topic is chosen only if none is named, and if only one may be meant.
    with pytest.raises(RecordingError, match='my/die: no such topic'):
        open_recording(path, Topics(board='my/die'), require=('board',))
    for topics in (('imu/die', 'baro/air'), ('temperature/case',), ('x/temperature/case',)):
        several = written(tmp_path / topics[0].replace('/', '_'), *topics)
        with pytest.raises(RecordingError, match='temperature/board: no such topic'):
            open_recording(several, require=('board',))
    # WHY: `fit` used neither thermometer, and stated that no temperature was recorded.
    path = written(tmp_path / 'two', 'imu/die', 'baro/air')
    with open_recording(path, require=('accel',)) as reader:
        assert 'board' not in reader.topics
        assert reader.info.chosen == (
            'no temperature/board: if the board thermometer is /baro/air or /imu/die, give '
            '--topic board=TOPIC'
        )
    with open_recording(path, Topics(board='/imu/die'), require=('accel',)) as reader:
        assert reader.info.chosen is None


@pytest.mark.parametrize('n_messages', [100, 500])
def test_blocks_have_similar_sizes_and_are_read_again_until_closed(
    tmp_path, monkeypatch, n_messages
):
    monkeypatch.setattr('thermo_comp.recording.blocks.BLOCK_MESSAGES', n_messages)
    path = tmp_path / 'bag.mcap'
    rec.write_mcap(path, rec.regular_messages(2000), chunk_size=2000)
    with open_recording(path) as reader:
        first = next(iter(reader.blocks()))  # the first pass stops after one block
        blocks = list(reader.blocks())
    assert first.accel.tobytes() == blocks[0].accel.tobytes()
    sizes = [block.n_messages for block in blocks]
    assert n_messages <= min(sizes[:-1]) <= max(sizes) < n_messages + 100
    whole = read(path).columns.accel
    assert np.concatenate([block.accel for block in blocks]).tobytes() == whole.tobytes()
    rec.write_rosbag1(tmp_path / 'bag.bag', rec.regular_messages())
    for name in ('bag.mcap', 'bag.bag'):
        with open_recording(tmp_path / name) as reader:
            pass
        reader.close()  # closing a closed reader has no effect
        with pytest.raises(RecordingError, match=rf'{name}: the recording is closed'):
            next(reader.blocks())
