# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the peer of a node in tests: publishers, subscribers and clients on DDS."""

import threading
from contextlib import contextmanager, suppress

import rclpy
from builders import SECOND_NS, START_NS
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from live_node import node_in_thread  # noqa: F401 - for the tests
from rcl_interfaces.srv import DescribeParameters, SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, Temperature

#: Interval between the samples of a test [ns].
CYCLE_NS = 10_000_000
#: Time limit for any event on DDS [s]; after this time the test fails.
TIMEOUT = 30.0
DEEP = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)


def stamped(message, stamp_ns, frame_id=''):
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, SECOND_NS)
    message.header.frame_id = frame_id
    return message


def stamp_of(message):
    return message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec


def standing(k):
    """Return sample number k at rest, 300 counts per m/s^2; neighbouring samples differ."""
    return 30.0 + k % 3, -20.0 + k % 2, 2941.0 + k % 5


class Peer:
    """A ROS node in a thread; `wait_for` tests its condition after each received message."""

    def __init__(self):
        self.context = Context()
        rclpy.init(args=[], context=self.context)
        self.node = rclpy.create_node('peer', context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._news = threading.Condition()
        self._clients = {}
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self):
        self.context.try_shutdown()
        self._thread.join(TIMEOUT)
        assert not self._thread.is_alive()
        self._executor.shutdown()
        self.node.destroy_node()

    def listen(self, kind, topic, qos=DEEP, raw=False):
        heard = []

        def hear(message):
            with self._news:
                heard.append(message)
                self._news.notify_all()

        self.node.create_subscription(kind, topic, hear, qos, raw=raw)
        return heard

    def wait_for(self, condition, what='the condition'):
        with self._news:
            assert self._news.wait_for(condition, TIMEOUT), f'{what} did not come true'

    def poll(self, condition, what):
        """Wait for a condition that no message announces, such as a discovery."""
        pause = threading.Event()
        for _ in range(int(TIMEOUT / 0.02)):
            if condition():
                return
            pause.wait(0.02)
        raise AssertionError(f'{what} did not come true')

    def publisher(self, kind, topic, qos=DEEP):
        publisher = self.node.create_publisher(kind, topic, qos)
        self.poll(publisher.get_subscription_count, f'a subscriber to {topic}')
        return publisher

    def join(self, node):
        """Wait until publishers and subscribers of all topics have discovered each other."""
        topics = {subscription.topic_name for subscription in self.node.subscriptions}
        outputs = [output for output in node.node.publishers if output.topic_name in topics]
        # Some tests publish no temperatures, so leave out inputs without a publisher.
        sent = {publisher.topic_name for publisher in self.node.publishers}
        inputs = [input_ for input_ in node.node.subscriptions if input_.topic_name in sent]
        self.poll(
            lambda: (
                all(sub.get_publisher_count() for sub in inputs)
                and all(sub.get_publisher_count() for sub in self.node.subscriptions)
                and all(output.get_subscription_count() for output in outputs)
            ),
            'the match of all topics',
        )

    def call(self, kind, name, request):
        # Keep service clients, because the discovery of a service takes longer than a call.
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        client = self._clients[name]
        assert client.wait_for_service(TIMEOUT), name
        future = client.call_async(request)
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        assert done.wait(TIMEOUT), f'{name} did not answer'
        return future.result()

    def set_parameters(self, **values):
        request = SetParameters.Request(parameters=parameters_of(values))
        return self.call(SetParameters, 'thermo_comp/set_parameters', request).results

    def set_atomically(self, **values):
        request = SetParametersAtomically.Request(parameters=parameters_of(values))
        name = 'thermo_comp/set_parameters_atomically'
        return self.call(SetParametersAtomically, name, request).result

    def describe(self, *names):
        request = DescribeParameters.Request(names=list(names))
        name = 'thermo_comp/describe_parameters'
        return self.call(DescribeParameters, name, request).descriptors


def parameters_of(values):
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]


class Driver:
    def __init__(self, peer, kind=Vector3Stamped, topic='accel/counts', qos=DEEP):
        self._samples = peer.publisher(kind, topic, qos)
        self._board = peer.publisher(Temperature, 'temperature/board')
        self._case = peer.publisher(Temperature, 'temperature/case')

    def temperatures(self, stamp_ns, board, case=None):
        self._board.publish(stamped(Temperature(temperature=board), stamp_ns))
        if case is not None:
            self._case.publish(stamped(Temperature(temperature=case), stamp_ns))

    def counts(self, stamp_ns, x, y, z, frame_id='imu'):
        message = stamped(Vector3Stamped(), stamp_ns, frame_id)
        message.vector.x, message.vector.y, message.vector.z = x, y, z
        self._samples.publish(message)

    def imu(self, message):
        self._samples.publish(message)


def drive(peer, node, kind=Vector3Stamped, topic='accel/counts', qos=DEEP):
    driver = Driver(peer, kind, topic, qos)
    peer.join(node)
    return driver


def node_arguments(unit, *overrides):
    """Make the arguments of a node that publishes diagnostics at 20 Hz."""
    words = [f'calibration_file:={unit}', 'diagnostics_period:=0.05', *overrides]
    return [word for override in words for word in ('-p', override)]


@contextmanager
def bare_node(*overrides):
    context = Context()
    words = [word for override in overrides for word in ('-p', override)]
    rclpy.init(args=['--ros-args', *words], context=context)
    node = rclpy.create_node('thermo_comp', context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


class Samples:
    def __init__(self, peer, node):
        self._peer = peer
        self.heard = peer.listen(Imu, 'imu/data_raw')
        self.reports = peer.listen(DiagnosticArray, '/diagnostics')
        self.driver = drive(peer, node)
        self.n_sent = 0
        self.go_on()

    def send(self, n=20):
        for k in range(self.n_sent, self.n_sent + n):
            if k % 10 == 0:
                self.driver.temperatures(START_NS + k * CYCLE_NS, 20.0, 20.0)
            self.driver.counts(START_NS + k * CYCLE_NS, *standing(k))
        self.n_sent += n

    def go_on(self):
        before = len(self.heard)
        self.send()
        self._peer.wait_for(lambda: len(self.heard) >= before + 20, '20 further samples')


def status_with(peer, heard, text, send=lambda: None):
    """Call `send` until a diagnostics message contains the text; return the message's status."""
    del heard[:]
    collected = []

    def look():
        send()
        collected.extend(a.status[0] for a in list(heard) if text in a.status[0].message)
        return bool(collected)

    peer.poll(look, f'{text!r} among {[a.status[0].message for a in heard][-3:]}')
    return collected[0]
