# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the step from the table of topics to rclpy: message classes, QoS profiles."""

from importlib import import_module
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ..topics import NodeTopic


def message_class(kind: str) -> Any:
    """Import the class of a type; ImportError, AttributeError or ValueError if it has none."""
    package, _, name = kind.partition('/msg/')
    return getattr(import_module(f'{package}.msg'), name)


def type_name(message_type: Any) -> str:
    """Name a message type as ROS tools and bags do."""
    return f'{message_type.__module__.partition(".")[0]}/msg/{message_type.__name__}'


def qos_of(topic: NodeTopic) -> QoSProfile:
    """Build the QoS profile of a topic of the node."""
    policy, durability = ReliabilityPolicy, DurabilityPolicy
    return QoSProfile(
        depth=topic.depth,
        reliability=policy.RELIABLE if topic.is_reliable else policy.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if topic.is_latched else durability.VOLATILE,
    )
