# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what a bag says of its topics beside their messages: type definitions and QoS profiles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from ..errors import RecordingError
from .topics import BOOL

_INFINITE = {'sec': 9223372036, 'nsec': 854775807}


@dataclass(frozen=True, slots=True)
class Definition:
    """
    A message type's definition.

    Attributes
    ----------
    encoding : str
        ``ros2msg`` or ``ros2idl``.
    text : str
        The definition with all that it depends on.
    type_hash : str
        REP 2016 hash (RIHS01), empty where it is not known.

    """

    encoding: str
    text: str
    type_hash: str


@lru_cache(maxsize=1)
def _typestore() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=64)
def known_definition(kind: str) -> Definition:
    """
    Look up a message type of ROS 2 Jazzy.

    Parameters
    ----------
    kind : str
        E.g. ``sensor_msgs/msg/Imu``.

    Raises
    ------
    RecordingError
        A type that ROS 2 Jazzy does not have.

    """
    typestore = _typestore()
    if kind not in typestore.fielddefs:
        raise RecordingError(f'the definition of message type {kind} is not known')
    text, _ = typestore.generate_msgdef(kind, ros_version=2)
    return Definition('ros2msg', text, typestore.hash_rihs01(kind))


def offered_qos(kind: str) -> dict[str, Any]:
    """
    QoS profile that is recorded as offered for a topic.

    Parameters
    ----------
    kind : str
        Message type.

    Returns
    -------
    dict
        In the form of rosbag2's metadata version 9. Reliable, so that any reader matches; flags
        (std_msgs/Bool) are transient local with depth 1: a late reader gets the last one.

    """
    is_flag = kind == BOOL
    return {
        'history': 'keep_last',
        'depth': 1 if is_flag else 10,
        'reliability': 'reliable',
        'durability': 'transient_local' if is_flag else 'volatile',
        'deadline': dict(_INFINITE),
        'lifespan': dict(_INFINITE),
        'liveliness': 'automatic',
        'liveliness_lease_duration': dict(_INFINITE),
        'avoid_ros_namespace_conventions': False,
    }
