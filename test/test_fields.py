# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A number in a message of any type is read with the value that rosbags reads."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_helpers import START_NS
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from thermo_comp.errors import RecordingError
from thermo_comp.recording.fields import Field, definitions_of
from thermo_comp.recording.overview import survey_recording, unused_thermometers
from thermo_comp.recording.reader import open_recording, read_recording
from thermo_comp.recording.serialized import Messages
from thermo_comp.recording.topics import Topics

# A SensorAccel message of PX4 has no header, and contains sample and temperature.
PX4 = {
    'px4_msgs/msg/SensorAccel': (
        'uint64 timestamp\nuint64 timestamp_sample\nuint32 device_id\nfloat32 x\nfloat32 y\n'
        'float32 z\nfloat32 temperature\nuint32 error_count\nuint8[3] clip_counter\n'
    ),
    'lab_msgs/msg/Deep': (
        'std_msgs/Header header\nstring[] names\nlab_msgs/Part[] parts\nint16[3] raw\n'
        'float32[] cells\nbool is_on\nlab_msgs/Part last\n'
    ),
    'lab_msgs/msg/Part': 'string name\nuint8 kind\nfloat64 celsius\n',
}


@pytest.fixture(scope='module')
def store():
    types = get_typestore(Stores.ROS2_JAZZY)
    for kind, text in PX4.items():
        types.register(get_types_from_msg(text, kind))
    return types


def serialized(store, kind, values, is_little=True):
    data = [bytes(store.serialize_cdr(value, kind, little_endian=is_little)) for value in values]
    return Messages.of(data, np.zeros(len(data)), np.arange(len(data)))


def header(store, stamp_ns, frame):
    stamp = store.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    return store.types['std_msgs/msg/Header'](stamp, frame)


words = st.text(st.characters(codec='ascii', exclude_characters='\0'), max_size=9)
floats = st.floats(width=32, allow_nan=False)
parts = st.tuples(words, st.integers(0, 255), floats)


@given(
    rows=st.lists(
        st.tuples(words, st.lists(words, max_size=3), st.lists(parts, max_size=3), parts),
        min_size=1, max_size=6,
    ),
    cells=st.lists(floats, min_size=2, max_size=4),
    is_little=st.booleans(),
)  # fmt: skip
def test_any_number_of_any_message_layout_is_read(store, rows, cells, is_little):
    kind, part = 'lab_msgs/msg/Deep', store.types['lab_msgs/msg/Part']
    messages = [
        store.types[kind](
            header(store, START_NS + row, frame), names, [part(*values) for values in own],
            np.array([7, -8, row], np.int16), np.array(cells, np.float32), True, part(*last),
        )
        for row, (frame, names, own, last) in enumerate(rows)
    ]  # fmt: skip
    many = serialized(store, kind, messages, is_little)

    def read(path):
        stamp_ns, values = Field(kind, path, store.fielddefs).read(many)
        return stamp_ns.tolist(), values.tolist()

    stamps = [START_NS + row for row in range(len(rows))]
    assert read('last.celsius') == (stamps, [row[3][2] for row in rows])
    assert read('last.kind')[1] == [row[3][1] for row in rows]
    assert read('raw[2]')[1] == [float(row) for row in range(len(rows))]
    assert read('cells[1]')[1] == [float(np.float32(cells[1]))] * len(rows)
    if all(row[2] for row in rows):
        assert read('parts[0].celsius')[1] == [row[2][0][2] for row in rows]
    else:
        with pytest.raises(RecordingError, match=r'\[0\] of an array of 0'):
            read('parts[0].celsius')


@pytest.mark.parametrize(
    ('path', 'text'),
    [
        ('temp', r'has the fields header, names, parts.*, no `temp`'),
        ('last.celsius.x', 'a number has the fields none, no `x`'),
        ('names', 'is not a number'), ('header', 'is not a number'),
        ('last[0]', 'of a field that is not an array'), ('raw[', 'no `raw\\['),
    ],
)  # fmt: skip
def test_a_path_that_leads_to_no_number_is_refused(store, path, text):
    with pytest.raises(RecordingError, match=text):
        Field('lab_msgs/msg/Deep', path, store.fielddefs)


def test_a_message_that_ends_inside_a_field_is_refused_as_damaged(store):
    kind = 'px4_msgs/msg/SensorAccel'
    field = Field(kind, 'temperature', store.fielddefs)
    message = store.types[kind](1, 2, 3, 0, 0, 0, 25, 0, np.zeros(3, 'u1'))
    whole = serialized(store, kind, [message])
    torn = Messages.of([next(iter(whole))[:30]], [0], [0])
    assert field.read(whole)[1].tolist() == [25.0]
    with pytest.raises(RecordingError, match='ends inside a field'):
        field.read(torn)


def test_message_definitions_are_those_of_the_bag_or_of_ros():
    known = {'a/msg/B': ('ros2msg', 'float32 t\n'), 'a/msg/C': ('ros2msg', '?')}
    assert Field('a/msg/B', 't', definitions_of('a/msg/B', known)).header == ''
    jazzy = definitions_of('sensor_msgs/msg/BatteryState', {})
    assert Field('sensor_msgs/msg/BatteryState', 'temperature', jazzy).header
    idl = 'module a { module msg { struct D { float t; }; }; };'
    for text in (idl, f'{"=" * 80}\nIDL: a/msg/D\n{idl}'):
        assert Field('a/msg/D', 't', definitions_of('a/msg/D', {'a/msg/D': ('ros2idl', text)}))
    with pytest.raises(RecordingError, match='definition of a/msg/C cannot be read'):
        definitions_of('a/msg/C', known)
    with pytest.raises(RecordingError, match='does not define its type a/msg/D'):
        definitions_of('a/msg/D', known)


def driver_bag(path, store, storage=StoragePlugin.MCAP):
    """Write 50 Imu messages and some PX4 and Float64 messages; return the PX4 readings."""
    celsius = []
    with Writer(path, version=9, storage_plugin=storage) as bag:
        kinds = {'/imu/data': 'sensor_msgs/msg/Imu', '/case': 'std_msgs/msg/Float64',
                 '/fmu/out/sensor_accel': 'px4_msgs/msg/SensorAccel'}  # fmt: skip
        links = {name: bag.add_connection(name, kinds[name], typestore=store) for name in kinds}

        def write(topic, log_ns, message):
            bag.write(links[topic], log_ns, store.serialize_cdr(message, kinds[topic]))

        vector, zeros = store.types['geometry_msgs/msg/Vector3'], np.zeros(9)
        level = store.types['geometry_msgs/msg/Quaternion'](0, 0, 0, 1)
        for row in range(50):
            stamp_ns = START_NS + row * 10**7
            log_ns = stamp_ns + 10**12
            if row % 5 == 0:
                accel = store.types['px4_msgs/msg/SensorAccel']
                message = accel(row, row, 1, 0, 0, 9.8, 20.0 + row, 0, np.zeros(3, np.uint8))
                write('/fmu/out/sensor_accel', log_ns - 1, message)
                write('/case', log_ns + 1, store.types['std_msgs/msg/Float64'](19.0 + row))
                celsius.append(20.0 + row)
            head = header(store, stamp_ns, 'imu')
            force, still = vector(0.1, 0.2, 9.8 + 0.001 * row), vector(0, 0, 0)
            imu = store.types['sensor_msgs/msg/Imu']
            write('/imu/data', log_ns, imu(head, level, zeros, still, zeros, force, zeros))
    return celsius


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_with_a_message_type_of_the_driver_is_read(tmp_path, store, storage):
    celsius = driver_bag(tmp_path / 'bag', store, storage)
    names = {'board': '/fmu/out/sensor_accel:temperature', 'case': '/case'}
    recording = read_recording(tmp_path / 'bag', Topics.named(names))
    assert 'readings of board, case have no stamp' in str(recording.info.chosen)
    board, case = (recording.columns.temperatures[name] for name in ('board', 'case'))
    # A reading without a stamp gets the stamp of the last sample; before any sample it is omitted.
    assert board.celsius.tolist() == celsius[1:]
    assert board.stamp_ns.tolist() == [START_NS + (row - 1) * 10**7 for row in range(5, 50, 5)]
    assert case.celsius.tolist() == [celsiu - 1.0 for celsiu in celsius]
    assert case.stamp_ns.tolist() == [START_NS + row * 10**7 for row in range(0, 50, 5)]


def test_two_fields_of_a_message_are_two_inputs_and_info_names_further_fields(tmp_path, store):
    driver_bag(tmp_path / 'bag', store)
    topic = '/fmu/out/sensor_accel'
    names = {'board': f'{topic}:temperature', 'case': f'{topic}:z'}
    columns = read_recording(tmp_path / 'bag', Topics.named(names)).columns
    assert columns.temperatures['case'].celsius == pytest.approx(9.8, rel=1e-6)
    names['case'] = names['board']
    with pytest.raises(RecordingError, match='one topic for both board and case'):
        open_recording(tmp_path / 'bag', Topics.named(names))
    with pytest.raises(RecordingError, match='else name a field, TOPIC:FIELD'):
        open_recording(tmp_path / 'bag', Topics.named({'board': topic}), require=('board',))
    with pytest.raises(RecordingError, match=r'sensor_accel:temp: px4_msgs.*no `temp`'):
        open_recording(tmp_path / 'bag', Topics.named({'board': f'{topic}:temp'}), require=())
    with pytest.raises(ValueError, match='`imu` takes whole messages'):
        Topics.named({'imu': '/imu/data:linear_acceleration'})
    findings = survey_recording(tmp_path / 'bag', Topics.named({'board': '/case'})).findings
    message = next(text for text in findings if 'no case' in text)
    assert message.endswith('with --topic case=TOPIC: /fmu/out/sensor_accel:temperature')
    both = Topics.named({'board': '/case', 'case': '/fmu/out/sensor_accel:temperature'})
    with open_recording(tmp_path / 'bag', both) as reader:
        assert unused_thermometers(reader) == []
