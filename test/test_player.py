# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The player sends every message of a bag over DDS byte for byte, in the order of the bag."""

import hashlib
import subprocess
import sys
import threading

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

from geometry_msgs.msg import Vector3Stamped
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from recording_helpers import imu_columns
from ros_helpers import START_NS, TIMEOUT
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, Temperature

from thermo_comp.errors import RecordingError, ThermoCompError
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter
from thermo_comp.ros import player
from thermo_comp.ros.player import play

CYCLE_NS = 2_500_000
TOPICS = Topics()
UNLIMITED = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
NAMES = ('accel/counts', 'temperature/board', 'temperature/case')


def bag_of(path, n, rng):
    stamps = START_NS + np.arange(n) * CYCLE_NS
    with BagWriter(path) as writer:
        writer.write_counts(TOPICS.counts, stamps, rng.integers(-9, 9, (n, 3)), 'imu_link')
        for topic in (TOPICS.board, TOPICS.case):
            celsius = rng.normal(20, 1, len(stamps[::10]))
            writer.write_temperature(topic, stamps[::10] - 7, celsius, frame_id='ntc')
    return path


def messages_of(path, name=''):
    with AnyReader([path]) as reader:
        return [bytes(data) for link, _, data in reader.messages() if name in link.topic]


class Listener:
    def __init__(self, peer, prefix='', qos=UNLIMITED):
        self.peer = peer
        self.topics = {
            name: peer.listen(kind, prefix + name, qos, raw=True)
            for name, kind in zip(NAMES, (Vector3Stamped, Temperature, Temperature), strict=True)
        }
        self.clock = peer.listen(Clock, '/clock', QoSProfile(depth=100))

    def wait_for(self, n):
        self.peer.wait_for(lambda: sum(map(len, self.topics.values())) >= n, f'{n} messages')


@pytest.mark.parametrize('rate', [0.0, 20.0], ids=['as fast as taken', 'paced'])
def test_every_message_played_over_dds_arrives_byte_for_byte(peer, tmp_path, rng, rate):
    bag = bag_of(tmp_path / 'bag', 4000, rng)
    listener = Listener(peer)
    progress = []
    report = play(bag, rate=rate, progress=progress.append)
    listener.wait_for(4800)
    assert listener.topics == {name: messages_of(bag, name) for name in NAMES}
    temperatures = {'/temperature/board': 400, '/temperature/case': 400}
    assert report.n_messages == {'/accel/counts': 4000, **temperatures}
    assert (report.unheard, report.lossy) == ([], [])
    assert progress[-1] == 1.0
    times = [message.clock.sec * 10**9 + message.clock.nanosec for message in listener.clock]
    assert times == sorted(times)
    assert len(times) > 3
    assert START_NS - 7 <= times[0] <= times[-1] <= START_NS + 4000 * CYCLE_NS


SLOW_LISTENER = """
from thermo_comp.text import keep_standard_output
keep_standard_output()
import hashlib, rclpy
from geometry_msgs.msg import Vector3Stamped
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
rclpy.init()
node = rclpy.create_node('slow')
digest, n = hashlib.sha256(), 0
def hear(data):
    global n
    n += 1
    digest.update(data)
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
node.create_subscription(Vector3Stamped, 'accel/counts', hear, qos, raw=True)
while n < 7000:
    rclpy.spin_once(node)
print(digest.hexdigest())
"""


def test_the_player_waits_for_a_slow_subscriber_which_loses_no_message(tmp_path, rng):
    # The player sends more messages (7000) than the middleware stores, faster than they are read.
    with BagWriter(tmp_path / 'bag.mcap') as writer:
        stamps = START_NS + np.arange(7000) * CYCLE_NS
        writer.write_counts(TOPICS.counts, stamps, rng.integers(-9, 9, (7000, 3)), 'imu_link')
    words = [sys.executable, '-c', SLOW_LISTENER]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as listener:
        try:
            report = play(tmp_path / 'bag.mcap', rate=0.0, wait_s=TIMEOUT)
            printed, _ = listener.communicate(timeout=2 * TIMEOUT)
        finally:
            listener.kill()
    assert report.n_messages == {'/accel/counts': 7000}
    expected = hashlib.sha256(b''.join(messages_of(tmp_path / 'bag.mcap'))).hexdigest()
    assert printed.strip() == expected


def test_play_names_unheard_and_lossy_topics_and_refuses_wrong_arguments(peer, tmp_path, rng):
    bag = bag_of(tmp_path / 'bag', 20, rng)
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    peer.listen(Temperature, 'temperature/case', best_effort)
    report = play(bag, rate=0.0, wait_s=0.5)
    assert report.unheard == ['/accel/counts', '/temperature/board']
    assert (report.lossy, report.n_messages['/accel/counts']) == (['/temperature/case'], 20)
    with pytest.raises(ValueError, match='`rate` must be zero or positive, got -1'):
        play(bag, rate=-1.0)
    with pytest.raises(RecordingError, match='none'):
        play(tmp_path / 'none')


def test_imu_messages_are_played_under_the_names_of_the_bag(peer, tmp_path, rng):
    stamps = START_NS + np.arange(300) * CYCLE_NS
    rest = imu_columns(rng, 300)
    with BagWriter(tmp_path / 'bag') as writer:
        covariance = rest.linear_acceleration_covariance
        force = rng.standard_normal((300, 3))
        writer.write_imu('/drone/imu/raw', stamps, force, covariance, 'imu', imu=rest)
    heard = peer.listen(Imu, 'imu/uncompensated', UNLIMITED, raw=True)
    report = play(tmp_path / 'bag', rate=0.0, topics=Topics(imu='imu/raw', input='imu'))
    peer.wait_for(lambda: len(heard) == 300, '300 samples')
    assert heard == messages_of(tmp_path / 'bag')
    assert list(report.n_messages) == ['/imu/uncompensated']


def test_the_player_ends_if_a_subscriber_takes_no_message(peer, tmp_path, rng, monkeypatch):
    with BagWriter(tmp_path / 'bag') as writer:
        stamps = START_NS + np.arange(8000) * CYCLE_NS
        writer.write_counts(TOPICS.counts, stamps, rng.integers(-9, 9, (8000, 3)))
    hold, held = threading.Event(), threading.Event()

    def block(_):
        held.set()
        hold.wait(TIMEOUT)

    peer.node.create_subscription(Vector3Stamped, 'accel/counts', block, UNLIMITED)
    monkeypatch.setattr(player, 'PATIENCE', 0.5)
    try:
        with pytest.raises(ThermoCompError, match='counts: a subscriber has not acknowledged'):
            play(tmp_path / 'bag', rate=0.0)
        assert held.is_set()
    finally:
        hold.set()
