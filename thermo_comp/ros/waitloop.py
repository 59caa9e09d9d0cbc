# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the loop around a node's wait sets, and all uses of rclpy beyond its documented API.

rclpy's executor takes ten times the CPU time of the compensation. `WaitLoop` leaves messages
serialized. While samples arrive, the loop waits only for samples, and each wake-up empties their
queue; services and ordinary subscriptions are polled. Timers, clients and middleware events are
not served by this loop.

Undocumented parts of rclpy in use: `rclpy.impl.implementation_singleton` (`WaitSet`), the methods
`take_message`, `get_publisher_count`, `service_take_request` and `publish_raw` of handles, and the
node's `_parameter_overrides`, all of them tested by `test/test_waitloop.py`.
"""

import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from copy import copy
from functools import partial
from typing import Any

import rclpy
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node, Publisher, Service, Subscription
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions

from ..errors import ThermoCompError
from ..text import one_line

#: While samples arrive: polling period of services and of subscriptions to other messages [ns].
OTHERS_PERIOD_NS = 20_000_000
#: Largest number of messages taken at a time, so that a flood does not block the rest of the node.
DRAIN_LIMIT = 4096

#: A time that is never reached [ns]; longest wait [ns], as huge waits overflow in the middleware.
_NEVER_NS, _LONGEST_WAIT_NS = 1 << 62, 3600 * 10**9

#: Shortest time between two logged failures [ns].
_LOG_PERIOD_NS = 10 * 10**9

#: Duration [ns] and number of messages with consecutive numbers that prove a single publisher.
ALONE_NS, ALONE_MESSAGES = 10**9, 5

_KINDS = {Subscription: 'subscription', Service: 'service', GuardCondition: 'guard_condition'}

RCLError = rclpy_implementation.RCLError

#: Serves a request; calls the given function with the answer, now or later, in the loop's thread.
Serve = Callable[[Any, Callable[[Any], None]], None]


class Sources:
    """
    Decides whether the messages of a topic with several publishers come from only one of them.

    The middleware lists a killed publisher until its lease of 20 s ends. Messages do not
    identify their publisher, but each publisher numbers its messages, so consecutive numbers over
    a long enough time come from one publisher.
    """

    def __init__(self) -> None:
        self._n_known = 0
        self._number: int | None = None
        self._n_in_row, self._since_ns = 0, 0
        #: Whether the messages may be from several publishers.
        self.is_contested = False

    def first_of_single_source(
        self, n_known: int, numbers: Sequence[int | None], received_ns: Sequence[int]
    ) -> int:
        """Return the index from which all messages surely come from the only active publisher."""
        was_contested, n_before, self._n_known = self.is_contested, self._n_known, n_known
        if n_known <= 1:
            # The first messages taken after a publisher has left may be from this publisher.
            self.is_contested, self._number = False, numbers[-1]
            return len(numbers) if was_contested else 0
        if n_known > n_before:
            # With a new publisher, the next message may come from any of the publishers.
            self._begin(None, 0)
        first = 0
        for place, (number, at_ns) in enumerate(zip(numbers, received_ns, strict=True)):
            if number is None or self._number is None or number != self._number + 1:
                self._begin(number, at_ns)
            else:
                self._number = number
                self._n_in_row += 1
                is_long = at_ns - self._since_ns >= ALONE_NS
                if self.is_contested and is_long and self._n_in_row >= ALONE_MESSAGES:
                    self.is_contested = False
            if self.is_contested:
                first = place + 1
        return first

    def _begin(self, number: int | None, at_ns: int) -> None:
        self._number, self._since_ns = number, at_ns
        self._n_in_row, self.is_contested = 1, True


class RawSubscription:
    """A subscription made by `WaitLoop.subscribe`, to be read in the loop's thread."""

    def __init__(self, subscription: Subscription, wakes: bool) -> None:
        self.subscription = subscription
        self.wakes = wakes
        self.sources = Sources()
        self._take = partial(subscription.handle.take_message, subscription.msg_type, True)
        #: Number of publishers that the middleware has discovered; cheap enough for each wake-up.
        self.count_publishers: Callable[[], int] = subscription.handle.get_publisher_count
        self._sequence: int | None = None
        self._newest_ns = 0
        #: Number of messages that were sent but not received, from gaps in the sequence numbers.
        self.n_lost = 0
        #: Mean interval between the messages that the last `drain` took [ns].
        self.interval_ns = 0

    def drain_single_source(self) -> tuple[list[bytes], list[int], int]:
        """Like `drain`; drop and count messages that may come from more than one publisher."""
        messages, received_ns, numbers = self.drain()
        if not messages:
            return messages, received_ns, 0
        first = self.sources.first_of_single_source(self.count_publishers(), numbers, received_ns)
        return messages[first:], received_ns[first:], first

    def drain(self) -> tuple[list[bytes], list[int], list[int | None]]:
        """Take waiting messages, oldest first, with arrival times [ns] and sequence numbers."""
        messages: list[bytes] = []
        received_ns: list[int] = []
        numbers: list[int | None] = []
        take, taken = self._take, self._take()
        if taken is None:
            return messages, received_ns, numbers
        while taken is not None:
            message, info = taken
            messages.append(message)
            received_ns.append(info['received_timestamp'])
            numbers.append(info['publication_sequence_number'])
            taken = take() if len(messages) < DRAIN_LIMIT else None
        before_ns, self._newest_ns = self._newest_ns, received_ns[-1]
        self.interval_ns = (self._newest_ns - before_ns) // len(messages)
        before, self._sequence = self._sequence, numbers[-1]
        if before is not None and self._sequence is not None:
            # A falling sequence number comes from another publisher: no message is lost.
            self.n_lost += max(0, self._sequence - before - len(messages))
        return messages, received_ns, numbers


class WaitLoop:
    """Runs a node without an executor; the caller takes the messages of raw subscriptions."""

    # `pause_s`: pause after each wake-up by best-effort messages [s], if the mean interval between
    # messages is below three quarters of the pause.
    def __init__(self, node: Node, pause_s: float = 0.0) -> None:
        self.node = node
        self._pause_ns = int(pause_s * 1e9)
        self._guard = node.create_guard_condition(lambda: None)
        self._raw: list[RawSubscription] = []
        #: Handlers of services; a handler may return before the answer is sent.
        self.handlers: dict[Service, Serve] = {}
        self._soon: deque[Callable[[], None]] = deque()
        self.n_failures = 0  # callbacks that ended in an exception
        self._logged_ns = -_LOG_PERIOD_NS
        self._is_stopping, self._is_stale = False, True
        self._period_ns = self._call_ns = _NEVER_NS
        self._callback: Callable[[], None] = lambda: None
        node.context.on_shutdown(self.stop)

    def subscribe(
        self, message_type: Any, topic: str, qos: QoSProfile, *, wakes: bool = True
    ) -> RawSubscription:
        """
        Subscribe to a topic; its messages stay serialized.
        While samples arrive, only messages of the first subscription with `wakes` end a wait.
        """
        # rclpy needs a callback for each subscription, but without an executor never calls it.
        create = partial(self.node.create_subscription, callback=lambda _: None, raw=True)
        subscription = _opened(create, message_type, topic, qos)
        self._raw.append(RawSubscription(subscription, wakes))
        self._is_stale = True
        return self._raw[-1]

    def publisher(self, message_type: Any, topic: str, qos: QoSProfile) -> Publisher:
        """Open a publisher; ThermoCompError if name or QoS is invalid."""
        return _opened(self.node.create_publisher, message_type, topic, qos)

    def unsubscribe(self, raw: RawSubscription) -> None:
        """Destroy a subscription of this loop."""
        self._raw.remove(raw)
        self._is_stale = True
        self.node.destroy_subscription(raw.subscription)

    def call_soon(self, callback: Callable[[], None]) -> None:
        """Queue a function that the loop's thread then calls; callable from any thread."""
        self._soon.append(callback)
        with suppress(InvalidHandle):
            self._guard.trigger()

    def call_every(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call a function every `period_s`, instead of the function of an earlier `call_every`."""
        self._period_ns = int(period_s * 1e9)
        self._call_ns = time.monotonic_ns() + self._period_ns
        self._callback = callback

    def stop(self) -> None:
        """Make `run` return; callable from any thread."""
        self._is_stopping = True
        with suppress(InvalidHandle):
            self._guard.trigger()

    def run(self, on_data: Callable[[], None]) -> None:
        """Serve until `stop`; call `on_data`, which drains all subscriptions, at each wake-up."""
        try:
            while not self._is_stopping:
                self._guarded(partial(self._serve, on_data), (RCLError, ExternalShutdownException))
        except (RCLError, ExternalShutdownException):
            if self.node.context.ok():
                raise

    def _serve(self, on_data: Callable[[], None]) -> None:
        """Wait and serve until the loop stops, or subscriptions or services may have changed."""
        node, self._is_stale = self.node, False
        raw = [subscription.subscription for subscription in self._raw]
        others = {sub: partial(_take_message, sub) for sub in node.subscriptions if sub not in raw}
        others |= {service: partial(self._take_request, service) for service in node.services}
        waking = next((subscription for subscription in self._raw if subscription.wakes), None)
        pause_ns = 0
        # Pause only with best-effort QoS: with reliable QoS a wake-up takes less CPU than a sleep.
        if waking and waking.subscription.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT:
            pause_ns = self._pause_ns
        dense_ns = pause_ns * 3 // 4
        now_ns, poll_ns = time.monotonic_ns, 0
        is_flowing = False
        with ExitStack() as in_use:
            entities = [*raw, *others, self._guard]
            for entity in (*entities, node.context):
                in_use.enter_context(entity.handle)
            full_set = _WaitSet(node.context, entities)
            waking_set = _WaitSet(node.context, [waking.subscription] if waking else [])
            while not (self._is_stopping or self._is_stale):
                if self._soon:
                    self._guarded(self._soon.popleft())
                    on_data()
                    # The callback may have created or destroyed entities of the wait sets.
                    self._is_stale = True
                    continue
                now = now_ns()
                if now >= self._call_ns:
                    # Periodic calls that were missed are not made later.
                    late_ns = (now - self._call_ns) % self._period_ns
                    self._call_ns = now - late_ns + self._period_ns
                    self._guarded(self._callback)
                    continue
                if is_flowing:
                    is_flowing = bool(waking_set.wait(min(self._call_ns - now, OTHERS_PERIOD_NS)))
                else:
                    full_set.wait(min(self._call_ns - now, _LONGEST_WAIT_NS))
                    is_flowing, poll_ns = waking is not None, 0
                woken_ns = now_ns()
                on_data()
                if woken_ns >= poll_ns:
                    ready = [others[entity] for entity in full_set.wait(0) if entity in others]
                    served = [self._guarded(serve) for serve in ready]
                    # After a request the next request may wait already: look again at once.
                    poll_ns = 0 if any(served) else woken_ns + OTHERS_PERIOD_NS
                # Without arrival times from the middleware the interval is 0: do not pause.
                if waking and 0 < waking.interval_ns < dense_ns:
                    left_ns = woken_ns + pause_ns - now_ns()
                    if left_ns > 0:
                        time.sleep(left_ns * 1e-9)

    def _take_request(self, service: Service) -> bool:
        request, header = service.handle.service_take_request(service.srv_type.Request)
        if header is None:
            return False

        answer = partial(service.send_response, header=header)
        if service in self.handlers:
            self.handlers[service](request, answer)
        else:
            answer(service.callback(request, service.srv_type.Response()))
        return True

    def _guarded(
        self,
        callback: Callable[[], bool | None],
        fatal: tuple[type[Exception], ...] = (ExternalShutdownException,),
    ) -> bool | None:
        """Call a function; log an exception, at most every `_LOG_PERIOD_NS`, and continue."""
        try:
            return callback()
        except fatal:
            raise
        except Exception as error:
            if not self.node.context.ok():
                raise ExternalShutdownException from error
            self.n_failures += 1
            now = time.monotonic_ns()
            if now - self._logged_ns >= _LOG_PERIOD_NS:
                self._logged_ns = now
                lines = ''.join(traceback.format_exception(error)).splitlines()
                text = '\n'.join(['a callback failed, the node continues:', *map(one_line, lines)])
                self.node.get_logger().error(text)
            return None


class _WaitSet:
    """A wait set of rclpy for fixed entities, which are added again before each wait."""

    def __init__(self, context: rclpy.context.Context, entities: Sequence[Any]) -> None:
        types = [type(entity) for entity in entities]
        counts = types.count(Subscription), types.count(GuardCondition), 0, 0, types.count(Service)
        self._set = rclpy_implementation.WaitSet(*counts, 0, context.handle)
        self._content = [
            (entity, _KINDS[kind], getattr(self._set, f'add_{_KINDS[kind]}'), entity.handle)
            for entity, kind in zip(entities, types, strict=True)
        ]

    def wait(self, timeout_ns: int) -> list[Any]:
        """Wait at most `timeout_ns`; return the entities that are ready."""
        self._set.clear_entities()
        places = [(entity, kind, add(handle)) for entity, kind, add, handle in self._content]
        self._set.wait(timeout_ns)
        return [entity for entity, kind, place in places if self._set.is_ready(kind, place)]


def _opened(create: Callable[..., Any], message_type: Any, topic: str, qos: QoSProfile) -> Any:
    """Open a topic with its QoS overrides; ThermoCompError if name or QoS is invalid."""
    policies = QoSOverridingOptions.with_default_policies()
    try:
        # rclpy writes the overrides into the profile: give it a copy.
        return create(message_type, topic, qos_profile=copy(qos), qos_overriding_options=policies)
    except (RuntimeError, ValueError, ParameterException, InvalidQosOverridesError) as error:
        raise ThermoCompError(f'the topic {topic} cannot be opened: {error}') from error


def _take_message(subscription: Subscription) -> bool:
    if taken := subscription.handle.take_message(subscription.msg_type, subscription.raw):
        subscription.callback(taken[0])
    return bool(taken)


@contextmanager
def separate_node(name: str, ros_args: Sequence[str]) -> Iterator[Node]:
    """Open a node in a new rclpy context; at the end destroy the node and the context."""
    context = rclpy.context.Context()
    rclpy.init(args=['--ros-args', *ros_args], context=context)
    try:
        node = rclpy.create_node(name, context=context)
        try:
            yield node
        finally:
            # Without `destroy_node` the publishers would live until the next garbage collection.
            node.destroy_node()
    finally:
        context.try_shutdown()


def wait_until(is_done: Callable[[], object], timeout_s: float, nap_s: float = 0.02) -> bool:
    """Poll `is_done` until it is true, or return False after the time-out [s]."""
    deadline = time.monotonic() + timeout_s
    while not is_done():
        if time.monotonic() > deadline:
            return False
        time.sleep(nap_s)
    return True


def overrides(node: Node) -> dict[str, Any]:
    """Return the parameters that the user set at the start, declared or not, by name."""
    return {name: value.value for name, value in node._parameter_overrides.items()}  # noqa: SLF001
