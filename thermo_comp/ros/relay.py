# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the processing of samples in the node in order of arrival, whenever the loop wakes up.

Messages do not identify their publisher. While several publishers may send on a topic, the topic's
messages are dropped, as is the first batch of messages after all publishers but one have left.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from operator import itemgetter

from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Imu, Temperature

from ..errors import ThermoCompError
from ..online.compensator import Compensator
from ..online.segments import Model
from ..recording.blocks import NO_STAMP_NS
from ..recording.topics import TWINS, split_field
from ..topics import BOARD, FLAGS, IMU_OUT, SAMPLES, TEMPERATURE, thermometer
from .conversion import SampleConverter, Traffic, read_temperature
from .messages import LiveField, live_field, message_class, qos_of
from .parameters import NodeConfig, named_topics
from .reader import LoadedCalibration
from .rest_log import BLOCK, RestKeeper
from .waitloop import RawSubscription, RCLError, WaitLoop

#: Without samples, a reading is used once a reading with a stamp later by this time [ns] has come.
IDLE_NS = 1_000_000_000

_SECOND = slice(4, 8)  # bytes of a CDR message that hold the seconds of its stamp

# A received temperature: time of reception [ns]; thermometer, stamp [ns], degC.
_Reading = tuple[int, tuple[str, int, float]]


@dataclass(frozen=True, slots=True)
class Running:
    """All objects that a change of calibration or parameters replaces, between two samples."""

    loaded: LoadedCalibration
    config: NodeConfig
    compensator: Compensator
    samples: RawSubscription
    converter: SampleConverter


class Relay:
    """Connects the inputs of a node with its outputs."""

    def __init__(
        self,
        loop: WaitLoop,
        loaded: LoadedCalibration,
        compensator: Compensator,
        config: NodeConfig,
    ) -> None:
        self._loop, self._names = loop, named_topics(config.topics)
        self.traffic = Traffic()
        samples = self._open_samples(config)
        self.running = Running(loaded, config, compensator, samples, self._converter(config))
        #: Subscription of each thermometer, and the field of its messages with the temperature.
        self.thermometers: dict[str, RawSubscription] = {}
        self._fields: dict[str, LiveField] = {}
        for name in compensator.thermal.inputs:
            topic = split_field(self._topic(name))[0]
            self._subscribe(name, topic, LiveField(topic, TEMPERATURE, 'temperature'))
        self._problems: set[str] = set()
        output = self._names.get('output', IMU_OUT.name)
        self._check_topics(loop.node.resolve_topic_name(output))
        imu = loop.publisher(Imu, output, qos_of(IMU_OUT))
        self._publish: Callable[[bytes], None] = imu.handle.publish_raw
        self.output_topic: str = imu.topic_name
        self._flags = [
            (loop.publisher(message_class(flag.type), flag.name, qos_of(flag)).publish, pack)
            for flag, pack in FLAGS.items()
        ]
        self.rests = RestKeeper(config.rest_log) if config.rest_log else None
        #: Samples that the rest log has not summed yet, or None without a rest log.
        self.waiting: list[bytes] | None = [] if self.rests else None
        self._second = b''  # the `_SECOND` bytes of the last message in `waiting`
        self._readings: list[_Reading] = []
        self._newest_reading_ns: int | None = None

    def _topic(self, name: str) -> str:
        """Return a thermometer's topic, with the field if the parameter `topics` names one."""
        usual = thermometer(name)
        return self._names.get(name, self._names.get(usual, usual))

    def _check_topics(self, output: str) -> None:
        """Refuse two thermometers in one field of a topic, and an output on the input's topic."""
        roles: dict[tuple[str, str], str] = {}
        for name, raw in self.thermometers.items():
            topic = raw.subscription.topic_name
            twin = roles.setdefault((topic, split_field(self._topic(name))[1]), name)
            if twin != name:
                raise ThermoCompError(TWINS.format(twin, name), key=topic)
        if self.running.samples.subscription.topic_name == output:
            reason = f'is both input and output: remap {IMU_OUT.name} to another name'
            raise ThermoCompError(reason, key=output)

    def follow_types(self) -> None:
        """Subscribe to a thermometer with the type that it publishes, if not Temperature."""
        for name, raw in list(self.thermometers.items()):
            if self._fields[name].kind is not Temperature or raw.count_publishers():
                continue
            try:
                field = live_field(self._loop.node, self._topic(name))
            except ThermoCompError as error:
                if str(error) not in self._problems:
                    self._problems.add(str(error))
                    self._loop.node.get_logger().error(str(error))
                continue
            if field is not None:
                topic = raw.subscription.topic_name
                self._loop.unsubscribe(self.thermometers.pop(name))
                # The middleware allows one type per topic: the loop must release the old
                # subscription first.
                self._loop.call_soon(partial(self._subscribe, name, topic, field))

    def _subscribe(self, name: str, topic: str, field: LiveField) -> None:
        self._fields[name] = field
        subscribe = self._loop.subscribe
        self.thermometers[name] = subscribe(field.kind, topic, qos_of(BOARD), wakes=False)

    @property
    def inputs(self) -> dict[str, RawSubscription]:
        """Subscriptions by their names in the diagnostics: samples first, then thermometers."""
        return {'sample': self.running.samples, **self.thermometers}

    def _open_samples(self, config: NodeConfig) -> RawSubscription:
        usual = SAMPLES[config.input]
        name = self._names.get(config.input, usual.name)
        return self._loop.subscribe(message_class(usual.type), name, qos_of(usual))

    def _converter(self, config: NodeConfig) -> SampleConverter:
        return SampleConverter(
            message_class(SAMPLES[config.input].type), config.frame_id, self.traffic
        )

    def successor(self, loaded: LoadedCalibration, model: Model, config: NodeConfig) -> Running:
        """Build the next `Running`; the present `Running` does not change."""
        present, settings = self.running, config.compensator_config()
        compensator, converter, samples = present.compensator, present.converter, present.samples
        if model is not compensator.thermal.model or settings != compensator.config:
            compensator = compensator.successor(model, settings)
        if (config.input, config.frame_id) != (present.config.input, present.config.frame_id):
            converter = self._converter(config)
        if config.input != present.config.input:
            samples = self._open_samples(config)
        return Running(loaded, config, compensator, samples, converter)

    def release(self, samples: RawSubscription) -> None:
        """Destroy a subscription to samples, unless it is in use."""
        if samples is not self.running.samples:
            self._loop.unsubscribe(samples)

    def on_data(self) -> None:
        """Process all samples and readings that have arrived."""
        messages, received_ns, n_others = self.running.samples.drain_single_source()
        for name, subscription in self.thermometers.items():
            readings, read_ns, n_more = subscription.drain_single_source()
            n_others += n_more
            if readings:
                self._take_readings(name, readings, read_ns)
        self.traffic.n_contested += n_others
        if not messages:
            return
        if self._readings:
            messages = self._relay_with_readings(messages, received_ns)
        self._relay(messages)

    def gather(self) -> None:
        """Sum the samples since the last call, for the rest log."""
        rests, waiting = self.rests, self.waiting
        if rests is not None and waiting:
            messages = waiting.copy()
            waiting.clear()
            rests.gather(messages, self.running.loaded, self.running.compensator)

    def advance_without_samples(self, silence_ns: int) -> None:
        """Use temperatures while no samples arrive, so that regime flags are still published."""
        if self._newest_reading_ns is None:
            return
        horizon_ns, compensator = self._newest_reading_ns - IDLE_NS, self.running.compensator
        if (last_ns := compensator.now_ns) is not None:
            horizon_ns = min(horizon_ns, last_ns + silence_ns)
        readings, self._readings = self._readings, []
        for received, reading in readings:
            if reading[1] == NO_STAMP_NS:
                continue  # a reading without a stamp gets its time from a sample
            if reading[1] <= horizon_ns:
                compensator.push(*reading)
            else:
                self._readings.append((received, reading))
        compensator.flush(horizon_ns)
        self._publish_flags()

    def _take_readings(self, name: str, messages: list[bytes], received_ns: list[int]) -> None:
        field = self._fields[name]
        read = read_temperature if field.kind is Temperature else field.read
        for data, received in zip(messages, received_ns, strict=True):
            reading = read(data)
            if reading is None:
                self.traffic.n_malformed += 1
            else:
                if reading[0] != NO_STAMP_NS:
                    self._newest_reading_ns = reading[0]
                self._readings.append((received, (name, *reading)))

    def _relay_with_readings(self, messages: list[bytes], received_ns: list[int]) -> list[bytes]:
        """Relay data in order of arrival; return the samples after the last reading."""
        start, push = 0, self.running.compensator.push
        self._readings.sort(key=itemgetter(0))
        n = bisect_right(self._readings, received_ns[-1], key=itemgetter(0))
        readings, self._readings = self._readings[:n], self._readings[n:]
        for received, reading in readings:
            end = bisect_left(received_ns, received, start)
            self._relay(messages[start:end])
            name, stamp_ns, celsius = reading
            at_ns = stamp_ns if stamp_ns != NO_STAMP_NS else self.running.compensator.now_ns
            if at_ns is not None:
                push(name, at_ns, celsius)
            start = end
        return messages[start:]

    def _relay(self, messages: list[bytes]) -> None:
        waiting = self.waiting
        if waiting is None:
            self._correct(messages)
            return
        # The rest log needs the thermal state after the last sample of each second, by the stamps.
        for second, run in groupby(messages, key=itemgetter(_SECOND)):
            if second != self._second or len(waiting) >= BLOCK:
                self.gather()
            part, self._second = list(run), second
            self._correct(part)
            waiting += part

    def _correct(self, messages: list[bytes]) -> None:
        compensator = self.running.compensator
        convert, process = self.running.converter.convert, compensator.process
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
        compensator = self.running.compensator
        for stamp_ns, is_dynamic in compensator.take_flags():
            serial = compensator.calibration.unit.serial
            try:
                for publish, pack in self._flags:
                    publish(pack(stamp_ns, is_dynamic, serial))
            except RCLError:
                self._count_unpublished()
            self.traffic.n_flags += 1

    def _count_unpublished(self) -> None:
        """Count a message that the middleware refused; raise an error if ROS has shut down."""
        if not self._loop.node.context.ok():
            raise ExternalShutdownException
        self.traffic.n_unpublished += 1
