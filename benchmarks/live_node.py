# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Runs the live node in this process, without loss of messages, and records its output.

The demonstration, tests and benchmarks use this module. As in a bag written by `replay`, the log
time of an Imu message is its stamp; the log time of any other message is the stamp of the last Imu
message before it.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from struct import Struct

import numpy as np
import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from thermo_comp.recording.blocks import ROLES
from thermo_comp.recording.writer import BagWriter
from thermo_comp.ros.messages import message_class
from thermo_comp.ros.node import CompensationNode
from thermo_comp.ros.player import PlayReport, opened_player
from thermo_comp.ros.waitloop import WaitLoop, separate_node, wait_until
from thermo_comp.topics import FLAGS, IMU_OUT, OUTPUTS, SAMPLES, thermometer
from thermo_comp.unit.calibration_file import load_calibration

#: Largest number of published samples that the node has not taken yet; the middleware stores 5000.
IN_FLIGHT = 2000
#: Time limit for discovery, and for the arrival of the last messages [s]: Fast DDS sends a lost
#: message again after 3 s, and on a busy machine must do so several times.
PATIENCE_S = 30.0
EVERYTHING = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
STAMP = Struct('<iI')


@contextmanager
def node_in_thread(*ros_args: str) -> Iterator[CompensationNode]:
    """Run the node in a thread of this process, in a separate rclpy context."""
    context = rclpy.context.Context()
    rclpy.init(args=['--ros-args', *ros_args], context=context)
    try:
        node = CompensationNode(context)
        thread = threading.Thread(target=node.run, daemon=True)
        thread.start()
        try:
            yield node
        finally:
            node.stop()
            thread.join()
            node.close()
    finally:
        context.try_shutdown()


def lossless(namespace: str = '', thermometers: Iterable[str] = ROLES[1:]) -> list[str]:
    """Return ROS arguments for reliable QoS, with which a node loses no message."""
    inputs = [*(sample.name for sample in SAMPLES.values()), *map(thermometer, thermometers)]
    overrides = [
        *(f'{topic}.subscription.reliability:=reliable' for topic in inputs),
        *(f'{topic}.subscription.history:=keep_all' for topic in inputs),
        f'{IMU_OUT.name}.publisher.history:=keep_all',
        *(f'{flag.name}.publisher.depth:=1000' for flag in FLAGS),
    ]
    return [word for text in overrides for word in ('-p', f'qos_overrides.{namespace}/{text}')]


class Recorder:
    """Keeps the node's outputs in memory, and writes a rosbag2 bag when the recorder is closed."""

    def __init__(self, path: Path, ros_args: Sequence[str]) -> None:
        self._writer, self._ros_args = BagWriter(path, overwrite=path.exists()), ros_args
        self._received: list[tuple[str, list[bytes]]] = []

    def __enter__(self) -> Recorder:
        with ExitStack() as stack:
            loop = WaitLoop(stack.enter_context(separate_node('recorder', self._ros_args)))
            self._heard = {
                topic.name: loop.subscribe(message_class(topic.type), topic.name, EVERYTHING)
                for topic in OUTPUTS
            }
            stack.callback(self._take)
            thread = threading.Thread(target=loop.run, args=[self._take])
            thread.start()
            stack.callback(thread.join)
            stack.callback(loop.stop)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *raised: object) -> None:
        """Stop recording; write the bag, unless an exception was raised."""
        self._stack.close()
        if raised[0] is not None:
            self._writer.abort()
            return
        with self._writer as writer:
            imus = (_stamps(some) for name, some in self._received if name == IMU_OUT.name)
            first_ns = next(imus, np.zeros(1, np.int64))[:1]
            for topic in OUTPUTS:
                newest, times, messages = first_ns, [], []
                for name, some in self._received:
                    newest = _stamps(some) if name == IMU_OUT.name else newest[-1:]
                    if name == topic.name:
                        times.append(newest if topic == IMU_OUT else newest.repeat(len(some)))
                        messages += some
                if messages:
                    writer.write_raw(topic.name, topic.type, np.concatenate(times), messages)

    def _take(self) -> None:
        for name, subscription in self._heard.items():
            messages, *_ = subscription.drain()
            if messages:
                self._received.append((name, messages))

    @property
    def counts(self) -> dict[str, int]:
        """Return the number of messages received so far by relative topic name."""
        counts = dict.fromkeys((topic.name for topic in OUTPUTS), 0)
        for name, messages in self._received:
            counts[name] += len(messages)
        return counts

    @property
    def has_publishers(self) -> bool:
        """Whether every topic has a publisher."""
        return all(topic.count_publishers() for topic in self._heard.values())


def _stamps(messages: list[bytes]) -> np.ndarray:
    stamps = np.array([STAMP.unpack_from(data, 4) for data in messages])
    return stamps[:, 0] * 10**9 + stamps[:, 1]


def through_the_node(
    bag: Path,
    calibration: Path,
    output: Path,
    *node_args: str,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[PlayReport, dict[str, int]]:
    """
    Play a bag into the node and record the node's output, without loss of a message.

    Returns the player's report and the number of recorded messages by topic. Unlike on a robot,
    the QoS is reliable with unlimited depth, and the player waits for the node.
    """
    namespace = f'/demo_{os.getpid()}'
    ros_args = ['-r', f'__ns:={namespace}', '-r', f'/diagnostics:={namespace}/diagnostics']
    settings = lossless(namespace, ['board', *load_calibration(calibration).sensors])
    settings += ['-p', f'calibration_file:={calibration}', *node_args]
    settings += ['--log-level', f'{namespace[1:]}.thermo_comp:=WARN']
    with (
        node_in_thread(*ros_args, *settings) as node,
        Recorder(output, ros_args) as recorder,
        opened_player(bag, 0.0, ros_args=ros_args) as player,
    ):

        def is_joined() -> bool:
            """Whether publishers and subscribers of all topics have discovered each other."""
            heard = {subscription.topic_name for subscription in node.node.subscriptions}
            sent = {publisher.topic_name for publisher in player.node.publishers}
            results = {f'{namespace}/{topic.name}' for topic in OUTPUTS}
            return (
                recorder.has_publishers
                and heard.isdisjoint(player.unheard())
                and all(
                    subscription.get_publisher_count()
                    for subscription in node.node.subscriptions
                    if subscription.topic_name in sent
                )
                and all(
                    publisher.get_subscription_count()
                    for publisher in node.node.publishers
                    if publisher.topic_name in results
                )
            )

        wait_until(is_joined, PATIENCE_S)
        played = player.run(
            progress, lambda n: wait_until(lambda: n - node.counts()[0] <= IN_FLIGHT, PATIENCE_S)
        )
        n_sent = max(played.n_messages.values())

        def is_complete() -> bool:
            n_in, n_out, n_flags = node.counts()
            return n_in == n_sent and [*recorder.counts.values()] == [n_out, n_flags, n_flags]

        wait_until(is_complete, PATIENCE_S)
    # The node does not count temperature readings, so `is_complete` does not wait for regime flags
    # of readings after the last sample; such flags may arrive until the recorder is closed.
    return played, recorder.counts
