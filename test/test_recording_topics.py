# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The topic of each input, and the message if there is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_helpers import START_NS

from thermo_comp.errors import RecordingError
from thermo_comp.fitting.sources import recording_source
from thermo_comp.recording.reader import inspect_recording, open_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter


def driver_bag(
    path: Path, *topics: tuple[str, str], metadata: dict[str, str] | None = None
) -> Path:
    """Write five messages on each topic: an Imu, or if stated a Vector3Stamped or a flag."""
    stamp_ns = START_NS + np.arange(5) * 10**7
    with BagWriter(path, metadata=metadata or {}) as bag:
        for topic, kind in topics:
            if kind == 'imu':
                bag.write_imu(topic, stamp_ns, np.ones((5, 3)), np.zeros(9))
            elif kind == 'celsius':
                bag.write_temperature(topic, stamp_ns, np.full(5, 20.0))
            elif kind == 'flag':
                bag.write_bool(topic, stamp_ns, np.ones(5, bool))
            else:
                bag.write_counts(topic, stamp_ns, np.ones((5, 3)))
    return path


@pytest.mark.parametrize(
    ('topics', 'taken'),
    [
        # REP 145: the driver's topic; the magnetometer's vector is not a force.
        ([('imu/data_raw', 'imu'), ('imu/mag', 'vector')], '/imu/data_raw'),
        # Xsens: free acceleration and rate are vectors.
        ([('imu/data', 'imu'), ('filter/free_acceleration', 'vector')], '/imu/data'),
        ([('imu/data', 'imu'), ('imu/angular_velocity', 'vector')], '/imu/data'),
        # With a filter, its input is chosen.
        ([('imu/data', 'imu'), ('imu/data_raw', 'imu')], '/imu/data_raw'),
        ([('a/imu/data_raw', 'imu'), ('a/accel/counts', 'vector')], '/a/accel/counts'),
        ([('adc/words', 'vector'), ('imu/mag', 'vector')], '/adc/words'),
        # Two equivalent topics, and vectors that are not forces.
        ([('left/imu', 'imu'), ('right/imu', 'imu'), ('adc/words', 'vector')], None),
        ([('imu/mag', 'vector')], None),
        # The node's output, recognised by the regime topics beside it.
        ([('imu/data_raw', 'imu'), ('regime/dynamic', 'flag')], None),
        ([('a/imu/data_raw', 'imu'), ('regime/dynamic', 'flag')], '/a/imu/data_raw'),
        ([('imu/data_raw', 'imu'), ('regime/dynamic', 'flag'), ('d/imu', 'imu')], '/d/imu'),
    ],
)
def test_an_imu_topic_beats_a_guess_by_type(
    tmp_path: Path, topics: list[tuple[str, str]], taken: str | None
) -> None:
    path = driver_bag(tmp_path / 'bag', *topics)
    with open_recording(path, require=()) as reader:
        assert reader.topics.get('accel') == taken
    if taken is None:
        with pytest.raises(RecordingError, match='no such topic; the bag has /'):
            open_recording(path, require=('accel',))


def test_the_input_that_the_user_names_is_compensated(tmp_path: Path) -> None:
    path = driver_bag(tmp_path / 'bag', ('accel/counts', 'vector'), ('imu/data', 'imu'))
    for names, taken in (({}, '/accel/counts'), ({'imu': '/imu/data'}, '/imu/data')):
        with open_recording(path, Topics.named(names), require=('accel',)) as reader:
            assert reader.topics['accel'] == taken


def test_what_is_corrected_already_is_explained(tmp_path: Path) -> None:
    path = driver_bag(
        tmp_path / 'bag', ('imu/data_raw', 'imu'), metadata={'corrected_by': 'thermo_comp 0.1'}
    )
    told = '/imu/data_raw is corrected already: thermo_comp wrote it'
    with pytest.raises(RecordingError, match=told):
        open_recording(path, require=('accel',))
    assert told in str(inspect_recording(path).chosen)
    # The user's choice.
    with open_recording(path, Topics.named({'imu': 'imu/data_raw'}), require=('accel',)) as reader:
        assert reader.topics['accel'] == '/imu/data_raw'


def test_one_topic_for_two_inputs_is_refused_by_its_name(tmp_path: Path) -> None:
    path = driver_bag(tmp_path / 'bag', ('accel/counts', 'vector'), ('imu/temperature', 'celsius'))
    for second in ('case', 'temperature/lid'):
        names = {'board': '/imu/temperature', second: 'imu/temperature'}
        told = f'/imu/temperature: one topic for both board and {second.rpartition("/")[2]}: '
        with pytest.raises(RecordingError, match=told):
            open_recording(path, Topics.named(names), require=('accel',))


def test_a_fit_that_fails_names_the_topic_that_was_taken(tmp_path: Path) -> None:
    source, _ = recording_source(driver_bag(tmp_path / 'bag', ('imu/data', 'imu')))
    assert source.name == 'bag (/imu/data)'
    source, _ = recording_source(driver_bag(tmp_path / 'usual', ('accel/counts', 'vector')))
    assert source.name == 'usual'
