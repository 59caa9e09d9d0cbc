# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns rclpy's message classes and QoS profiles by name, and the reading of numbers from messages.

A temperature may be a number in a message of any type. The class of a message is imported at run
time, because this package does not depend on the packages of drivers' messages.
"""

import re
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Temperature

from ..errors import ThermoCompError
from ..recording.blocks import NO_STAMP_NS
from ..recording.topics import PLAIN, split_field
from ..topics import NodeTopic

_STEP = re.compile(r'([A-Za-z]\w*)|\[([0-9]{1,6})\]|\.')


def message_class(kind: str) -> Any:
    """Import a message class by its type; ImportError, AttributeError, ValueError if missing."""
    package, _, name = kind.partition('/msg/')
    return getattr(import_module(f'{package}.msg'), name)


def qos_of(topic: NodeTopic) -> QoSProfile:
    """Build the QoS profile of a topic of the node."""
    policy, durability = ReliabilityPolicy, DurabilityPolicy
    return QoSProfile(
        depth=topic.depth,
        reliability=policy.RELIABLE if topic.is_reliable else policy.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if topic.is_latched else durability.VOLATILE,
    )


class LiveField:
    """A numeric field in the messages of a topic; ThermoCompError if type or field is missing."""

    def __init__(self, topic: str, kind: str, path: str) -> None:
        try:
            self.kind = message_class(kind)
        except (ImportError, AttributeError, ValueError) as error:
            reason = f'its type {kind} is not installed here'
            raise ThermoCompError(reason, key=topic) from error
        self._steps: Sequence[Any] = [
            name or int(place) for name, place in _STEP.findall(path) if name or place
        ]
        try:
            self._value(self.kind())
        except IndexError:
            pass  # the field is in a sequence, which is empty in a new message
        except (AttributeError, TypeError, ValueError) as error:
            raise ThermoCompError(f'{kind} has no number `{path}`', key=topic) from error

    def _value(self, message: Any) -> float:
        for step in self._steps:
            message = message[step] if isinstance(step, int) else getattr(message, step)
        return float(message)

    def read(self, data: bytes) -> tuple[int, float] | None:
        """Read stamp [ns] (`NO_STAMP_NS` without a header) and number; None if unreadable."""
        try:
            message = deserialize_message(data, self.kind)
            header = getattr(message, 'header', None)
            # Some types have a special header that contains a std_msgs/Header.
            stamp = getattr(getattr(header, 'header', header), 'stamp', None)
            value = self._value(message)
        except (RuntimeError, ValueError, IndexError):
            return None
        if stamp is None:
            return NO_STAMP_NS, value
        return stamp.sec * 1_000_000_000 + stamp.nanosec, value

    def as_temperature(self, data: bytes) -> bytes:
        """Serialize the reading of a message as a Temperature; NaN without a reading."""
        stamp_ns, value = self.read(data) or (NO_STAMP_NS, float('nan'))
        message = Temperature(temperature=value)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        return bytes(serialize_message(message))


def live_field(node: Node, topic: str) -> LiveField | None:
    """Return the field of ``TOPIC[:FIELD]``; None without a publisher or a known field."""
    name, path = split_field(topic)
    name = node.resolve_topic_name(name)
    offers = node.get_publishers_info_by_topic(name)
    if not offers:
        return None
    kind = offers[0].topic_type
    path = path or PLAIN.get(kind, '')
    return LiveField(name, kind, path) if path else None
