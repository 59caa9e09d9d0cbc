# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Wrong layouts, encodings and topics, and files other than bags, are refused with the reason."""

import struct

import numpy as np
import pytest
import recording_helpers as rec
from mcap.opcode import Opcode
from test_recording_damage import read, whole_file

from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import inspect_recording, open_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter


def short_message(data):
    record = struct.pack('<HIQQ', 1, 0, 1, 1) + data
    return struct.pack('<BQ', Opcode.MESSAGE, len(record)) + record


def text(value):
    return struct.pack('<I', len(value.encode())) + value.encode()


def declared(encoding='cdr', kind='geometry_msgs/msg/Vector3Stamped'):
    schema = struct.pack('<H', 1) + text(kind) + text('ros2msg') + text('')
    channel = struct.pack('<HH', 1, 1) + text(rec.ACCEL) + text(encoding) + text('')
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
def test_messages_of_a_wrong_layout_are_refused(tmp_path, data, reason):
    path = tmp_path / 'bag.mcap'
    path.write_bytes(whole_file(declared(), short_message(data)))
    with pytest.raises(RecordingError, match=rf'bag\.mcap: {rec.ACCEL}: .*{reason}'):
        read(path)


def test_ros_1_messages_in_an_mcap_file_are_read(tmp_path):
    path = tmp_path / 'bag.mcap'
    data = struct.pack('<IIII', 9, 12, 34, 4) + b'link' + struct.pack('<3d', 1.5, -2.5, 3.5)
    kind = declared('ros1', 'geometry_msgs/Vector3Stamped')
    path.write_bytes(whole_file(kind, short_message(data)))
    with open_recording(path, require=('accel',)) as reader:
        (block,) = reader.blocks(raw=True)
    assert block.accel.tolist() == [[1.5, -2.5, 3.5]]
    assert (block.accel_stamp_ns.tolist(), block.frame_id) == ([12 * 10**9 + 34], 'link')
    message = rec.Message(rec.ACCEL, 1, 12 * 10**9 + 34, 'link', (1.5, -2.5, 3.5))
    assert block.raw['accel'].data.tobytes() == rec.serialize(message)


def test_messages_in_a_wrong_encoding_are_refused(tmp_path):
    path = tmp_path / 'bag.mcap'
    first, second = struct.pack('<HH', 1, 1), struct.pack('<HH', 2, 1)
    both = declared() + declared('ros1').replace(first, second)
    message = rec.Message(rec.ACCEL, 1, 1, '', (1.0, 2.0, 3.0))
    path.write_bytes(whole_file(both, short_message(rec.serialize(message))))
    with pytest.raises(RecordingError, match=f'{rec.ACCEL}: its messages have several encodings'):
        read(path)
    path.write_bytes(whole_file(declared('json'), short_message(b'{}')))
    with pytest.raises(RecordingError, match="encoded as 'json', expected cdr"):
        read(path)


def refused(path, reason, *given):
    with pytest.raises(RecordingError, match=reason):
        open_recording(path, *given)


def test_paths_that_are_not_a_bag_are_refused(tmp_path):
    refused(tmp_path / 'nowhere', 'nowhere: no such file or directory')
    refused(tmp_path / ('x' * 300), 'cannot be opened: File name too long')
    for name, content, reason in (
        ('notes.txt', b'', r'not a bag: expected a directory, \.mcap, \.db3 or \.bag; `therm'),
        ('text.mcap', b'hello, this is no bag at all', 'not an MCAP file'),
        ('empty.mcap', b'', 'the file is empty'),
        ('begun.mcap', b'\x89MCAP0\r\n\x01', 'cut off inside its header'),
        ('odd.mcap', b'\x89MCAP0\r\n\x02' + bytes(50), 'not an MCAP file'),
        ('text.bag', b'hello', r'text\.bag: the bag cannot be read'),
        ('text.db3', b'hello', r'text\.db3: the bag cannot be read'),
    ):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, reason)
    (tmp_path / 'folder').mkdir()
    refused(tmp_path / 'folder', r'not a bag: the directory has no metadata\.yaml')
    for content, reason in (
        ('{', 'not valid YAML'),
        ('a: 1', 'not the metadata of a rosbag2 bag'),
        ('- 1', 'not the metadata of a rosbag2 bag'),
        ('rosbag2_bagfile_information: {relative_file_paths: []}', 'not the metadata'),
        ('rosbag2_bagfile_information: {relative_file_paths: [a.mcap], storage_identifier: m}',
         r'the file a\.mcap of the bag is missing'),
        ('[' * 5000, 'not valid YAML'),
        ('rosbag2_bagfile_information: {relative_file_paths: [a], storage_identifier: mcap, '
         'topics_with_message_count: [{topic_metadata: {name: t}, message_count: .inf}]}',
         'not the metadata of a rosbag2 bag'),
    ):  # fmt: skip
        (tmp_path / 'folder' / 'metadata.yaml').write_text(content)
        refused(tmp_path / 'folder', reason)


def test_absent_empty_and_ambiguous_topics_and_topics_of_a_wrong_type_are_refused(tmp_path):
    path = tmp_path / 'bag.mcap'
    messages = rec.regular_messages(8)
    rec.write_mcap(path, messages)
    asked = Topics(counts='my/counts', input='counts')
    refused(path, r'counts: no such topic; the bag has /accel/counts ', asked)
    reason = r'or x/imu: no such topic.*--topic counts=TOPIC or --topic imu='
    refused(path, reason, Topics(counts='x/counts', imu='x/imu'))
    refused(path, 'name another with --topic case=', Topics(case='other/case'))
    refused(path, 'has type sensor_msgs/msg/Temperature, expected geo', Topics(counts=rec.BOARD))
    rec.write_mcap(path, [m for m in messages if m.topic != rec.CASE])
    refused(path, 'temperature/case: no such topic')
    with open_recording(path, require=('accel', 'board')) as reader:
        (block,) = reader.blocks()
        assert [len(times) for times in block.log_ns.values()] == [8, 1, 0]
    rec.write_mcap(path, [])
    refused(path, 'the bag holds no messages')
    assert inspect_recording(path).input is None
    assert len(read(path).columns) == 0
    path = tmp_path / 'empty.mcap'
    with BagWriter(path) as bag:
        bag.write_counts('accel/counts', [1, 2], np.zeros((2, 3)))
        bag.write_temperature('temperature/board', [1], [20.0])
        bag.write_temperature('temperature/case', [], [])
    refused(path, '/temperature/case: the topic has no messages')
    path = tmp_path / 'two.mcap'
    with BagWriter(path) as bag:
        for unit in ('a', 'b'):
            bag.write_counts(f'{unit}/accel/counts', [1], np.zeros((1, 3)))
    refused(path, r'several topics end in this name: /a/.*, /b/.*--topic counts=')
    with open_recording(path, Topics(counts='b/accel/counts'), require=('accel',)) as reader:
        assert reader.topics == {'accel': '/b/accel/counts'}


def test_topic_names_with_control_characters_are_escaped_in_messages(tmp_path):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        for row in range(30):
            bag.write_raw(f'a\nb\x1b[31m{row:02}' + 'x' * 1000, rec.BOOL, [1], [b''])
    with pytest.raises(RecordingError, match=r'/a\\nb\\x1b\[31m00x.* and 10 more; name') as caught:
        open_recording(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 3000


def test_cut_db3_and_bag_files_give_a_message_of_one_line(tmp_path):
    messages = [*rec.regular_messages(400), rec.Message(rec.OTHER, 0)]
    rec.write_rosbag2(tmp_path / 'bag', messages, storage='sqlite3')
    rec.write_rosbag1(tmp_path / 'bag.bag', messages)
    for path in (tmp_path / 'bag' / 'bag.db3', tmp_path / 'bag.bag'):
        content = path.read_bytes()
        path.write_bytes(content[: len(content) * 2 // 3])
        with pytest.raises(RecordingError, match='cannot be read') as caught:
            read(path)
        assert '\n' not in str(caught.value)


def driver_bag(path, *topics, metadata=None):
    """Write five messages per topic, of type Imu, Temperature, Bool or Vector3Stamped."""
    stamp_ns = rec.START_NS + np.arange(5) * 10**7
    with BagWriter(path, metadata=metadata or {}) as bag:
        for topic, kind in topics:
            if kind == 'imu':
                bag.write_imu(topic, stamp_ns, np.ones((5, 3)), np.zeros(9))
            elif kind == 'celsius':
                bag.write_temperature(topic, stamp_ns, np.full(5, 20.0))
            elif kind == 'flag':
                bag.write_raw(topic, rec.BOOL, stamp_ns, [b''] * 5)
            else:
                bag.write_counts(topic, stamp_ns, np.ones((5, 3)))
    return path


@pytest.mark.parametrize(
    ('topics', 'taken'),
    [
        # The input is imu/data_raw of REP 145, not the vector of a magnetometer.
        ([('imu/data_raw', 'imu'), ('imu/mag', 'vector')], '/imu/data_raw'),
        # The input is not a vector that an Xsens publishes: free acceleration or angular rate.
        ([('imu/data', 'imu'), ('filter/free_acceleration', 'vector')], '/imu/data'),
        ([('imu/data', 'imu'), ('imu/angular_velocity', 'vector')], '/imu/data'),
        # The input is imu/data_raw, the input of a filter, not imu/data, the output of a filter.
        ([('imu/data', 'imu'), ('imu/data_raw', 'imu')], '/imu/data_raw'),
        ([('a/imu/data_raw', 'imu'), ('a/accel/counts', 'vector')], '/a/accel/counts'),
        ([('adc/words', 'vector'), ('imu/mag', 'vector')], '/adc/words'),
        # Of two equally suitable topics none is chosen, and a magnetometer is never chosen.
        ([('left/imu', 'imu'), ('right/imu', 'imu'), ('adc/words', 'vector')], None),
        ([('imu/mag', 'vector')], None),
        # 'mag' and 'dv' in a namespace name no magnetometer and no velocity increment.
        ([('advanced_nav/imagery', 'vector')], '/advanced_nav/imagery'),
        ([('imu/dv', 'vector')], None),
        # The node publishes imu/data_raw if regime/dynamic has the same namespace.
        ([('imu/data_raw', 'imu'), ('regime/dynamic', 'flag')], None),
        ([('a/imu/data_raw', 'imu'), ('regime/dynamic', 'flag')], '/a/imu/data_raw'),
        ([('imu/data_raw', 'imu'), ('regime/dynamic', 'flag'), ('d/imu', 'imu')], '/d/imu'),
    ],
)
def test_an_imu_topic_is_chosen_before_a_vector_topic_of_unknown_meaning(tmp_path, topics, taken):
    path = driver_bag(tmp_path / 'bag', *topics)
    with open_recording(path, require=()) as reader:
        assert reader.topics.get('accel') == taken
    if taken is None:
        with pytest.raises(RecordingError, match='no such topic; the bag has /'):
            open_recording(path, require=('accel',))


def test_a_named_input_is_taken_but_not_for_two_inputs(tmp_path):
    topics = ('accel/counts', 'vector'), ('imu/data', 'imu'), ('imu/temperature', 'celsius')
    path = driver_bag(tmp_path / 'bag', *topics)
    for names, taken in (({}, '/accel/counts'), ({'imu': '/imu/data'}, '/imu/data')):
        with open_recording(path, Topics.named(names), require=('accel',)) as reader:
            assert reader.topics['accel'] == taken
    for second in ('case', 'temperature/lid'):
        names = {'board': '/imu/temperature', second: 'imu/temperature'}
        message = f'/imu/temperature: one topic for both board and {second.rpartition("/")[2]}: '
        with pytest.raises(RecordingError, match=message):
            open_recording(path, Topics.named(names), require=('accel',))


def test_a_topic_that_thermo_comp_wrote_is_refused_as_input(tmp_path):
    facts = {'corrected_by': 'thermo_comp 0.1'}
    path = driver_bag(tmp_path / 'bag', ('imu/data_raw', 'imu'), metadata=facts)
    message = '/imu/data_raw is no input: thermo_comp wrote it'
    with pytest.raises(RecordingError, match=message):
        open_recording(path, require=('accel',))
    assert message in str(inspect_recording(path).chosen)
    with open_recording(path, Topics.named({'imu': 'imu/data_raw'}), require=('accel',)) as reader:
        assert reader.topics['accel'] == '/imu/data_raw'


@pytest.mark.parametrize('messages', [[b''] * 5, [bytes(8)] * 4 + [b'']])
def test_a_thermometer_with_messages_without_content_is_refused(tmp_path, messages):
    # WHY: the first bytes of an empty message after the last message of a chunk do not exist.
    stamp_ns = np.arange(5) * 10**9
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write_counts('accel/counts', stamp_ns, np.ones((5, 3)))
        bag.write_raw('t', 'std_msgs/msg/Float32', stamp_ns, messages)
    reader = open_recording(tmp_path / 'bag', Topics(board='t'), require=('accel', 'board'))
    with reader, pytest.raises(RecordingError, match='expected plain CDR messages'):
        list(reader.blocks())
