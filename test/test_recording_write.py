# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Other tools can read written bags; only complete bags have their final name."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
import recording_helpers as rec
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader as Reader2

from thermo_comp.errors import OutputError, RecordingError
from thermo_comp.recording.reader import open_recording, read_recording
from thermo_comp.recording.writer import BagWriter
from thermo_comp.topics import BOOL, FLAGS, STAMPED

STEP_NS = 2_500_000


@settings(max_examples=25, deadline=None)
@given(
    counts=st.lists(st.integers(0, 60), min_size=1, max_size=4),
    frame_id=st.text(max_size=20).filter(lambda text: '\0' not in text),
    compression=st.sampled_from(['none', 'lz4', 'zstd']),
    chunk_bytes=st.sampled_from([1, 300, 2000, 1 << 20]),
    is_file=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_rosbags_and_mcap_read_the_written_messages(
    counts, frame_id, compression, chunk_bytes, is_file, seed
):
    rng = np.random.default_rng(seed)
    wanted = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'bag.mcap' if is_file else 'bag')
        with BagWriter(path, compression=compression, chunk_bytes=chunk_bytes) as bag:
            for n in counts:
                log_ns = rec.START_NS + rng.integers(0, 50, n) * STEP_NS
                stamp_ns = rng.integers(0, 2**31 * 10**9, n)
                imu, linear = rec.imu_columns(rng, n), rng.normal(size=(n, 3))
                raw = [rng.bytes(int(size)) for size in rng.integers(1, 40, n)]
                covariance = imu.linear_acceleration_covariance
                bag.write_counts(rec.ACCEL, stamp_ns, linear, frame_id, log_ns)
                bag.write_temperature(rec.BOARD, stamp_ns, linear[:, 0], log_ns)
                bag.write_imu(rec.IMU_IN, stamp_ns, linear, covariance, frame_id, imu, log_ns)
                flags = [b'\0\1\0\0' + bytes([x > 0]) for x in linear[:, 0].tolist()]
                bag.write_raw('regime/dynamic', BOOL, log_ns, flags)
                bag.write_raw('diagnostics', 'std_msgs/msg/String', log_ns, raw)
                bag.flush()
                readings = np.column_stack((linear[:, 0], np.zeros(n)))
                columns = np.hstack((*imu[:4], linear, covariance))
                times = list(zip(log_ns.tolist(), stamp_ns.tolist(), strict=True))
                group = [
                    (log, topic, rec.serialize(rec.Message(topic, log, stamp, frame, tuple(row))))
                    for topic, frame, rows in (
                        *((rec.ACCEL, frame_id, linear), (rec.BOARD, '', readings)),
                        (rec.IMU_IN, frame_id, columns),
                    )
                    for (log, stamp), row in zip(times, rows.tolist(), strict=True)
                ]
                for topic, content in (('/regime/dynamic', flags), ('/diagnostics', raw)):
                    group += [(int(log), topic, c) for log, c in zip(log_ns, content, strict=True)]
                # A flush sorts messages by log time; equal log times keep the order of the calls.
                wanted += sorted(group, key=lambda message: message[0])
        times = sorted(log for log, *_ in wanted)
        with (path if is_file else path / 'bag_0.mcap').open('rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            assert summary.statistics.message_count == len(wanted) == sum(counts) * 5
            assert [message.log_time for _, _, message in reader.iter_messages()] == times
            stream.seek(0)
            written = [
                (record.log_time, summary.channels[record.channel_id].topic, record.data)
                for record in StreamReader(stream, validate_crcs=True).records
                if type(record).__name__ == 'Message'
            ]
        assert written == wanted
        with Reader2(path) as rosbag:
            assert rosbag.message_count == len(wanted)
            topics = {connection.topic for connection in rosbag.connections}
            assert topics == {rec.ACCEL, rec.BOARD, rec.IMU_IN, '/regime/dynamic', '/diagnostics'}
            listed = [(log, link.topic, bytes(data)) for link, log, data in rosbag.messages()]
        # rosbags' version determines the order of messages with equal log times in two chunks.
        assert [log for log, *_ in listed] == times
        assert sorted(listed) == sorted(wanted)


def small(path, value=1.0, **options):
    with BagWriter(path, **options) as bag:
        stamps = rec.START_NS + STEP_NS * np.arange(5)
        bag.write_counts('accel/counts', stamps, np.full((5, 3), value))


@pytest.mark.parametrize('name', ['bag', 'bag.mcap'])
def test_a_written_bag_has_its_metadata_and_regime_topics_with_the_qos_of_the_node(tmp_path, name):
    pairs = {'serial': 'Ünit 7', 'git': 'a: b\n- c'}
    small(tmp_path / name, metadata=pairs)
    assert read_recording(tmp_path / name, require=()).info.metadata == pairs
    if name == 'bag.mcap':  # a truncated MCAP file keeps its metadata
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) // 2])
        assert read_recording(tmp_path / name, require=()).info.metadata == pairs
    # WHY: `regime/stamped` was volatile in a bag, so a subscriber that joined later got no regime.
    folder = tmp_path / 'qos'
    with BagWriter(folder / name) as bag:
        bag.write_raw('imu0/regime/dynamic', BOOL, [1], [b''])
        for topic in ('imu0/regime/stamped', '/diagnostics'):
            bag.write_raw(topic, STAMPED.type, [1], [FLAGS[STAMPED](1, True, 'T-1')])
    with (folder / ('bag/bag_0.mcap' if name == 'bag' else name)).open('rb') as file:
        channels = make_reader(file).get_summary().channels.values()
    regimes = {'/imu0/regime/dynamic', '/imu0/regime/stamped'}
    assert {channel.topic for channel in channels} == {*regimes, '/diagnostics'}
    for channel in channels:
        (profile,) = yaml.safe_load(channel.metadata['offered_qos_profiles'])
        is_latched = channel.topic in regimes
        assert profile['durability'] == ('transient_local' if is_latched else 'volatile')


def test_a_written_directory_equals_that_of_rosbag2_and_a_file_contains_its_name(tmp_path):
    small(tmp_path / 'bag', metadata={'serial': '7'})
    assert {p.name for p in (tmp_path / 'bag').iterdir()} == {'metadata.yaml', 'bag_0.mcap'}
    content = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    content = content['rosbag2_bagfile_information']
    assert (content['version'], content['storage_identifier']) == (9, 'mcap')
    assert (content['relative_file_paths'], content['message_count']) == (['bag_0.mcap'], 5)
    assert content['starting_time'] == {'nanoseconds_since_epoch': rec.START_NS}
    assert content['duration'] == {'nanoseconds': 4 * STEP_NS}
    assert content['custom_data'] == {'serial': '7'}
    (topic,) = content['topics_with_message_count']
    kind = 'geometry_msgs/msg/Vector3Stamped'
    assert topic['topic_metadata']['type'] == kind
    assert topic['topic_metadata']['type_description_hash'] == rec.typestore().hash_rihs01(kind)
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        (channel,) = summary.channels.values()
        (schema,) = summary.schemas.values()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert (schema.name, schema.encoding) == (kind, 'ros2msg')
    assert schema.data.decode() == rec.typestore().generate_msgdef(kind, ros_version=2)[0]
    qos = yaml.safe_load(channel.metadata['offered_qos_profiles'])
    assert qos == topic['topic_metadata']['offered_qos_profiles']
    assert qos[0]['reliability'] == 'reliable'
    assert yaml.safe_load(metadata['rosbag2']['serialized_metadata']) == content
    # The metadata of a bag must not contain its temporary name.
    small(tmp_path / 'bag.mcap')
    with (tmp_path / 'bag.mcap').open('rb') as stream:
        (metadata,) = make_reader(stream).iter_metadata()
    content = yaml.safe_load(metadata.metadata['serialized_metadata'])
    assert content['relative_file_paths'] == [content['files'][0]['path']] == ['bag.mcap']


@pytest.mark.parametrize('name', ['bag', 'bag.mcap'])
def test_an_existing_output_stays_until_the_new_output_is_complete(tmp_path, name):
    path = tmp_path / name
    small(path, 1.0)
    with pytest.raises(OutputError, match='exists already'):
        small(path, 2.0)

    def value():
        return float(read_recording(path, require=()).columns.accel[0, 0])

    def fail():
        with BagWriter(path, overwrite=True) as bag:
            bag.write_counts('accel/counts', [1], [[2.0, 2.0, 2.0]])
            bag.flush()
            assert value() == 1.0
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert value() == 1.0
    assert [p.name for p in tmp_path.iterdir()] == [name]  # no temporary file remains
    small(path, 3.0, overwrite=True)
    assert (value(), [p.name for p in tmp_path.iterdir()]) == (3.0, [name])


def test_an_output_may_be_a_link_but_never_replaces_a_file_or_folder_that_is_no_bag(tmp_path):
    (tmp_path / 'home').mkdir()
    (tmp_path / 'home' / 'thesis.tex').write_text('ten years of work')
    (tmp_path / 'file').write_text('')
    small(tmp_path / 'fit' / '01.mcap', 1.0)
    (tmp_path / 'folder.mcap').mkdir()
    for name, reason in (
        *(('home', r'it holds thesis\.tex'), ('file', 'it is a file')),
        *(('fit', r'it is no bag: it has no metadata\.yaml'), ('folder.mcap', 'it is a folder')),
    ):
        with pytest.raises(OutputError, match=f'is not replaced: {reason}'):
            BagWriter(tmp_path / name, overwrite=True)
    for name in ('bag', 'bag.mcap'):
        small(tmp_path / 'disk' / name, 1.0)
        (tmp_path / name).symlink_to(tmp_path / 'disk' / name)
        small(tmp_path / name, 2.0, overwrite=True)
        assert (tmp_path / name).is_symlink()
        columns = read_recording(tmp_path / 'disk' / name, require=()).columns
        assert float(columns.accel[0, 0]) == 2.0


def test_arguments_of_wrong_shape_or_type_and_messages_without_a_definition_are_refused(tmp_path):
    xyz = [[1, 2, 3]]
    with BagWriter(tmp_path / 'bag') as bag:
        for write, given, reason in (
            (bag.write_counts, ([1, 2], [[1, 2], [3, 4]]), r'`xyz` .* \(2, 3\), got \(2, 2\)'),
            (bag.write_counts, ([1.5], xyz), '`stamp_ns` must be one row of integers, got float'),
            (bag.write_counts, ([-1], xyz), '`stamp_ns` must not be negative, got -1 ns'),
            (bag.write_counts, ([2**31 * 10**9], xyz), r'`stamp_ns` .* 2\*\*31 s, got 2147483648'),
            (bag.write_counts, ([1], xyz, '', [1, 2]), '`log_ns` must have 1 values, got 2'),
            (bag.write_temperature, ([1], [1.0, 2.0]), r'`celsius` .* \(1, 1\), got \(2, 1\)'),
            (bag.write_imu, ([1], [[1.0, 2.0]], np.zeros(9)), '`linear_acceleration` must have'),
            (bag.write_imu, ([1], xyz, np.zeros((1, 3))), 'acceleration_covariance` must have'),
            (bag.write_raw, ('std_msgs/msg/Bool', [1, 2], [b'']), '`log_ns` .* 1 values, got 2'),
        ):
            with pytest.raises(ValueError, match=reason):
                write('a', *given)
    with pytest.raises(RecordingError, match='the bag is closed'):
        bag.write_raw('a', BOOL, [1], [b''])
    with BagWriter(tmp_path / 'bag.mcap') as bag:
        with pytest.raises(RecordingError, match='/x: the definition of message type a/msg/B is'):
            bag.write_raw('x', 'a/msg/B', [1], [b'\0\1\0\0\7'])
        bag.write_raw('x', 'a/msg/B', [1], [b'\0\1\0\0\7'], ('ros2msg', 'uint8 data\n'))
        with pytest.raises(RecordingError, match='/x: already written with another type than std'):
            bag.write_raw('x', BOOL, [1], [b''])
    with AnyReader([tmp_path / 'bag.mcap']) as reader:
        ((connection, _, data),) = reader.messages()
        assert reader.deserialize(data, connection.msgtype).data == 7
    with open_recording(tmp_path / 'bag.mcap', require=()) as ours:
        assert ours.definitions['a/msg/B'] == ('ros2msg', 'uint8 data\n')
