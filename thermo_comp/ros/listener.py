# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the node of `record`, which subscribes to live inputs and yields blocks of messages."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack

from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from ..errors import ThermoCompError
from ..recording.blocks import NO_STAMP_NS, Role, Topic, with_stamps
from ..recording.growing import News
from ..recording.serialized import Messages
from ..recording.topics import Topics, is_thermometer, split_field
from ..recording.wire import decode_blocks
from ..topics import SAMPLES, TEMPERATURE, thermometer
from .messages import LiveField, live_field, message_class
from .waitloop import RawSubscription, WaitLoop, separate_node

#: Interval of the search for publishers, and of the blocks of messages [s].
SEARCH_S, BLOCK_S = 0.5, 1.0

NODE_NAME = 'thermo_comp_record'
_AS_OFFERED = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.BEST_AVAILABLE
)


class LiveTopics:
    """Receives the input topics of the compensating node; subscribes to published topics only."""

    def __init__(self, topics: Topics, ros_args: Sequence[str] = ()) -> None:
        self._topics, self._ros_args = topics, ros_args
        self._inputs: dict[Role, RawSubscription] = {}
        #: Received messages: 'accel' or thermometer, messages, times of reception [ns].
        self._received: list[tuple[Role, list[bytes], list[int]]] = []
        self._feeds: dict[Role, Topic] = {}
        self._fields: dict[Role, LiveField] = {}
        self._last_ns = NO_STAMP_NS
        self.problems: tuple[str, ...] = ()  # reasons why topics have no messages, as texts

    def __enter__(self) -> LiveTopics:
        with ExitStack() as stack:
            self._node = stack.enter_context(separate_node(NODE_NAME, self._ros_args))
            self._loop = WaitLoop(self._node)
            self._find_topics()
            self._loop.call_every(SEARCH_S, self._find_topics)
            stack.callback(self._take)
            thread = threading.Thread(target=self._loop.run, args=[self._take], name=NODE_NAME)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._loop.stop)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop, take the last messages, destroy the node; a second call does nothing."""
        self._stack.close()

    def _take(self) -> None:
        for role, subscription in self._inputs.items():
            messages, received_ns, _ = subscription.drain()
            if messages:
                self._received.append((role, messages, received_ns))

    @property
    def n_lost(self) -> int:
        """Number of messages that were sent and not received."""
        return sum(topic.n_lost for topic in self._inputs.values())

    def blocks(self, wait: Callable[[float], bool]) -> Iterator[News | None]:
        """Yield received blocks and then None after each `wait`, until `wait` returns True."""
        is_over = False
        while not is_over:
            is_over = wait(BLOCK_S)
            if is_over:
                self._stack.close()
            waiting = self._received[:]
            # Delete only copied messages: the receiving thread may have appended others since.
            del self._received[: len(waiting)]
            if waiting:
                feeds = dict(self._feeds)  # a copy: the receiving thread may add a topic
                numbers = {role: number for number, role in enumerate(feeds)}
                channels = {role: {numbers[role]: topic} for role, topic in feeds.items()}
                messages = Messages.of(
                    [
                        message
                        for role, messages, _ in waiting
                        for message in self._readable(role, messages)
                    ],
                    [numbers[role] for role, messages, _ in waiting for _ in messages],
                    [stamp for _, _, received_ns in waiting for stamp in received_ns],
                ).in_order()
                for decoded in decode_blocks(messages, channels, {}, keep_raw=True):
                    block, self._last_ns = with_stamps(decoded, self._last_ns)
                    yield block, None
            yield None

    def _readable(self, role: Role, messages: list[bytes]) -> list[bytes]:
        field = self._fields.get(role)
        return messages if field is None else list(map(field.as_temperature, messages))

    def _find_topics(self) -> None:
        """Subscribe to the published topics; list in `problems` why topics are not received."""
        problems: list[str] = []
        resolved = self._node.resolve_topic_name
        chosen = self._feeds.get('accel')
        topics = {
            getattr(self._topics, key): usual.type
            for key, usual in SAMPLES.items()
            if self._topics.input in (key, 'auto')
            and (chosen is None or chosen.type == usual.type)
        }
        if not any(self._subscribe('accel', *topic, problems) for topic in topics.items()):
            problems.append(f'no publisher on {" or ".join(map(resolved, topics))}')
        front = resolved(thermometer('name')).removesuffix('name')
        further = {
            name.removeprefix(front): name
            for name, kinds in self._node.get_topic_names_and_types()
            if TEMPERATURE in kinds
            and name.startswith(front)
            and is_thermometer(name.removeprefix(front))
        }
        both = {'board': self._topics.board, 'case': self._topics.case}
        for name, topic in {**both, **further, **self._topics.further}.items():
            self._subscribe(name, topic, TEMPERATURE, problems)
        self.problems = tuple(problems)

    def _subscribe(self, role: Role, topic: str, kind: str, problems: list[str]) -> bool:
        """Subscribe to a topic that has a publisher; return whether the topic is subscribed."""
        name = self._node.resolve_topic_name(split_field(topic)[0])
        if role in self._inputs:
            n_publishers = self._inputs[role].count_publishers()
            if n_publishers != 1:
                problems.append(f'{n_publishers or "no"} publishers on {name}, expected one')
            return True
        offers = self._node.get_publishers_info_by_topic(name)
        try:
            field = live_field(self._node, topic) if kind == TEMPERATURE else None
        except ThermoCompError as error:
            problems.append(str(error))
            return False
        if field is not None:
            self._fields[role], self._feeds[role] = field, Topic(name, TEMPERATURE, 'cdr')
            self._inputs[role] = self._loop.subscribe(field.kind, name, _AS_OFFERED, wakes=False)
        elif any(offer.topic_type != kind for offer in offers):
            problems.append(f'{name} has the type {offers[0].topic_type}, expected {kind}')
        elif offers:
            self._feeds[role] = Topic(name, kind, 'cdr')
            self._inputs[role] = self._loop.subscribe(
                message_class(kind), topic, _AS_OFFERED, wakes=role == 'accel'
            )
        return role in self._inputs
