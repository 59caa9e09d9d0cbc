# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The loop of waitloop.py uses undocumented parts of rclpy; the installed rclpy has them."""

import threading
import time

import pytest

pytest.importorskip('rclpy', reason='rclpy is absent: install the extra `ros`')

from geometry_msgs.msg import Vector3Stamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from ros_helpers import DEEP, TIMEOUT, bare_node
from std_srvs.srv import Trigger

from thermo_comp.ros.waitloop import RCLError, WaitLoop, overrides

RELIABLE = QoSProfile(depth=2000)
BEST_EFFORT = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def node():
    with bare_node('mispelt:=1', 'known:=2') as node:
        yield node


class Running:
    def __init__(self, node):
        self.loop = WaitLoop(node)
        self.raw = self.loop.subscribe(Vector3Stamped, 'samples', QoSProfile(depth=2000))
        self.messages = []
        self.received_ns = []
        self.news = threading.Condition()
        self.thread = threading.Thread(target=self.loop.run, args=(self.take,), daemon=True)

    def take(self):
        messages, received_ns, _ = self.raw.drain()
        with self.news:
            self.messages += messages
            self.received_ns += received_ns
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


def test_the_loop_stops_when_the_context_is_shut_down(node):
    with Running(node) as running:
        node.context.shutdown()
        running.thread.join(TIMEOUT)
        assert not running.thread.is_alive()


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
    rest_s = 1000.0
    rests = []
    monkeypatch.setattr('thermo_comp.ros.waitloop.time.sleep', rests.append)
    loop = WaitLoop(node, rest_s)
    raw = loop.subscribe(Vector3Stamped, 'samples', qos)
    n_taken = 0
    news = threading.Condition()

    def take():
        nonlocal n_taken
        with news:
            n_taken += len(raw.drain()[0])
            if interval_s is not None:
                raw.interval_ns = int(interval_s * 1e9)
            news.notify_all()

    thread = threading.Thread(target=loop.run, args=(take,), daemon=True)
    thread.start()
    publisher = peer.publisher(Vector3Stamped, 'samples')
    peer.poll(raw.subscription.get_publisher_count, 'the publisher')
    for n_sent in range(1, 6):
        publisher.publish(Vector3Stamped())
        with news:
            assert news.wait_for(lambda n=n_sent: n_taken == n, TIMEOUT)
    loop.stop()
    thread.join(TIMEOUT)
    assert not thread.is_alive()
    assert bool(rests) == is_resting
    assert all(0.0 < rest <= rest_s for rest in rests)
