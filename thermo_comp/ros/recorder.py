# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the recorder of the node's output: live topics into a bag that any rosbag2 tool opens.

The bag's log time is the stamp of an Imu, and for anything else the newest such stamp before it,
as in what `replay` writes; so a bag that was played faster than real time is recorded in its own
time, whatever the clock on the wall says meanwhile.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool

from ..errors import ThermoCompError
from ..online.stamped_flag import STAMPED_TOPIC
from ..recording import BagWriter
from .listener import Listener

NODE_NAME = 'thermo_comp_recorder'

#: The node's outputs.
OUTPUTS: Mapping[str, Any] = {
    'imu/data_raw': Imu,
    'regime/dynamic': Bool,
    STAMPED_TOPIC: DiagnosticArray,
}
_QOS = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
_STAMP = Struct('<iI')


class Recorder:
    """Records topics into a bag, in a thread of its own, for as long as the context lasts."""

    def __init__(
        self,
        path: str | Path,
        *,
        topics: Mapping[str, Any] = OUTPUTS,
        ros_args: Sequence[str] = (),
        overwrite: bool = False,
    ) -> None:
        self._path = Path(path)
        self._topics = topics
        self._ros_args = ros_args
        self._overwrite = overwrite
        self._changed = threading.Condition()
        self._counts = dict.fromkeys(topics, 0)
        self._failure: ThermoCompError | None = None
        self._newest: dict[str, bytes] = {}
        self._newest_ns: int | None = None
        # What came before any stamp.
        self._early: dict[str, list[bytes]] = {}

    def __enter__(self) -> Recorder:
        """Start recording."""
        self._writer = BagWriter(self._path, overwrite=self._overwrite)
        self._listener = Listener(NODE_NAME, self._ros_args)
        self._subscriptions = {
            name: self._listener.loop.subscribe(message_type, name, _QOS)
            for name, message_type in self._topics.items()
        }
        self._listener.start(self._take)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Stop; finish the bag, or drop it after an error."""
        self._listener.close()
        if kind is not None or self._failure is not None:
            self._writer.abort()
        else:
            self._writer.close()
        if kind is None and self._failure is not None:
            raise self._failure

    @property
    def counts(self) -> dict[str, int]:
        """Messages recorded so far, by the relative topic name."""
        with self._changed:
            return dict(self._counts)

    def newest(self, name: str) -> Any:
        """Return the newest message of a topic, be it recorded or not; None before any."""
        data = self._newest.get(name)
        return None if data is None else deserialize_message(data, self._topics[name])

    def wait_for_publishers(
        self, timeout_s: float, while_true: Callable[[], bool] = lambda: True
    ) -> bool:
        """Wait until every topic has a publisher; False after the time-out or at a False."""
        deadline = time.monotonic() + timeout_s
        ends = [one.subscription for one in self._subscriptions.values()]
        while not all(end.get_publisher_count() for end in ends):
            if time.monotonic() > deadline or not while_true():
                return False
            time.sleep(0.02)
        return True

    def wait_until(self, is_done: Callable[[Mapping[str, int]], bool], timeout_s: float) -> bool:
        """Wait until the counts are as wanted; False after the time-out [s]."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._failure is not None or is_done(self._counts), timeout_s
            )
            return self._failure is None and is_done(self._counts)

    def _take(self) -> None:
        """Write what has arrived, until that fails."""
        if self._failure is None:
            try:
                self._write()
            except ThermoCompError as error:
                with self._changed:
                    self._failure = error
                    self._changed.notify_all()

    def _write(self) -> None:
        new: dict[str, int] = {}
        for name, subscription in self._subscriptions.items():
            fresh, kind = subscription.drain()[0], self._topics[name]
            messages = self._early.pop(name, []) + fresh
            if not messages:
                continue
            if kind is Imu:
                stamps = np.array([_STAMP.unpack_from(data, 4) for data in messages], np.int64)
                log_ns = stamps @ (1_000_000_000, 1)
                self._newest_ns = int(log_ns[-1])
            elif self._newest_ns is not None:
                log_ns = np.full(len(messages), self._newest_ns)
            new[name] = 0
            if self._newest_ns is None:
                self._early[name] = messages
            else:
                self._writer.write_raw(name, _type_name(kind), log_ns, messages)
                new[name] = len(messages)
            self._newest[name] = messages[-1]
        if new:
            with self._changed:
                for name, n_messages in new.items():
                    self._counts[name] += n_messages
                self._changed.notify_all()


def _type_name(message_type: Any) -> str:
    return f'{message_type.__module__.split(".")[0]}/msg/{message_type.__name__}'
