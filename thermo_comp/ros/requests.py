# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the services that set parameters: prepared beside the samples, applied between two of them.

rclpy serves such a request in one go, in the thread of the samples, and a request that it cannot
read ends the node. Here a thread of its own waits for what takes time, the reading of a file; what
is left for the loop is to exchange one reference. Requests are answered in the order in which they
came, whatever is wrong with them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service

from ..errors import ThermoCompError
from ..text import one_line
from .waitloop import WaitLoop

#: More requests than this that wait, or parameters in one of them, are refused.
WAITING_LIMIT, PARAMETERS_LIMIT = 64, 256
#: Of a reason, which may repeat what came in.
_LONGEST_REASON = 1000

_QUESTIONS = (DescribeParameters, GetParameters, GetParameterTypes, ListParameters)

#: Runs beside the samples: what takes time about a change.
Prepare = Callable[[list[Parameter]], Any]
#: Runs between two samples: sets what was prepared.
Apply = Callable[[list[Parameter], Any], SetParametersResult]


class RequestError(ThermoCompError):
    """A request that cannot be taken, whatever it asks for."""


class ParameterRequests:
    """
    What answers a node's parameter services; exceptions of the halves of a change are refusals.
    """

    def __init__(self, node: Node, loop: WaitLoop, prepare: Prepare, apply: Apply) -> None:
        self._node, self._loop, self._prepare, self._apply = node, loop, prepare, apply
        self._n_waiting = 0
        self._beside = ThreadPoolExecutor(1, 'parameters')
        for service in node.services:
            if service.srv_type in (SetParameters, SetParametersAtomically):
                loop.serve(service, partial(self._take, service.srv_type))
            elif service.srv_type in _QUESTIONS:
                loop.serve(service, partial(_reply, service))

    def close(self) -> None:
        """Finish what is being prepared; nothing is applied any more."""
        self._beside.shutdown(cancel_futures=True)

    def _take(self, kind: Any, request: Any, answer: Callable[[Any], None]) -> None:
        """Let a request wait for its turn."""
        is_each, n, reason = kind is SetParameters, len(request.parameters), ''
        groups = [[one] for one in request.parameters] if is_each else [request.parameters]
        results: list[SetParametersResult] = []

        def respond() -> None:
            answer(kind.Response(results=results) if is_each else kind.Response(result=results[0]))

        def end(prepared: Future[Any]) -> None:
            """Apply a group in the loop's thread; after the last one answer."""
            try:
                self._set(prepared, results)
            finally:
                if len(results) == len(groups):
                    self._n_waiting -= 1
                    respond()

        if n > PARAMETERS_LIMIT:
            reason = f'{n} parameters at once, at most {PARAMETERS_LIMIT}'
        elif self._n_waiting >= WAITING_LIMIT:
            reason = 'too many requests wait already, try again'
        elif groups:
            self._n_waiting += 1
            for group in groups:
                future = self._beside.submit(self._read, group)
                future.add_done_callback(lambda done: self._loop.call_soon(partial(end, done)))
            return
        # Not one for each: to write so many would take as long as to read them.
        results += [_refusal(reason)] * min(len(groups), PARAMETERS_LIMIT)
        respond()

    def _read(self, group: list[ParameterMessage]) -> tuple[list[Parameter], Any]:
        changes = [read_parameter(message) for message in group]
        return changes, self._prepare(changes)

    def _set(self, prepared: Future[Any], results: list[SetParametersResult]) -> None:
        """Apply one group; what nobody foresaw is refused and logged by the loop."""
        try:
            changes, found = prepared.result()
            news = [one for one in changes if not self._is_in_force(one)]
            result = self._apply(news, found) if news else SetParametersResult(successful=True)
            results.append(result if result.successful else _refusal(result.reason))
        except (ThermoCompError, ParameterNotDeclaredException) as error:
            results.append(_refusal(str(error)))
        except Exception as error:
            results.append(
                _refusal(f"internal error ({type(error).__name__}), see the node's log")
            )
            raise

    def _is_in_force(self, change: Parameter) -> bool:
        """Tell whether it leaves a fixed parameter as it is, as `param load` of a dump does."""
        node = self._node
        return bool(
            node.has_parameter(change.name)
            and node.describe_parameter(change.name).read_only
            and node.get_parameter(change.name).value == change.value
        )


def _reply(service: Service, request: Any, answer: Callable[[Any], None]) -> None:
    """Let rclpy answer a question; one of too many names as if it knew none of them."""
    names = request.prefixes if service.srv_type is ListParameters else request.names
    response = service.srv_type.Response()
    answer(response if len(names) > PARAMETERS_LIMIT else service.callback(request, response))


def read_parameter(message: ParameterMessage) -> Parameter:
    """Read a parameter off the network; RequestError if it has no name, or a value of no type."""
    if not message.name:
        # rclpy takes it for declared.
        raise RequestError('a parameter without a name')
    try:
        return Parameter.from_parameter_msg(message)
    except (ValueError, TypeError) as error:
        raise RequestError(
            f'parameter {message.name!r:.60} has no value that can be read '
            f'(type {message.value.type})'
        ) from error


def _refusal(reason: str) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=one_line(reason[:_LONGEST_REASON]))
