# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way of the samples through the node: in the order of arrival, compensated, published.

A wake-up takes what has arrived of all inputs, samples first, and works through it in the order
of arrival. So it does not matter how the wake-ups fell.

An input has one source. A message does not tell whose it is, so while there are two nothing of
that input is used, nor the first messages after it, which may still be of the one that left.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from operator import itemgetter

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool

from ..online.compensator import Compensator
from ..online.stamped_flag import STAMPED_TOPIC, stamped_flag
from .conversions import SampleConverter, Traffic, read_temperature
from .parameters import NodeConfig
from .waitloop import RawSubscription, RCLError, WaitLoop

INPUTS = {'counts': (Vector3Stamped, 'accel/counts'), 'imu': (Imu, 'imu/uncompensated')}
#: As many samples as may wait for one wake-up, in and out: 0.2 s at 10 kHz.
SAMPLE_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
TEMPERATURE_QOS = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=2000)
FLAG_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

#: Without samples, readings take effect but for those not older than the newest by this [ns]: a
#: sample that Fast DDS has to repeat can be 3 s late.
IDLE_NS = 1_000_000_000

# A temperature that has arrived: received [ns]; of which thermometer, stamp [ns], degC.
_Reading = tuple[int, tuple[str, int, float]]


class Relay:
    """What stands between the inputs of a node and its outputs."""

    def __init__(
        self, node: Node, loop: WaitLoop, compensator: Compensator, config: NodeConfig
    ) -> None:
        self._node, self._loop, self._compensator = node, loop, compensator
        self.traffic = Traffic()
        self.samples = self.open_samples(config)
        self.configure(config, self.samples)
        #: By their names.
        self.thermometers = {
            name: loop.subscribe(Temperature, f'temperature/{name}', TEMPERATURE_QOS, is_hot=False)
            for name in compensator.thermal.inputs
        }
        imu = loop.publisher(Imu, 'imu/data_raw', OUTPUT_QOS)
        self._publish: Callable[[bytes], None] = imu.handle.publish_raw
        self._flag = loop.publisher(Bool, 'regime/dynamic', FLAG_QOS)
        self._stamped = loop.publisher(DiagnosticArray, STAMPED_TOPIC, FLAG_QOS)
        self._readings: list[_Reading] = []
        self._newest_reading_ns: int | None = None
        self._contested: set[RawSubscription] = set()

    @property
    def inputs(self) -> dict[str, RawSubscription]:
        """The samples, then the readings, by their names in the diagnostics."""
        return {'sample': self.samples, **self.thermometers}

    def open_samples(self, config: NodeConfig) -> RawSubscription:
        """Subscribe to the samples of a configuration."""
        return self._loop.subscribe(*INPUTS[config.input], SAMPLE_QOS)

    def configure(self, config: NodeConfig, samples: RawSubscription) -> None:
        """Go over to a configuration and the samples that were opened for it."""
        if samples is not self.samples:
            self._loop.unsubscribe(self.samples)
        self.samples = samples
        self.converter = SampleConverter(INPUTS[config.input][0], config.frame_id, self.traffic)

    def on_data(self) -> None:
        """Work through everything that has arrived."""
        messages, received_ns = self.samples.drain()
        for name, subscription in self.thermometers.items():
            readings, read_ns = subscription.drain()
            if readings and self._is_of_one(subscription, len(readings)):
                self._take_readings(name, readings, read_ns)
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
        self.traffic.n_contested += n
        return False

    def advance_without_samples(self, silence_ns: int) -> None:
        """Let readings take effect without samples, so that the flag stays alive."""
        if self._newest_reading_ns is None:
            return
        horizon_ns = self._newest_reading_ns - IDLE_NS
        last_ns = self._compensator.now_ns
        if last_ns is not None:
            # None is newer than the last sample by much more, whatever its stamp says.
            horizon_ns = min(horizon_ns, last_ns + silence_ns)
        readings, self._readings = self._readings, []
        for received, reading in readings:
            if reading[1] <= horizon_ns:
                self._compensator.push(*reading)
            else:
                self._readings.append((received, reading))
        self._compensator.flush(horizon_ns)
        self._publish_flags()

    def _take_readings(self, name: str, messages: list[bytes], received_ns: list[int]) -> None:
        for data, received in zip(messages, received_ns, strict=True):
            reading = read_temperature(data)
            if reading is None:
                self.traffic.n_malformed += 1
            else:
                self._newest_reading_ns = reading[0]
                self._readings.append((received, (name, *reading)))

    def _relay_with_readings(self, messages: list[bytes], received_ns: list[int]) -> list[bytes]:
        """Relay up to the last reading that came before the last sample; return the rest."""
        start = 0
        self._readings.sort(key=itemgetter(0))
        n = bisect_right(self._readings, received_ns[-1], key=itemgetter(0))
        readings, self._readings = self._readings[:n], self._readings[n:]
        for received, reading in readings:
            end = bisect_left(received_ns, received, start)
            self._relay(messages[start:end])
            self._compensator.push(*reading)
            start = end
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
                self._flag.publish(Bool(data=is_dynamic))
                self._stamped.publish(stamped_flag(stamp_ns, is_dynamic, serial))
            except RCLError:
                self._count_unpublished()
            self.traffic.n_flags += 1

    def _count_unpublished(self) -> None:
        """Go on after a message that the middleware did not take, but not after the shutdown."""
        if not self._node.context.ok():
            raise ExternalShutdownException
        self.traffic.n_unpublished += 1
