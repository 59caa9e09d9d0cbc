# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the player: publishes a bag on the node's input topics, with `/clock`, at a multiple of real
time or as fast as the subscribers acknowledge messages.

Topics have the relative names of the node's inputs. Messages keep the bag's order and their bytes;
ROS 1 messages are rewritten in CDR, temperatures in messages of any type as
sensor_msgs/Temperature. After `WINDOW` messages of a topic the player waits until every reliable
subscriber has acknowledged these messages. Fast DDS requests acknowledgements every 3 s, and with
every message while the history of a publisher is full. The histories are therefore small, and
transient-local durability keeps each history full.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from ..errors import ThermoCompError
from ..recording.blocks import Block, RecordingInfo, Role
from ..recording.reader import RecordingReader, open_recording
from ..recording.topics import Topics
from ..topics import SAMPLES, TEMPERATURE, thermometer
from .messages import message_class
from .waitloop import separate_node, wait_until

NODE_NAME = 'thermo_comp_player'

#: Largest number of unacknowledged messages of a topic; depth of the publisher's history.
WINDOW: dict[Role, int] = defaultdict(lambda: 50, accel=200)
CLOCK_PERIOD = 0.01  # wall time between two messages on `/clock` [s]
#: Interval of the checks for acknowledgements, which Fast DDS sends within some 5 ms [s].
ACKNOWLEDGEMENT_NAP = 0.0005
#: Time for subscribers to discover the player [s]; the middleware reports no discovery.
SETTLING = 0.3
PATIENCE = 30.0  # longest wait for the acknowledgement of all sent messages of a topic [s]


@dataclass(frozen=True, slots=True)
class PlayReport:
    """Summary of a playback; topics are given by their full names."""

    n_messages: dict[str, int]
    duration_s: float  # wall time from the first message to the last acknowledgement [s]
    unheard: list[str]  # topics without a subscriber
    lossy: list[str]  # topics with a best-effort subscriber, which may lose messages
    info: RecordingInfo


def play(
    path: str | Path,
    *,
    rate: float = 1.0,
    wait_s: float = 10.0,
    topics: Topics | None = None,
    ros_args: Sequence[str] = (),
    progress: Callable[[float], None] = lambda _: None,
) -> PlayReport:
    """Play a bag at `rate` times real time, once all topics have subscribers or after `wait_s`."""
    with opened_player(path, rate, topics, ros_args) as player:
        wait_until(lambda: not player.unheard(), wait_s)
        if wait_s > 0.0:
            time.sleep(SETTLING)
        return player.run(progress)


@contextmanager
def opened_player(
    path: str | Path, rate: float, topics: Topics | None = None, ros_args: Sequence[str] = ()
) -> Iterator[Player]:
    """Open a bag for playing at `rate` times real time; 0: as fast as subscribers acknowledge."""
    if not rate >= 0.0:
        raise ValueError(f'`rate` must be zero or positive, got {rate}')
    with (
        open_recording(path, topics, require=('accel',)) as reader,
        separate_node(NODE_NAME, ros_args) as node,
    ):
        yield Player(node, reader, rate)


class Player:
    """A node with one publisher for each topic of a bag."""

    def __init__(self, node: Node, reader: RecordingReader, rate: float) -> None:
        self.node, self._reader, self._rate = node, reader, rate
        topics = {role: (TEMPERATURE, thermometer(role)) for role in reader.topics}
        samples = SAMPLES[reader.info.input or 'counts']
        topics['accel'] = samples.type, samples.name
        self._publishers: dict[Role, Any] = {}
        for role, (kind, name) in topics.items():
            qos = QoSProfile(depth=WINDOW[role], durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._publishers[role] = node.create_publisher(message_class(kind), name, qos)
        self._clock = node.create_publisher(Clock, '/clock', 1)
        self._next_clock = 0.0

    def unheard(self) -> list[str]:
        """Return the topics without a subscriber."""
        publishers = self._publishers.values()
        return [out.topic_name for out in publishers if not out.get_subscription_count()]

    def run(
        self, progress: Callable[[float], None], throttle: Callable[[int], object] = lambda _: None
    ) -> PlayReport:
        """Send the bag; after every `WINDOW` samples call `throttle` with the number sent."""
        reader, n_sent = self._reader, dict.fromkeys(self._publishers, 0)
        total = sum(reader.info.topics[name][1] for name in reader.topics.values())
        topics = {publisher.topic_name: role for role, publisher in self._publishers.items()}
        unheard = self.unheard()
        lossy = [
            name
            for name in topics
            for end in self.node.get_subscriptions_info_by_topic(name)
            if end.qos_profile.reliability != ReliabilityPolicy.RELIABLE
        ]
        started, start_ns = time.monotonic(), None
        for block in reader.blocks(raw=True):
            for _, log_ns, role, data in _in_order(block):
                start_ns = log_ns if start_ns is None else start_ns
                self._pace(started, start_ns, log_ns)
                self._publishers[role].publish(data)
                n_sent[role] += 1
                if n_sent[role] % WINDOW[role] == 0:
                    self._await_acknowledgement(role)
                    if role == 'accel':
                        throttle(n_sent[role])
            progress(min(1.0, sum(n_sent.values()) / max(1, total)))
        for role in self._publishers:
            self._await_acknowledgement(role)
        return PlayReport(
            {name: n_sent[role] for name, role in topics.items()},
            time.monotonic() - started,
            unheard,
            list(dict.fromkeys(lossy)),
            reader.info,
        )

    def _pace(self, started: float, start_ns: int, log_ns: int) -> None:
        """Sleep until a message is due; publish `/clock` meanwhile."""
        due = started + (log_ns - start_ns) * 1e-9 / self._rate if self._rate else started
        while True:
            now = time.monotonic()
            left_s = max(0.0, due - now)
            if now >= self._next_clock:
                self._next_clock = now + CLOCK_PERIOD
                clock_ns, message = log_ns - int(left_s * self._rate * 1e9), Clock()
                message.clock.sec, message.clock.nanosec = divmod(clock_ns, 1_000_000_000)
                self._clock.publish(message)
            if not left_s:
                return
            time.sleep(min(left_s, CLOCK_PERIOD))

    def _await_acknowledgement(self, role: Role) -> None:
        publisher = self._publishers[role]
        # Poll for acknowledgements: waiting inside rclpy would block the other threads.
        is_done = partial(publisher.wait_for_all_acked, Duration())
        if not wait_until(is_done, PATIENCE, ACKNOWLEDGEMENT_NAP):
            name = publisher.topic_name
            raise ThermoCompError(
                f'{name}: a subscriber has not acknowledged all messages within {PATIENCE:g} s; '
                'restart the subscriber, or let it subscribe with best effort'
            )


def _in_order(block: Block) -> list[tuple[float, int, Role, bytes]]:
    """List a block's messages in the bag's order: place among samples, log time, role, bytes."""
    rows: list[tuple[float, int, Role, bytes]] = []
    places: dict[Role, Any] = {role: part.after - 0.5 for role, part in block.temperatures.items()}
    places['accel'] = np.arange(len(block))
    for role, messages in block.raw.items():
        log_ns = block.log_ns[role].tolist()
        rows += zip(places[role].tolist(), log_ns, repeat(role), messages, strict=False)
    # Readings between the same two samples are ordered by log time.
    return sorted(rows, key=itemgetter(0, 1))
