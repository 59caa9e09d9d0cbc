# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns topics in serialized form: what the loop's caller reads from and writes to, without rclpy's
conversion of messages.

Beyond the documented API: the methods `take_message` and `get_publisher_count` of the handle (and
`publish_raw` in `relay.py`); `test/test_waitloop.py` fails when any of them changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription

#: The most messages taken in one go, so that a flood cannot keep the rest of the node waiting.
DRAIN_LIMIT = 4096


class RawSubscription:
    """A subscription of `WaitLoop.subscribe`, read by whoever runs the loop."""

    def __init__(self, subscription: Subscription) -> None:
        self.subscription = subscription
        #: Whether messages that did not arrive are not sent again.
        self.is_best_effort = subscription.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
        self._message_type = subscription.msg_type
        self._take: Callable[[Any, bool], Any] = subscription.handle.take_message
        #: How many publishers the middleware has found; cheap, to be asked while the loop runs.
        self.count_publishers: Callable[[], int] = subscription.handle.get_publisher_count
        self._sequence: int | None = None
        self._newest_ns = 0
        #: Messages that were sent and did not get here, as far as one publisher numbers them.
        self.n_lost = 0
        #: What lay between the last two messages, on average over one drain [ns].
        self.interval_ns = 0

    def drain(self, *, is_paced: bool = False) -> tuple[list[bytes], list[int]]:
        """
        Take at most `DRAIN_LIMIT` waiting messages, oldest first, and when each was received [ns].

        Paced, it does not look for another message before its turn, going by the last two: one
        that comes early is there at the next wake-up.
        """
        messages: list[bytes] = []
        received_ns: list[int] = []
        take, message_type = self._take, self._message_type
        taken = take(message_type, True)
        if taken is None:
            return messages, received_ns
        before_ns = newest_ns = self._newest_ns
        while taken is not None:
            message, info = taken
            messages.append(message)
            received = info['received_timestamp']
            received_ns.append(received)
            interval_ns, newest_ns = received - newest_ns, received
            is_early = is_paced and time.time_ns() - received < interval_ns
            if is_early or len(messages) == DRAIN_LIMIT:
                break
            taken = take(message_type, True)
        self._newest_ns = newest_ns
        self.interval_ns = (newest_ns - before_ns) // len(messages)
        self._count_lost(info['publication_sequence_number'], len(messages))
        return messages, received_ns

    def _count_lost(self, sequence: int | None, n_taken: int) -> None:
        before, self._sequence = self._sequence, sequence
        if before is not None and sequence is not None:
            # Another publisher's numbers can go back.
            self.n_lost += max(0, sequence - before - n_taken)
