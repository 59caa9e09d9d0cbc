# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the node's inputs as a recorder hears them: live topics to blocks, beside driver and node.

A topic is subscribed to once somebody publishes it, with the reliability that is offered. The log
time of a message is when it was received.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from geometry_msgs.msg import Vector3Stamped
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, Temperature

from ..recording import ROLES, Block, Input, Role, Topics
from ..recording.decode import Decoder, Feed
from ..recording.growing import News
from ..recording.messages import Messages
from ..recording.topics import IMU, TEMPERATURE, VECTOR3_STAMPED, is_thermometer
from .listener import Listener
from .waitloop import RawSubscription

NODE_NAME = 'thermo_comp_record'
#: Time between two looks at what is published, and between two blocks [s].
LOOK_S, BLOCK_S = 0.5, 1.0

_CLASSES = {VECTOR3_STAMPED: Vector3Stamped, IMU: Imu, TEMPERATURE: Temperature}


class LiveTopics:
    """Listens for as long as the context lasts."""

    def __init__(self, topics: Topics, input: Input, ros_args: Sequence[str] = ()) -> None:  # noqa: A002
        self._topics, self._input = topics, input
        self._ros_args = ros_args
        self._heard: dict[Role, tuple[Feed, RawSubscription]] = {}
        self._lock = threading.Lock()
        self._waiting: list[tuple[Role, list[bytes], list[int]]] = []
        #: Why nothing comes, one sentence each.
        self.problems: tuple[str, ...] = ()

    def __enter__(self) -> LiveTopics:
        """Look for publishers."""
        self._listener = Listener(NODE_NAME, self._ros_args)
        self._node = self._listener.node
        self._look()
        self._listener.loop.call_every(LOOK_S, self._look)
        self._listener.start(self._take)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening."""
        self._listener.close()

    @property
    def n_lost(self) -> int:
        """Messages that were sent and did not get here."""
        return sum(one.n_lost for _, one in self._heard.values())

    def blocks(self, wait: Callable[[float], bool]) -> Iterator[News | None]:
        """
        Give what has come, and None after each time; to the last message.

        `wait` waits so long [s] and tells whether to end.
        """
        is_over = False
        while not is_over:
            is_over = wait(BLOCK_S)
            if is_over:
                self._listener.close()
            with self._lock:
                waiting, self._waiting = self._waiting, []
                feeds = {role: feed for role, (feed, _) in self._heard.items()}
            if waiting:
                topics = {role: feed.topic for role, feed in feeds.items()}
                for block in _blocks(feeds, waiting):
                    yield News(block, topics)
            yield None

    def _look(self) -> None:
        """Subscribe to what is published; say what is not."""
        problems: list[str] = []
        inputs = {'counts': VECTOR3_STAMPED, 'imu': IMU}
        names = {
            getattr(self._topics, key): kind
            for key, kind in inputs.items()
            if key == self._input or (self._input == 'auto' and self._is_possible(kind))
        }
        if not any(self._hear('accel', name, kind, problems) for name, kind in names.items()):
            listed = ' or '.join(map(self._node.resolve_topic_name, names))
            problems.append(f'nobody publishes {listed}')
        self._hear('board', self._topics.board, TEMPERATURE, problems)
        self._hear('case', self._topics.case, TEMPERATURE, problems)
        front = self._node.resolve_topic_name('temperature/name').removesuffix('name')
        further = {
            name.removeprefix(front): name
            for name, kinds_of in self._node.get_topic_names_and_types()
            if TEMPERATURE in kinds_of and name.startswith(front)
        }
        for name, topic in {**further, **self._topics.further}.items():
            if is_thermometer(name):
                self._hear(name, topic, TEMPERATURE, problems)
        self.problems = tuple(problems)

    def _is_possible(self, kind: str) -> bool:
        return 'accel' not in self._heard or self._heard['accel'][0].type == kind

    def _hear(self, role: Role, topic: str, kind: str, problems: list[str]) -> bool:
        """Subscribe to a topic if somebody publishes it; tell whether it is heard."""
        name = self._node.resolve_topic_name(topic)
        if role in self._heard:
            n_publishers = self._heard[role][1].count_publishers()
            if n_publishers != 1:
                problems.append(f'{n_publishers or "no"} publishers on {name}, expected one')
            return True
        offers = self._node.get_publishers_info_by_topic(name)
        if any(one.topic_type != kind for one in offers):
            problems.append(f'{name} has the type {offers[0].topic_type}, expected {kind}')
            return False
        if not offers:
            return False
        is_reliable = all(
            one.qos_profile.reliability == ReliabilityPolicy.RELIABLE for one in offers
        )
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_ALL,
            reliability=ReliabilityPolicy.RELIABLE
            if is_reliable
            else ReliabilityPolicy.BEST_EFFORT,
        )
        heard = self._listener.loop.subscribe(_CLASSES[kind], topic, qos, is_hot=role == 'accel')
        with self._lock:
            self._heard[role] = Feed(name, kind, 'cdr'), heard
        return True

    def _take(self) -> None:
        taken = [(role, *one.drain()) for role, (_, one) in self._heard.items()]
        with self._lock:
            self._waiting += [one for one in taken if one[1]]


def _blocks(
    feeds: Mapping[Role, Feed], waiting: Sequence[tuple[Role, list[bytes], list[int]]]
) -> Iterator[Block]:
    """Decode what came, in the order of arrival."""
    numbers = {role: number for number, role in enumerate(feeds)}
    data = [one for _, messages, _ in waiting for one in messages]
    messages = Messages.of(
        data,
        np.repeat([numbers[role] for role, _, _ in waiting], [len(one[1]) for one in waiting]),
        np.concatenate([np.array(received, np.int64) for _, _, received in waiting]),
    )
    names = list(dict.fromkeys((*ROLES[1:], *(role for role in feeds if role != 'accel'))))
    decoder = Decoder(feeds, {number: role for role, number in numbers.items()}, names, True)
    yield from decoder.blocks(messages.in_order())
