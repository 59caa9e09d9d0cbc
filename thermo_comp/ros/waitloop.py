# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the node's loop around its wait sets, and everything that leaves rclpy's documented API.

rclpy's executor builds a wait set, a generator and a coroutine for each message, which costs ten
times the compensation itself. Here the subscriptions of the hot path are kept from the executor,
their wait set is reused, and a wake-up empties their queues. The rest of the node (services,
timers, other subscriptions, middleware events) is served by an ordinary executor, which is asked
only when a wait set says that one of these is ready; while samples flow, the loop looks at it now
and then, without waiting. With best effort, where wake-ups cost the most, messages that come
faster than anybody waits for them may gather a little, so that one wake-up serves several.

No exception of a callback ends the loop: it is logged and counted, and samples go on.

Beyond the documented API: `rclpy.impl.implementation_singleton` (`WaitSet`), the method
`service_take_request` of a service's handle, and the node's `_parameter_overrides`;
`test/test_waitloop.py` fails when any of them changes.
"""

from __future__ import annotations

import time
import traceback
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.subscription import Subscription

from ..text import one_line
from .raw import RawSubscription

#: While samples flow, services and timers are looked after this often [ns].
OTHERS_PERIOD_NS = 20_000_000

#: Longer than any machine runs, and what the middleware can still count [ns].
_NEVER_NS, _LONGEST_WAIT_NS = 1 << 62, 3600 * 10**9

#: A failure is logged with all its lines, but not more often than this [ns].
_LOG_PERIOD_NS = 10 * 10**9

RCLError = rclpy_implementation.RCLError

#: Takes a request and what sends the answer, now or later, in the loop's thread.
Serve = Callable[[Any, Callable[[Any], None]], None]


@dataclass(frozen=True, slots=True)
class _Entities:
    """A wait set and its content: the loop's own services are the first ones."""

    wait_set: Any
    content: list[tuple[Callable[[Any], Any], Any]]
    other_subscriptions: range
    other_services: range

    def fill(self) -> None:
        """Put everything into the wait set."""
        self.wait_set.clear_entities()
        for add, handle in self.content:
            add(handle)

    def is_other_ready(self) -> bool:
        """Tell whether something is ready that the executor serves."""
        ready, is_ready = self.wait_set.get_ready_entities, self.wait_set.is_ready
        return bool(
            ready('timer')
            or ready('client')
            or any(is_ready('service', index) for index in self.other_services)
            or any(is_ready('subscription', index) for index in self.other_subscriptions)
        )


class WaitLoop:
    """
    A loop over a node of no other executor: raw subscriptions for the caller, the rest for one.

    Messages of a best-effort subscription gather until `rest_s` after each wake-up [s], where they
    come often enough for it: four within three such times, so that a rest is not for one alone.
    """

    def __init__(self, node: Node, rest_s: float = 0.0) -> None:
        self._node = node
        self._rest_s = rest_s
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._stop_guard = GuardCondition(None, None, context=node.context)
        self._look_guard = GuardCondition(None, None, context=node.context)
        # Keeps the hot subscriptions and the services of this loop from the executor.
        self._reserved = ReentrantCallbackGroup()
        # Middleware events are the executor's.
        self._reserved.can_execute = lambda one: not isinstance(one, Subscription | Service)
        self._raw: list[RawSubscription] = []
        self._hot: list[RawSubscription] = []
        self._services: list[tuple[Service, Serve]] = []
        self._soon: deque[Callable[[], None]] = deque()
        #: Callbacks that ended in an exception.
        self.n_failures = 0
        self._logged_ns = -_LOG_PERIOD_NS
        self._is_stopping = False
        self._is_stale = True
        self._period_ns = _NEVER_NS
        self._call_ns = _NEVER_NS
        self._callback: Callable[[], None] = lambda: None
        node.context.on_shutdown(self.stop)

    def subscribe(
        self, message_type: Any, topic: str, qos: QoSProfile, *, is_hot: bool = True
    ) -> RawSubscription:
        """Subscribe in serialized form; a hot one wakes the loop, others wait a little."""
        subscription = self._node.create_subscription(
            message_type,
            topic,
            lambda _: None,  # never called: that is for an executor to do
            copy(qos),  # rclpy writes the overrides into it
            raw=True,
            callback_group=self._reserved,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        raw = RawSubscription(subscription)
        self._raw.append(raw)
        if is_hot:
            self._hot.append(raw)
        self._is_stale = True
        return raw

    def unsubscribe(self, raw: RawSubscription) -> None:
        """Destroy a subscription of this loop."""
        self._raw.remove(raw)
        if raw in self._hot:
            self._hot.remove(raw)
        self._is_stale = True
        self._node.destroy_subscription(raw.subscription)

    def serve(self, service: Service, callback: Serve) -> None:
        """Take a service over from the executor, whose callback has to answer at once."""
        service.callback_group = self._reserved
        self._services.append((service, callback))
        self._is_stale = True

    def call_soon(self, callback: Callable[[], None]) -> None:
        """Call back in the loop's thread, one callback a wake-up; callable from any thread."""
        self._soon.append(callback)
        with suppress(InvalidHandle):
            self._look_guard.trigger()

    def call_every(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call back every so often [s], in place of the last one; a timer costs ten times it."""
        self._period_ns = int(period_s * 1e9)
        self._call_ns = time.monotonic_ns() + self._period_ns
        self._callback = callback

    def stop(self) -> None:
        """Make `run` return; callable from any thread."""
        self._is_stopping = True
        with suppress(InvalidHandle):
            self._stop_guard.trigger()

    def run(self, on_data: Callable[[], None]) -> None:
        """Serve until the end; `on_data` is called when woken and drains all subscriptions."""
        try:
            while not self._is_stopping:
                with ExitStack() as in_use:
                    wait_sets = self._collect(in_use)
                    rest_ns = 0
                    # Only there a wake-up costs more than to sleep a little.
                    if all(one.is_best_effort for one in self._hot):
                        rest_ns = int(self._rest_s * 1e9)
                    try:
                        self._serve(on_data, wait_sets, rest_ns)
                    except (RCLError, ExternalShutdownException):
                        raise
                    except Exception as error:  # noqa: BLE001 - samples go on, whatever it was
                        self._note_failure(error)
        except (RCLError, ExternalShutdownException):
            if self._node.context.ok():
                raise

    def close(self) -> None:
        """Release the executor and the guard conditions; the node itself stays."""
        self._executor.shutdown()
        self._stop_guard.destroy()
        self._look_guard.destroy()

    def _collect(self, in_use: ExitStack) -> list[_Entities]:
        """Build wait sets: hot subscriptions, what the executor serves, everything."""
        node = self._node
        raw = [one.subscription for one in self._raw]
        hot = [one.subscription for one in self._hot]
        others = [one for one in node.subscriptions if one not in raw]
        guards = [self._stop_guard, self._look_guard]
        own = [service for service, _ in self._services]
        services = [*own, *[one for one in node.services if one not in own]]
        served = [guards, list(node.timers), list(node.clients), services]
        for entity in (*raw, *others, *[one for kind in served for one in kind]):
            in_use.enter_context(entity.handle)
        in_use.enter_context(node.context.handle)
        self._is_stale = False
        at = len(raw)
        return [
            self._entities([hot, [], [], [], []], range(0)),
            self._entities([others, *served], range(len(others))),
            self._entities([raw + others, *served], range(at, at + len(others))),
        ]

    def _entities(self, kinds: list[list[Any]], other_subscriptions: range) -> _Entities:
        """Build one, for subscriptions, guard conditions, timers, clients and services."""
        counts = [len(kind) for kind in kinds]
        wait_set = rclpy_implementation.WaitSet(*counts, 0, self._node.context.handle)
        adds = (
            wait_set.add_subscription,
            wait_set.add_guard_condition,
            wait_set.add_timer,
            wait_set.add_client,
            wait_set.add_service,
        )
        content = [
            (add, one.handle) for add, kind in zip(adds, kinds, strict=True) for one in kind
        ]
        other_services = range(len(self._services), counts[-1])
        return _Entities(wait_set, content, other_subscriptions, other_services)

    def _serve(
        self, on_data: Callable[[], None], wait_sets: list[_Entities], rest_ns: int
    ) -> None:
        """Wait and serve until the entities change or the loop is to stop."""
        hot, others, everything = wait_sets
        wait, is_ready, n_hot = hot.wait_set.wait, hot.wait_set.is_ready, len(self._hot)
        crowd_ns = rest_ns * 3 // 4
        now_ns, others_due_ns = time.monotonic_ns, 0
        is_flowing = False
        while not (self._is_stopping or self._is_stale):
            if self._soon:
                self._guarded(self._soon.popleft())
                if not is_flowing:
                    continue
            now = now_ns()
            if now >= self._call_ns:
                self._call_ns += self._period_ns
                if self._call_ns <= now:
                    # One that was missed is not made up for.
                    self._call_ns = now + self._period_ns
                self._guarded(self._callback)
                continue
            if not is_flowing:
                everything.fill()
                everything.wait_set.wait(min(self._call_ns - now, _LONGEST_WAIT_NS))
                on_data()
                self._look_after(everything)
                others_due_ns = now_ns() + OTHERS_PERIOD_NS
                hot.fill()
                is_flowing = n_hot > 0
                continue
            if n_hot > 1:
                # Those that were not ready are out; an only one is out just after a wait in vain.
                hot.fill()
            wait(min(self._call_ns - now, OTHERS_PERIOD_NS))
            woken_ns = now_ns()
            is_flowing = any(is_ready('subscription', index) for index in range(n_hot))
            on_data()
            first = self._hot[0]
            if woken_ns >= others_due_ns:
                others_due_ns = woken_ns + OTHERS_PERIOD_NS
                # With one condition met beforehand the middleware does not prepare to wait.
                self._look_guard.trigger()
                others.fill()
                others.wait_set.wait(0)
                self._look_after(others)
            # No interval at all: the middleware does not tell the time.
            if 0 < first.interval_ns < crowd_ns:
                left_ns = woken_ns + rest_ns - now_ns()
                if left_ns > 0:
                    time.sleep(left_ns * 1e-9)

    def _look_after(self, entities: _Entities) -> None:
        """Serve one request of each service of this loop, and one other thing that is ready."""
        for index, (service, callback) in enumerate(self._services):
            if entities.wait_set.is_ready('service', index):
                self._guarded(partial(_take_request, service, callback))
        if entities.is_other_ready():
            # Runs one callback of the node.
            self._guarded(partial(self._executor.spin_once, timeout_sec=0.0))
            self._is_stale = True

    def _guarded(self, callback: Callable[[], None]) -> None:
        """Call back; samples go on where that fails."""
        try:
            callback()
        except ExternalShutdownException:
            raise
        except Exception as error:
            if not self._node.context.ok():
                raise ExternalShutdownException from error
            self._note_failure(error)

    def _note_failure(self, error: Exception) -> None:
        """Count an exception, and log it unless another one has just been."""
        self.n_failures += 1
        now = time.monotonic_ns()
        if now - self._logged_ns >= _LOG_PERIOD_NS:
            self._logged_ns = now
            lines = ''.join(traceback.format_exception(error)).splitlines()
            text = '\n'.join(['a callback failed, samples go on:', *map(one_line, lines)])
            self._node.get_logger().error(text)


def _take_request(service: Service, callback: Serve) -> None:
    with service.handle:
        request, header = service.handle.service_take_request(service.srv_type.Request)
    if header is not None:
        callback(request, lambda response: service.send_response(response, header))


def undeclared_overrides(node: Node) -> list[str]:
    """Name the parameters that the user gave and the node does not have: misspelt, most likely."""
    overrides = node._parameter_overrides  # noqa: SLF001
    return sorted(name for name in overrides if not node.has_parameter(name))
