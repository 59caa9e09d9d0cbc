# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""waitloop.py and the node's Fast DDS profile work with the installed rclpy."""

import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from subprocess import PIPE

import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

from builders import calibration
from geometry_msgs.msg import Vector3Stamped
from live_node import lossless
from node_process import NodeProcess
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from ros_helpers import DEEP, TIMEOUT, Driver, bare_node, stamp_of, standing
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from thermo_comp.ros.process import LOCAL_PROFILE, PROFILE, VARIABLE, use_profile
from thermo_comp.ros.waitloop import RCLError, WaitLoop, overrides
from thermo_comp.unit.calibration_file import save_calibration

RELIABLE = QoSProfile(depth=2000)
BEST_EFFORT = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def node():
    with bare_node('mispelt:=1', 'known:=2') as node:
        yield node


class Running:
    def __init__(self, node, qos=RELIABLE, interval_s=None, rest_s=0.0):
        self.loop = WaitLoop(node, rest_s)
        self.raw = self.loop.subscribe(Vector3Stamped, 'samples', qos)
        self.interval_s = interval_s
        self.messages = []
        self.news = threading.Condition()
        self.thread = threading.Thread(target=self.loop.run, args=(self.take,), daemon=True)

    def take(self):
        messages = self.raw.drain()[0]
        with self.news:
            self.messages += messages
            if self.interval_s is not None:
                self.raw.interval_ns = int(self.interval_s * 1e9)
            self.news.notify_all()

    def wait_for(self, condition):
        with self.news:
            assert self.news.wait_for(condition, TIMEOUT)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.loop.stop()
        self.thread.join(TIMEOUT)
        assert not self.thread.is_alive()


def test_names_of_set_parameters_are_returned_and_qos_can_be_overridden(node):
    node.declare_parameter('known', 1)
    assert overrides(node) == {'mispelt': 1, 'known': 2}
    loop = WaitLoop(node)
    node.declare_parameter('qos_overrides./others.subscription.depth', 3)
    qos = QoSProfile(depth=7)
    loop.subscribe(Vector3Stamped, 'samples', qos)
    loop.subscribe(Vector3Stamped, 'others', qos)
    # rclpy writes overrides into the given QoS profile, so each subscription needs a copy.
    assert qos.depth == 7
    assert node.get_parameter('qos_overrides./samples.subscription.depth').value == 7
    reliability = node.get_parameter('qos_overrides./samples.subscription.reliability')
    assert ReliabilityPolicy[reliability.value.upper()] is ReliabilityPolicy.RELIABLE


def test_messages_lost_by_a_full_queue_are_counted(node, peer):
    loop = WaitLoop(node)
    raw = loop.subscribe(Vector3Stamped, 'samples', QoSProfile(depth=10))
    publisher = peer.publisher(Vector3Stamped, 'samples')
    publisher.publish(Vector3Stamped())
    taken = []
    peer.poll(lambda: taken.extend(raw.drain()[0]) or taken, 'the first message')
    for k in range(50):
        message = Vector3Stamped()
        message.vector.x = float(k)
        publisher.publish(message)

    def is_last_taken():
        taken.extend(raw.drain()[0])
        return deserialize_message(taken[-1], Vector3Stamped).vector.x == 49.0

    peer.poll(is_last_taken, 'the last message')
    assert raw.n_lost == 51 - len(taken)


def test_a_periodic_function_is_called_with_and_without_samples(node, peer):
    called = []
    running = Running(node)

    def call():
        with running.news:
            called.append(len(running.messages))
            running.news.notify_all()
        if len(called) == 2:
            raise RCLError('nobody listens')

    running.loop.call_every(0.01, call)
    with running:
        running.wait_for(lambda: len(called) >= 4)
        publisher = peer.publisher(Vector3Stamped, 'samples')
        n_before = len(called)
        for n_sent in range(1, 51):
            publisher.publish(Vector3Stamped())
            running.wait_for(lambda n=n_sent: len(running.messages) == n)
        running.wait_for(lambda: len(called) > n_before and called[-1] == 50)
        # A second periodic function replaces the first, and is called after its interval.
        again = []
        start = time.monotonic()

        def note():
            with running.news:
                again.append(time.monotonic() - start)
                running.news.notify_all()

        running.loop.call_every(0.03, note)
        n_called = len(called)
        running.wait_for(lambda: len(again) >= 3)
    assert again[0] >= 0.03
    assert again[2] >= 0.09
    assert len(called) <= n_called + 1


def test_a_subscription_can_be_removed_while_the_loop_runs(node, peer):
    running = Running(node)
    other = running.loop.subscribe(Vector3Stamped, 'others', DEEP)

    def drop(_, answer):
        running.loop.unsubscribe(other)
        return answer

    node.create_service(Trigger, 'drop', drop)
    with running:
        publisher = peer.publisher(Vector3Stamped, 'samples')
        publisher.publish(Vector3Stamped())
        peer.call(Trigger, 'drop', Trigger.Request())
        publisher.publish(Vector3Stamped())
        running.wait_for(lambda: len(running.messages) == 2)
    assert all(subscription.topic != 'others' for subscription in node.subscriptions)


def test_the_loop_stops_when_the_context_is_shut_down(node):
    with Running(node) as running:
        node.context.shutdown()
        running.thread.join(TIMEOUT)
        assert not running.thread.is_alive()


@pytest.mark.parametrize(
    ('qos', 'interval_s', 'is_resting'),
    [
        pytest.param(BEST_EFFORT, None, True, id='as measured'),
        pytest.param(BEST_EFFORT, 749.0, True, id='four messages in three pauses'),
        pytest.param(BEST_EFFORT, 751.0, False, id='hardly more than one message in a pause'),
        pytest.param(BEST_EFFORT, 0.0, False, id='a middleware without arrival times'),
        pytest.param(RELIABLE, None, False, id='reliable'),
    ],
)
def test_the_loop_pauses_only_for_frequent_best_effort_messages(
    node, peer, monkeypatch, qos, interval_s, is_resting
):
    rest_s, rests = 1000.0, []
    monkeypatch.setattr('thermo_comp.ros.waitloop.time.sleep', rests.append)
    with Running(node, qos, interval_s, rest_s) as running:
        publisher = peer.publisher(Vector3Stamped, 'samples')
        peer.poll(running.raw.subscription.get_publisher_count, 'the publisher')
        for n_sent in range(1, 6):
            publisher.publish(Vector3Stamped())
            running.wait_for(lambda n=n_sent: len(running.messages) == n)
    assert bool(rests) == is_resting
    assert all(0.0 < rest <= rest_s for rest in rests)


CYCLE_NS = 10_000_000
N_SAMPLES = 300
#: If the node has not found its peers after this number of samples, the test fails.
N_TRIED = 5000
OTHER = """\
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <data_reader profile_name="other"/>
</profiles></dds>
"""

#: This program has a reliable and a best-effort subscription, and prints the stamps of both.
RECEIVER = """
from thermo_comp.text import keep_standard_output
keep_standard_output()
import json, select, sys, time
import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

rclpy.init()
node = rclpy.create_node('receiver')
heard = {}


def stamp(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


for reliability in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT):
    stamps = heard[reliability] = []
    qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=reliability)
    hear = lambda message, stamps=stamps: stamps.append(stamp(message))
    node.create_subscription(Imu, 'imu/data_raw', hear, qos)
reliable = heard[ReliabilityPolicy.RELIABLE]
while not all(heard.values()):
    rclpy.spin_once(node)
print('ready', flush=True)
while not select.select([sys.stdin], [], [], 0)[0]:
    rclpy.spin_once(node, timeout_sec=0.01)
last, end = int(sys.stdin.readline()), time.monotonic() + 30.0
while reliable[-1] != last and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps(list(heard.values())), flush=True)
"""


def event_wakes(pid):
    """Return how often the middleware's thread for timed events has been woken so far."""
    tasks = Path(f'/proc/{pid}/task').iterdir()
    (thread,) = (task for task in tasks if (task / 'comm').read_text().startswith('dds.ev'))
    lines = (thread / 'status').read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('voluntary'))


def send(driver, first, last, pause_s):
    pause = threading.Event()
    for k in range(first, last):
        if k % 100 == 0:
            driver.temperatures(k * CYCLE_NS, 20.0, 20.0)
        driver.counts(k * CYCLE_NS, *standing(k))
        pause.wait(pause_s)


@pytest.fixture
def node_arguments(tmp_path):
    unit = tmp_path / 'unit.yaml'
    save_calibration(calibration(), unit)
    return [*lossless(), '-p', f'calibration_file:={unit}']


def wakes_per_sample(peer, drivers, node_arguments):
    """Run the node with a reliable subscriber; return wake-ups of its event thread per sample."""
    with NodeProcess(*node_arguments) as node:
        heard = peer.listen(Imu, 'imu/data_raw')
        # All nodes get the same driver, because a node ignores a topic with two publishers.
        drivers[:] = drivers or [Driver(peer)]
        first = 0
        while not heard:
            assert first < N_TRIED, node.said
            send(drivers[0], first, first + 100, 0.001)
            first += 100
        before, last = event_wakes(node.process.pid), first + N_SAMPLES
        send(drivers[0], first, last, 0.001)
        newest_ns = (last - 1) * CYCLE_NS
        peer.wait_for(lambda: stamp_of(heard[-1]) == newest_ns, 'the last sample')
        return (event_wakes(node.process.pid) - before) / N_SAMPLES


def test_samples_do_not_wake_the_event_thread(peer, node_arguments, tmp_path, monkeypatch):
    # With another Fast DDS profile each sample, or group of them, wakes the node's event thread.
    other = tmp_path / 'other.xml'
    other.write_text(OTHER)
    monkeypatch.setenv(VARIABLE, str(other))
    drivers = []
    by_default = wakes_per_sample(peer, drivers, node_arguments)
    # With the node's profile 700 samples per second cause 50 wake-ups per second.
    monkeypatch.delenv(VARIABLE)
    assert wakes_per_sample(peer, drivers, node_arguments) < 0.5 * by_default


def test_samples_lost_by_dds_are_repeated(peer, node_arguments, monkeypatch):
    # The receiver stops during twice as many samples as its shared memory holds (512).
    monkeypatch.delenv(VARIABLE, raising=False)
    command = [sys.executable, '-c', RECEIVER]
    with (
        NodeProcess(*node_arguments) as node,
        subprocess.Popen(command, stdin=PIPE, stdout=PIPE, text=True) as receiver,
    ):
        driver = Driver(peer)
        first = 0
        while not select.select([receiver.stdout], [], [], 0.0)[0]:
            assert first < N_TRIED, node.said
            send(driver, first, first + 1, 0.01)
            first += 1
        receiver.send_signal(signal.SIGSTOP)
        last = first + 1000
        send(driver, first, last, 0.001)
        receiver.send_signal(signal.SIGCONT)
        print((last - 1) * CYCLE_NS, file=receiver.stdin, flush=True)
        assert receiver.stdout.readline() == 'ready\n'
        reliable, best_effort = json.loads(receiver.stdout.readline())
    assert reliable[-1000:] == [k * CYCLE_NS for k in range(first, last)]
    assert len(set(best_effort) & set(reliable[-1000:])) < 1000


def test_a_dds_profile_set_by_the_user_replaces_that_of_the_node(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, 'mine.xml')
    use_profile()
    assert os.environ[VARIABLE] == 'mine.xml'
    monkeypatch.delenv(VARIABLE)
    (tmp_path / LOCAL_PROFILE).write_text(OTHER)
    use_profile()
    assert VARIABLE not in os.environ
    (tmp_path / LOCAL_PROFILE).unlink()
    use_profile()
    assert os.environ[VARIABLE] == str(PROFILE)
