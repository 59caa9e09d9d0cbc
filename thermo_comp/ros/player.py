# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the player: a bag onto the node's live input topics, with `/clock`, paced or flow controlled.

Whatever the topics are called in the bag, they go out under the node's own relative names, so
remappings and a namespace apply as to a sensor driver. The messages are those of the bag, byte
for byte, in the bag's order; ROS 1 messages are rewritten in CDR.

Flow control: after `WINDOW` messages of a topic the player waits until every reliable subscriber
has acknowledged them, so no more than that is ever under way, which fits into the queues of the
transport, and none is overwritten before it has arrived. Fast DDS asks for acknowledgement with
every message only while the publisher's history is full, and otherwise every 3 s; hence the small
histories, which transient-local durability keeps full.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Vector3Stamped
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, Temperature

from ..errors import ThermoCompError
from ..recording import Block, Input, RawMessages, RecordingReader, Role, Topics, open_recording

NODE_NAME = 'thermo_comp_player'

#: Messages of a topic under way at most; so many are kept to be sent again.
WINDOW: dict[Role, int] = defaultdict(lambda: 50, accel=200)
#: Wall time between two messages on `/clock` [s].
CLOCK_PERIOD = 0.01
#: The longest nap, so that an interrupt is heeded [s].
NAP = 0.1
#: Time between two looks at what is acknowledged; that takes Fast DDS some 5 ms [s].
ACKNOWLEDGEMENT_NAP = 0.0005
#: Time the subscribers are given to find the player too where nobody tells when they have [s].
SETTLING = 0.3
#: How long a subscriber may leave a window unacknowledged [s].
PATIENCE = 30.0

_ACCEL = {'counts': (Vector3Stamped, 'accel/counts'), 'imu': (Imu, 'imu/uncompensated')}


@dataclass(slots=True)
class PlayReport:
    """What a player did."""

    n_messages: dict[str, int] = field(
        default_factory=dict
    )  # messages sent, by the topic's full name
    duration_s: float = 0.0  # wall time from the first message to the last acknowledgement [s]
    unheard: list[str] = field(default_factory=list)  # topics to which nobody listened
    lossy: list[str] = field(
        default_factory=list
    )  # topics with a best-effort subscriber, which can lose messages
    chosen: str | None = None  # which of its topics were taken by their type
    missing: str | None = None  # what of the bag could not be read


def play(
    path: str | Path,
    *,
    rate: float = 1.0,
    n_loops: int = 1,
    clock: bool = True,
    wait_s: float = 10.0,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    ros_args: Sequence[str] = (),
    is_found: Callable[[Node, Collection[Role]], bool] | None = None,
    throttle: Callable[[int], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> PlayReport:
    """
    Publish a bag's samples and temperatures.

    At `rate` seconds of the bag per second, 0 as fast as they are taken; `n_loops` times, 0 until
    interrupted; after at most `wait_s` for subscribers. `is_found` tells whether these have found
    the topics of some roles: what is sent before can come late. `throttle` gets the number of
    samples sent after each window and may block. ThermoCompError if a reliable subscriber stops.
    """
    if not rate >= 0.0:
        raise ValueError(f'`rate` must be zero or positive, got {rate}')
    if n_loops < 0:
        raise ValueError(f'`n_loops` must be zero or positive, got {n_loops}')
    context = Context()
    with open_recording(path, topics, input, require=('accel',)) as reader:
        rclpy.init(args=['--ros-args', *ros_args], context=context)
        try:
            player = _Player(context, reader, rate, clock, throttle)
            player.wait_for_subscribers(wait_s, is_found)
            n_done = 0
            while n_loops == 0 or n_done < n_loops:
                player.play_once(progress)
                n_done += 1
            return player.finish()
        finally:
            context.try_shutdown()


class _Player:
    """A node with the publishers of one bag."""

    def __init__(
        self,
        context: Context,
        reader: RecordingReader,
        rate: float,
        clock: bool,
        throttle: Callable[[int], None] | None,
    ) -> None:
        self._reader = reader
        self._throttle = throttle
        self._rate = rate
        self._node = rclpy.create_node(NODE_NAME, context=context)
        accel_type, accel_name = _ACCEL[reader.info.input or 'counts']
        self._publishers: dict[Role, Any] = {
            role: self._node.create_publisher(
                accel_type if role == 'accel' else Temperature,
                accel_name if role == 'accel' else f'temperature/{role}',
                QoSProfile(
                    depth=WINDOW[role],
                    reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL,
                ),
            )
            for role in reader.topics
        }
        self._clock = self._node.create_publisher(Clock, '/clock', 1) if clock else None
        self._total = sum(reader.info.topics[name][1] for name in reader.topics.values())
        self._n_sent: dict[Role, int] = dict.fromkeys(self._publishers, 0)
        self._report = PlayReport()
        self._started = time.monotonic()
        self._next_clock = 0.0

    def wait_for_subscribers(
        self, wait_s: float, is_found: Callable[[Node, Collection[Role]], bool] | None
    ) -> None:
        """Wait until every topic has a subscriber which knows of it, or for so long."""
        deadline = time.monotonic() + wait_s
        while any(self._unheard()) and time.monotonic() < deadline:
            time.sleep(min(NAP, 0.02))
        self._report.unheard = [one.topic_name for one in self._unheard()]
        self._report.lossy = [
            one.topic_name
            for one in self._publishers.values()
            if any(
                end.qos_profile.reliability != ReliabilityPolicy.RELIABLE
                for end in self._node.get_subscriptions_info_by_topic(one.topic_name)
            )
        ]
        if is_found is not None:
            while not is_found(self._node, self._publishers) and time.monotonic() < deadline:
                time.sleep(min(NAP, 0.02))
        elif wait_s > 0.0:
            time.sleep(SETTLING)
        self._started = time.monotonic()

    def _unheard(self) -> list[Any]:
        return [one for one in self._publishers.values() if not one.get_subscription_count()]

    def play_once(self, progress: Callable[[float], None] | None) -> None:
        """Send the whole bag."""
        start_wall = time.monotonic()
        start_ns: int | None = None
        n_before = sum(self._n_sent.values())
        for block in self._reader.blocks(raw=True):
            for log_ns, role, data in _in_order(block, self._reader.topics):
                start_ns = log_ns if start_ns is None else start_ns
                if self._rate:
                    self._pace(start_wall, start_ns, log_ns)
                elif time.monotonic() >= self._next_clock:
                    self._tell_time(log_ns)
                self._publishers[role].publish(data)
                self._n_sent[role] += 1
                if self._n_sent[role] % WINDOW[role] == 0:
                    self._await_acknowledgement(role)
                    if role == 'accel' and self._throttle is not None:
                        self._throttle(self._n_sent[role])
            if progress is not None:
                progress(min(1.0, (sum(self._n_sent.values()) - n_before) / max(1, self._total)))

    def finish(self) -> PlayReport:
        """Wait until everything has arrived and account for it."""
        for role in self._publishers:
            self._await_acknowledgement(role)
        self._report.duration_s = time.monotonic() - self._started
        self._report.chosen = self._reader.info.chosen
        self._report.missing = self._reader.info.truncated
        for role, publisher in self._publishers.items():
            self._report.n_messages[publisher.topic_name] = self._n_sent[role]
        return self._report

    def _pace(self, start_wall: float, start_ns: int, log_ns: int) -> None:
        """Sleep until a message is due; tell the time meanwhile."""
        due = start_wall + (log_ns - start_ns) * 1e-9 / self._rate
        while True:
            now = time.monotonic()
            if now >= self._next_clock:
                elapsed_ns = int((min(now, due) - start_wall) * self._rate * 1e9)
                self._tell_time(start_ns + elapsed_ns)
            if now >= due:
                return
            time.sleep(min(due - now, CLOCK_PERIOD if self._clock else NAP))

    def _tell_time(self, log_ns: int) -> None:
        self._next_clock = time.monotonic() + CLOCK_PERIOD
        if self._clock is not None:
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(log_ns, 1_000_000_000)
            self._clock.publish(message)

    def _await_acknowledgement(self, role: Role) -> None:
        publisher = self._publishers[role]
        deadline = time.monotonic() + PATIENCE
        # Asked again and again: waiting inside rclpy would keep this process's other threads out.
        while not publisher.wait_for_all_acked(Duration()):
            if time.monotonic() > deadline:
                raise ThermoCompError(
                    f'{publisher.topic_name}: a subscriber took nothing for {PATIENCE:g} s'
                )
            time.sleep(ACKNOWLEDGEMENT_NAP)


def _in_order(block: Block, topics: Mapping[Role, str]) -> Iterator[tuple[int, Role, bytes]]:
    """Give a block's messages in the order of the bag: log time, role, bytes."""
    messages = {one.topic: _split(one) for one in block.raw}
    roles: list[Role] = [*block.temperatures, 'accel']
    places: list[Any] = [one.after - 0.5 for one in block.temperatures.values()]
    places.append(np.arange(len(block)))
    log_ns = np.concatenate([block.log_ns[role] for role in roles])
    which = np.repeat(np.arange(len(roles)), [len(one) for one in places])
    # Readings between the same two samples: by log time.
    for index in np.lexsort((log_ns, np.concatenate(places))).tolist():
        role = roles[which[index]]
        yield int(log_ns[index]), role, next(messages[topics[role]])


def _split(messages: RawMessages) -> Iterator[bytes]:
    start, data = 0, messages.data.tobytes()
    for end in messages.ends.tolist():
        yield data[start:end]
        start = end
