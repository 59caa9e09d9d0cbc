# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the round trip: bag -> player -> DDS -> node process -> DDS -> recorder -> bag, without loss.

Only the QoS differs from a robot's: reliable, without a limit of depth. And the player waits for
the node: what a full reader has to be sent again comes later than the temperatures behind it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from ..errors import ThermoCompError
from ..online.status import STAMPED_TOPIC
from ..recording.blocks import ROLES
from ..unit.calibration_file import load_calibration
from .listener import OUTPUTS, Recorder
from .node import NODE_NAME
from .player import PlayReport, opened_player
from .waitloop import wait_until

#: How long node and recorder may take to find each other, or to take what comes last: a message
#: that Fast DDS has to repeat is 3 s late, on a busy machine several times [s].
PATIENCE_S = 30.0
ANSWER_S = 1.0  # how long the node may take to answer [s]; then it is asked again
STOPPING_S = 10.0  # how long the node may take to end [s]
#: Samples that the node may be behind the player; its middleware holds 5000.
IN_FLIGHT = 2000

_TOPICS = {**OUTPUTS, 'diagnostics': DiagnosticArray}


class NodeProcess:
    """The node as a process of its own, for as long as the context lasts."""

    def __init__(self, *ros_args: str) -> None:
        self._ros_args = ros_args

    def __enter__(self) -> NodeProcess:
        self._log = tempfile.TemporaryFile()
        command = [sys.executable, '-m', 'thermo_comp.ros.node', '--ros-args', *self._ros_args]
        # The very package that runs here, wherever it lies.
        paths = [str(Path(__file__).resolve().parents[2]), os.environ.get('PYTHONPATH', '')]
        environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, paths))}
        self.process = subprocess.Popen(  # noqa: S603  this interpreter, this package
            command, stdout=self._log, stderr=self._log, env=environment
        )
        return self

    def __exit__(self, *_: object) -> None:
        """End the process as a launch system does."""
        self.stop()
        self._log.close()

    @property
    def is_alive(self) -> bool:
        """Whether the process still runs."""
        return self.process.poll() is None

    @property
    def said(self) -> str:
        """What it has written to its standard output and error."""
        # Without moving the place where it writes.
        return os.pread(self._log.fileno(), 1 << 20, 0).decode(errors='replace').strip()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal, wait for the end, return the exit code."""
        # Popen sends nothing to a process that has ended.
        self.process.send_signal(number)
        try:
            return self.process.wait(timeout=STOPPING_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


def lossless(namespace: str = '', thermometers: Iterable[str] = ROLES[1:]) -> list[str]:
    """Give the ROS arguments under which a node loses nothing, at the price of latency."""
    inputs = ['accel/counts', 'imu/uncompensated', *(f'temperature/{n}' for n in thermometers)]
    overrides = [
        *(f'{topic}.subscription.reliability:=reliable' for topic in inputs),
        *(f'{topic}.subscription.history:=keep_all' for topic in inputs),
        'imu/data_raw.publisher.history:=keep_all',
        'regime/dynamic.publisher.depth:=1000',
        f'{STAMPED_TOPIC}.publisher.depth:=1000',
    ]
    return [word for one in overrides for word in ('-p', f'qos_overrides.{namespace}/{one}')]


def round_trip(
    bag: str | Path,
    calibration: str | Path,
    output: str | Path,
    *,
    rate: float = 0.0,
    node_args: Sequence[str] = (),
    overwrite: bool = False,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[PlayReport, dict[str, int]]:
    """Play a bag into a node; return what was played and how much was recorded, by topic."""
    namespace = f'/round_trip_{os.getpid()}'
    ros_args = ['-r', f'__ns:={namespace}']
    thermometers = ['board', *load_calibration(calibration).sensors]
    arguments = [*ros_args, '-r', f'/diagnostics:={namespace}/diagnostics']
    arguments += [*lossless(namespace, thermometers), '-p', 'diagnostics_period:=0.1']
    arguments += ['-p', f'calibration_file:={calibration}', *node_args]
    with (
        NodeProcess(*arguments) as node,
        Recorder(output, topics=_TOPICS, ros_args=ros_args, overwrite=overwrite) as recorder,
    ):

        def account() -> dict[str, str]:
            """Return what the node has said of itself last."""
            newest = recorder.newest('diagnostics')
            return {one.key: one.value for one in newest.status[0].values} if newest else {}

        def is_connected() -> bool:
            # The node learns of the recorder's subscriptions in the order in which they were made:
            # once it is heard on the last one it sends on all of them.
            return not node.is_alive or (recorder.has_publishers and bool(account()))

        if not wait_until(is_connected, PATIENCE_S) or not node.is_alive:
            raise ThermoCompError(' '.join(node.said.split()) or 'the node was not found')

        def throttle(n: int) -> None:
            """Wait for the node, which tells how far it is ten times a second."""
            wait_until(lambda: n - int(account()['samples in']) <= IN_FLIGHT, ANSWER_S)

        with opened_player(bag, rate, ros_args=ros_args) as player:
            awaited = ['accel', *thermometers]
            wait_until(lambda: not player.unheard(awaited) and _answers(player.node), PATIENCE_S)
            played = player.run(progress, throttle)

        def is_complete() -> bool:
            """Tell whether the node has taken all, and the recorder all that it published."""
            said, counts = account(), recorder.counts
            expected = [said[key] for key in ('samples in', 'samples out', 'flags', 'flags')]
            found = [max(played.n_messages.values()), *(counts[topic] for topic in OUTPUTS)]
            return not node.is_alive or expected == [str(count) for count in found]

        wait_until(is_complete, PATIENCE_S)
        if not node.is_alive:
            raise ThermoCompError(f'the node ended: {" ".join(node.said.split())}')
        return played, recorder.counts


def _answers(player: Node) -> bool:
    """Tell whether the node answers the player: then it knows the older publishers, too."""
    # The first thing that one process ever sends to another can get lost on a busy machine, and
    # would come again behind the samples: so it is this question.
    client = player.create_client(GetParameters, f'{NODE_NAME}/get_parameters')
    executor = SingleThreadedExecutor(context=player.context)
    try:
        if not client.wait_for_service(ANSWER_S):
            return False
        answer = client.call_async(GetParameters.Request(names=['calibration_file']))
        executor.add_node(player)
        executor.spin_until_future_complete(answer, ANSWER_S)
        return bool(answer.done())
    finally:
        executor.shutdown()
        player.destroy_client(client)
