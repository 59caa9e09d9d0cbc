# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way of the samples through the node: in the order of arrival, compensated, published.

A wake-up takes what has arrived of all three inputs, samples first, and works through it in the
order of arrival. So it does not matter how the wake-ups fell.

An input has one source. A message does not tell whose it is, so while there are two nothing of
that input is used, nor the first messages after it, which may still be of the one that left.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence

from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool

from ..online.compensator import Compensator
from ..online.stamped_flag import stamped_flag
from .conversions import SampleConverter, read_temperature
from .waitloop import RawSubscription, RCLError

#: Without samples, readings take effect but for those not older than the newest by this [ns]: a
#: sample that Fast DDS has to repeat can be 3 s late.
IDLE_NS = 1_000_000_000

#: The two messages of the flag, serialized.
_FLAGS: list[bytes] = [serialize_message(Bool(data=is_dynamic)) for is_dynamic in (False, True)]

#: Takes a temperature: stamp [ns] and degC.
Push = Callable[[int, float], None]

# A temperature that has arrived: received [ns], stamp [ns], degC, and where it goes.
_Reading = tuple[int, int, float, Push]


class Relay:
    """What stands between inputs and outputs; each thermometer comes with who takes it."""

    def __init__(
        self,
        node: Node,
        compensator: Compensator,
        converter: SampleConverter,
        samples: RawSubscription,
        temperatures: Sequence[tuple[RawSubscription, Push]],
        imu: Publisher,
        flag: Publisher,
        stamped: Publisher,
    ) -> None:
        self._node = node
        self._compensator = compensator
        #: May be exchanged between two wake-ups, and so may `samples`.
        self.converter = converter
        self.samples = samples
        self._temperatures: list[tuple[RawSubscription, Push]] = list(temperatures)
        self._publish: Callable[[bytes], None] = imu.handle.publish_raw
        self._publish_flag, self._publish_stamped = flag.publish, stamped.publish
        self._readings: list[_Reading] = []
        self._newest_reading_ns: int | None = None
        self._traffic = converter.traffic
        self._contested: set[RawSubscription] = set()

    @property
    def inputs(self) -> list[RawSubscription]:
        """The samples and the readings, in the order in which they were given."""
        return [self.samples, *[subscription for subscription, _ in self._temperatures]]

    def on_data(self) -> None:
        """Work through everything that has arrived."""
        messages, received_ns = self.samples.drain()
        for subscription, push in self._temperatures:
            readings, read_ns = subscription.drain()
            if readings and self._is_of_one(subscription, len(readings)):
                self._take_readings(readings, read_ns, push)
        if not messages or not self._is_of_one(self.samples, len(messages)):
            return
        if self._readings:
            messages = self._relay_with_readings(messages, received_ns)
        self._relay(messages)

    def _is_of_one(self, subscription: RawSubscription, n: int) -> bool:
        """Tell whether messages are of an input's only publisher; count them if not."""
        was_contested = subscription in self._contested
        if subscription.count_publishers() > 1:
            self._contested.add(subscription)
        elif was_contested:
            self._contested.remove(subscription)
        else:
            return True
        self._traffic.n_contested += n
        return False

    def advance_without_samples(self, silence_ns: int) -> None:
        """
        Let readings take effect without samples, so that the flag stays alive.

        After so long a silence none is newer than the last one by much more, whatever its stamp
        says.
        """
        if self._newest_reading_ns is None:
            return
        horizon_ns = self._newest_reading_ns - IDLE_NS
        last_ns = self._compensator.now_ns
        if last_ns is not None:
            horizon_ns = min(horizon_ns, last_ns + silence_ns)
        for _, stamp_ns, celsius, push in self._readings:
            if stamp_ns <= horizon_ns:
                push(stamp_ns, celsius)
        self._readings = [one for one in self._readings if one[1] > horizon_ns]
        self._compensator.flush(horizon_ns)
        self._publish_flags()

    def _take_readings(self, messages: list[bytes], received_ns: list[int], push: Push) -> None:
        for data, received in zip(messages, received_ns, strict=True):
            reading = read_temperature(data)
            if reading is None:
                self._traffic.n_malformed += 1
            else:
                stamp_ns, celsius = reading
                self._newest_reading_ns = stamp_ns
                self._readings.append((received, stamp_ns, celsius, push))

    def _relay_with_readings(self, messages: list[bytes], received_ns: list[int]) -> list[bytes]:
        """Relay up to the last reading that came before the last sample; return the rest."""
        start = 0
        later: list[_Reading] = []
        for reading in sorted(self._readings, key=lambda one: one[0]):
            received, stamp_ns, celsius, push = reading
            if received > received_ns[-1]:
                later.append(reading)
                continue
            end = bisect_left(received_ns, received, start)
            self._relay(messages[start:end])
            push(stamp_ns, celsius)
            start = end
        self._readings = later
        return messages[start:]

    def _relay(self, messages: list[bytes]) -> None:
        compensator = self._compensator
        convert, process = self.converter.convert, compensator.process
        correct_rate = compensator.correct_rate if compensator.corrects_rate else None
        for data in messages:
            frame = convert(data, process, correct_rate)
            if frame is not None:
                try:
                    self._publish(frame)
                except RCLError:
                    self._count_unpublished()
        self._publish_flags()

    def _publish_flags(self) -> None:
        for stamp_ns, is_dynamic in self._compensator.take_flags():
            serial = self._compensator.calibration.unit.serial
            try:
                self._publish_flag(_FLAGS[is_dynamic])
                self._publish_stamped(stamped_flag(stamp_ns, is_dynamic, serial))
            except RCLError:
                self._count_unpublished()
            self._traffic.n_flags += 1

    def _count_unpublished(self) -> None:
        """Go on after a message that the middleware did not take, but not after the shutdown."""
        if not self._node.context.ok():
            raise ExternalShutdownException
        self._traffic.n_unpublished += 1
