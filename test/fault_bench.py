# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the fault bench: it sends a bag in lots, and waits until the node has counted each lot."""

import struct
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from fault_rig import CONFIG, STANDS_S, START_NS, counts_of, force_at, seconds_of
from geometry_msgs.msg import Vector3Stamped
from live_node import lossless
from node_process import NodeProcess
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from ros_helpers import Peer, parameters_of
from sensor_msgs.msg import Imu, Temperature

from thermo_comp.ros.waitloop import WaitLoop

#: Time limit for any event [s]; after this time the test fails.
TIMEOUT_S = 60.0
#: A lot is sent without a pause: its longest span [s] and largest number of messages. The shared
#: memory of Fast DDS holds 512 messages; further messages arrive seconds later, out of order.
LOT_S, LOT_SIZE = 10.0, 400
QOS = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
FRAME = b'sensor\0'
_REST = np.array([20.0])
#: A sample of the unit of `fault_rig` at rest at the reference temperature [counts].
_STANDING = counts_of(force_at(np.array([STANDS_S])), _REST, _REST, 0.0 * _REST)[0]
_HEAD = '<4siII7s5x'
_COUNTS, _READING = struct.Struct(_HEAD + '3d'), struct.Struct(_HEAD + '2d')
_IMU = np.dtype('V4,<i4,<u4,V16,(37,)<f8')
_IMU.names = 'head', 'sec', 'nanosec', 'frame', 'values'
_TOPICS = {
    'counts': (Vector3Stamped, 'accel/counts'),
    'board': (Temperature, 'temperature/board'),
    'case': (Temperature, 'temperature/case'),
}
PARAMETERS = (
    f'transition_time:={CONFIG.transition_time_s}',
    f'temperature_timeout:={CONFIG.temperature_timeout_s}',
    f'case_timeout:={CONFIG.case_timeout_s}',
    f'gravity_tolerance:={CONFIG.gravity_tolerance_m_s2}',
    'diagnostics_period:=0.01',
)


@dataclass
class Heard:
    stamp_ns: np.ndarray
    force: np.ndarray
    covariance: np.ndarray
    #: Level and message of each diagnostics report, and all key values of the last report.
    reports: list[tuple[int, str]] = field(default_factory=list)
    values: dict[str, str] = field(default_factory=dict)

    def says(self, text, level):
        return any(level <= found and text in message for found, message in self.reports)


class Bench:
    """Publishes samples and two temperatures to the node, and receives the node's output."""

    def __init__(self, node, context):
        self.process = node
        self.node = rclpy.create_node('fault_bench', context=context)
        # WaitLoop does not serve clients, so a `Peer` calls the services of the node.
        operator = self._operator = Peer()
        self._client = operator.node.create_client(SetParameters, 'thermo_comp/set_parameters')
        self._loop = WaitLoop(self.node)
        self._imu = self._loop.subscribe(Imu, 'imu/data_raw', QOS)
        self._diagnostics = self._loop.subscribe(DiagnosticArray, '/diagnostics', QOS)
        self._news = threading.Condition()
        self._frames = []
        self._reports = []
        self._values = {}
        self.n_sent = self._n_taken = self._n_reports = 0
        #: Whether the test itself has ended the node process.
        self.is_ended = False
        self._publishers = []
        self._open_publishers()
        self._thread = threading.Thread(target=self._loop.run, args=(self._hear,), daemon=True)
        self._thread.start()

    def _open_publishers(self):
        self._publish = {}
        for name, (kind, topic) in _TOPICS.items():
            publisher = self.node.create_publisher(kind, topic, QOS)
            self._publishers.append(publisher)
            self._publish[name] = publisher.handle.publish_raw

    def restart_publishers(self):
        """Replace all publishers, and wait until the node has discovered the new publishers."""
        for publisher in self._publishers:
            self.node.destroy_publisher(publisher)
        self._publishers.clear()
        self._open_publishers()
        pause = threading.Event()
        for publisher in self._publishers:
            while not publisher.get_subscription_count():
                pause.wait(0.01)
                assert self.process.is_alive, self.process.said
        # The node's subscriptions discover the new publishers within 0.5 s.
        pause.wait(0.5)

    def close(self):
        self._loop.stop()
        self._thread.join(TIMEOUT_S)
        self._operator.close()
        self.node.destroy_node()

    def _hear(self):
        frames, *_ = self._imu.drain()
        reports, *_ = self._diagnostics.drain()
        with self._news:
            self._frames += frames
            for data in reports:
                (status,) = deserialize_message(data, DiagnosticArray).status
                self._reports.append((status.level[0], status.message))
                self._n_reports += 1
                self._values = {value.key: value.value for value in status.values}
            self._news.notify_all()

    def wait_for(self, condition, what):
        with self._news:
            done = self._news.wait_for(lambda: condition() or not self.process.is_alive, TIMEOUT_S)
        assert self.process.is_alive, self.process.said
        assert done, f'{what} did not come true; {self._values}'

    def ask(self, **values):
        assert self._client.wait_for_service(TIMEOUT_S)
        return self._client.call_async(SetParameters.Request(parameters=parameters_of(values)))

    def set_parameters(self, **values):
        future = self.ask(**values)
        pause = threading.Event()
        # Poll the future: a callback would wait for the executor, which waits for the answer.
        while not future.done():
            pause.wait(0.001)
            assert self.process.is_alive, self.process.said
        return future.result().results[0]

    def send(self, events):
        n = 0
        for topic, stamp_ns, value in events:
            sec, nanosec = divmod(stamp_ns, 1_000_000_000)
            if topic == 'counts':
                n += 1
                data = _COUNTS.pack(b'\0\1\0\0', sec, nanosec, 7, FRAME, *value)
            else:
                data = _READING.pack(b'\0\1\0\0', sec, nanosec, 7, FRAME, value, 0.0)
            self._publish[topic](data)
        self.n_sent += n
        return n

    def meet(self):
        """Send samples later than all bags until the node publishes; read the node's counters."""
        pause = threading.Event()
        standing = _STANDING.copy()
        for k in range(1000):
            stamp_ns = START_NS + (100_000 + k) * 1_000_000_000
            # Samples at rest and at constant temperature pass all checks of the node.
            standing[2] += 1.0
            self.send([('board', stamp_ns, _REST[0]), ('counts', stamp_ns, tuple(standing))])
            pause.wait(0.02)
            if self._frames:
                break
        # Samples sent before discovery are lost, so the node states how many it has counted.
        last_ns = stamp_ns + 1_000_000_000
        standing[2] += 1.0
        self.send([('counts', last_ns, tuple(standing))])
        last = divmod(last_ns, 1_000_000_000)
        self.wait_for(
            lambda: self._frames and struct.unpack_from('<iI', self._frames[-1], 4) == last,
            'the output of the last sample',
        )
        n_reports = self._n_reports
        self.wait_for(lambda: self._n_reports > n_reports + 1, 'a report')
        self.n_sent = int(self._values['samples in'])
        self._n_taken = int(self._values['samples out']) - len(self._frames)

    def settle(self):
        """Wait until the node has counted every sample and all of its output has arrived."""

        def is_done():
            values = self._values
            return (
                int(values.get('samples in', -1)) == self.n_sent
                and len(self._frames) >= int(values['samples out']) - self._n_taken
            )

        self.wait_for(is_done, f'{self.n_sent} samples')

    def play(self, events):
        self.take()
        for lot in lots(events):
            if self.send(lot):
                self.settle()
            else:
                # The node takes all messages from its queues before each report.
                n_reports = self._n_reports
                self.wait_for(lambda n=n_reports: self._n_reports > n + 2, 'three reports')
        return self.take()

    def take(self):
        with self._news:
            frames, self._frames = self._frames, []
            reports, self._reports = self._reports, []
            self._n_taken += len(frames)
            values = dict(self._values)
        table = np.frombuffer(b''.join(frames), _IMU)
        stamps = table['sec'].astype(np.int64) * 1_000_000_000 + table['nanosec']
        numbers = table['values']
        return Heard(stamps, numbers[:, 25:28], numbers[:, 28:].reshape(-1, 3, 3), reports, values)


def lots(events):
    lot = []
    edge = None
    for event in events:
        span = int(seconds_of(event[1]) // LOT_S)
        is_sample = event[0] == 'counts'
        if lot and ((is_sample and span != edge) or len(lot) == LOT_SIZE):
            yield lot
            lot = []
        if is_sample:
            edge = span
        lot.append(event)
    yield lot


@contextmanager
def bench(calibration, *parameters, **environment):
    """Start a node process and a peer, and wait until they have discovered each other."""
    overrides = [f'calibration_file:={calibration}', *PARAMETERS, *parameters]
    arguments = [word for override in overrides for word in ('-p', override)]
    context = Context()
    rclpy.init(args=[], context=context)
    try:
        arguments = *lossless(), '--log-level', 'FATAL', *arguments
        with NodeProcess(*arguments, **environment) as node:
            peer = Bench(node, context)
            try:
                peer.meet()
                yield peer
                if not peer.is_ended:
                    assert node.is_alive, node.said
                    assert node.stop() == 0
                assert 'Traceback' not in node.said, node.said
            finally:
                peer.close()
    finally:
        context.try_shutdown()
