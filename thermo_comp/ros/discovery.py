# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns why a publisher that is there is not heard."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.subscription import Subscription


def mismatch(node: Node, subscription: Subscription) -> str:
    """
    Say what does not fit between a subscription that hears nobody and a publisher of its topic;
    empty where nobody publishes, or where all fits.
    """
    kind = subscription.msg_type
    package = kind.__module__.partition('.')[0]
    expected = f'{package}/msg/{kind.__name__}'
    for found in node.get_publishers_info_by_topic(subscription.topic_name):
        if found.topic_type != expected:
            return f'its type is {found.topic_type}, not {expected}'
        fit, reason = qos_check_compatible(found.qos_profile, subscription.qos_profile)
        if fit == QoSCompatibility.ERROR:
            said = reason.replace('ERROR: ', '').rstrip('; ')
            return f'{said} (qos_overrides.{subscription.topic_name}.subscription)'
    return ''
