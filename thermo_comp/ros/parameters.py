# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the node's parameters: their table, and the services that set them.

The table of the parameters is `NodeConfig`. The node runs with one immutable `NodeConfig`; a
change makes a new `NodeConfig` or is refused as a whole. A separate process reads files, while a
thread waits for the process; then the node's loop starts to use the new `NodeConfig`. A queue of
requests that set `calibration_file`, and a queue of all other requests, are served in parallel.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import Field, dataclass, field, fields, replace
from functools import partial
from typing import Any

from rcl_interfaces import srv
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service

from ..errors import ThermoCompError
from ..online.status import CompensatorConfig
from ..recording.topics import Topics, parse_name, read_names
from ..text import LONGEST_SERIAL, one_line
from .waitloop import WaitLoop, overrides

#: Largest number of waiting requests with a `calibration_file`, and of parameters in a request.
WAITING_LIMIT, PARAMETERS_LIMIT = 64, 256
LONGEST_FRAME = 255  # longest frame name that may be set [bytes]
_LONGEST_REASON = 1000  # longest reason of a refusal, which may quote the request [characters]

_DEFAULTS = CompensatorConfig()


def _parameter(default: Any, description: str, bounds: tuple[float, ...] = (), **more: Any) -> Any:
    usual = {'bounds': bounds, 'choices': (), 'longest': LONGEST_SERIAL, 'is_fixed': False}
    return field(default=default, metadata={'description': description, **usual, **more})


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """The node's parameters; a parameter without `is_fixed` can be set while the node runs."""

    calibration_file: str = _parameter(
        '',
        'Path of the calibration (YAML). Required. Setting the present path reads the file again.',
        longest=4096,
    )
    calibration_directory: str = _parameter(
        '',
        'Folder that `calibration_file` must be in after links are resolved; empty: any folder. '
        'Fixed at start.',
        longest=4096,
        is_fixed=True,
    )
    serial: str = _parameter(
        '', 'Serial number that the calibration must have; empty: any number.'
    )
    topics: str = _parameter(
        '',
        'Topics of inputs and output, if not the defaults: INPUT=TOPIC[:FIELD] or output=TOPIC, '
        'separated by commas, or a file like those in config/drivers. Fixed at start.',
        longest=4096,
        is_fixed=True,
    )
    rest_log: str = _parameter(
        '',
        'Folder for windows of 10 s at rest, which `thermo_comp update` and `evaluate` read, at '
        'most 10 MB a month; empty: no rests are stored. Fixed at start.',
        longest=4096,
        is_fixed=True,
    )
    input: str = _parameter(
        'counts',
        'Input to compensate: accel/counts (Vector3Stamped) or imu/uncompensated (Imu). If '
        '`topics` names only one of counts and imu, `input` is set to this one at the start.',
        choices=('counts', 'imu'),
    )
    frame_id: str = _parameter(
        '',
        'Frame of the output; empty: frame of the input. The node does not rotate samples.',
        longest=LONGEST_FRAME,
    )
    transition_time: float = _parameter(
        _DEFAULTS.transition_time_s,
        'Time over which the coefficients change after a switch of the regime [s]; up to ten '
        'times as long if the output would change faster than 1 ug per second; 0: at once.',
        (0.0, 3600.0),
    )
    temperature_timeout: float = _parameter(
        _DEFAULTS.temperature_timeout_s,
        'Age of the last board temperature at which publishing stops [s], unless the correction '
        'is constant.',
        (0.1, 86400.0),
    )
    case_timeout: float = _parameter(
        _DEFAULTS.case_timeout_s,
        'Age of the last case temperature above which the regime follows from the board '
        'temperature alone [s].',
        (0.1, 86400.0),
    )
    stuck_timeout: float = _parameter(
        _DEFAULTS.stuck_timeout_s,
        'Longest repetition of equal values that is published [s], on all axes, or on one axis '
        'while the others change or show noise; at least 50 repetitions are published. Samples of '
        'three zeros are dropped at once. 0: repetitions and zeros are published.',
        (0.0, 3600.0),
    )
    local_gravity: float = _parameter(
        _DEFAULTS.local_gravity_m_s2,
        'Local gravity [m/s^2], for the check of |f| at rest; 0: gravity of the calibration.',
        (0.0, 100.0),
    )
    gravity_tolerance: float = _parameter(
        _DEFAULTS.gravity_tolerance_m_s2,
        'Publishing stops if the error of |f| at rest exceeds this value plus 5 sd [m/s^2], as '
        'with the calibration of another unit; 0: no error of |f| stops publishing. A reversed '
        'axis changes |f| at rest by at most twice the bias of the axis.',
        (0.0, 100.0),
    )
    diagnostics_period: float = _parameter(1.0, 'Period of /diagnostics [s].', (0.01, 60.0))

    def compensator_config(self) -> CompensatorConfig:
        """Build the compensator's settings, named as the parameters with a unit appended."""
        names = [field.name for field in fields(CompensatorConfig)]
        values = (getattr(self, name.removesuffix('_m_s2').removesuffix('_s')) for name in names)
        return CompensatorConfig(**dict(zip(names, values, strict=True)))


_TABLE: Mapping[str, Field[Any]] = {entry.name: entry for entry in fields(NodeConfig)}


class ParameterError(ThermoCompError):
    """A parameter that the node refuses, with the reason."""


def declare(node: Node) -> NodeConfig:
    """Declare every parameter with the user's value; ParameterError for an invalid value."""
    values, given = {}, overrides(node)
    names = named_topics(_checked('topics', given.get('topics', '')))
    inputs = [name for name in ('counts', 'imu') if name in names]
    if len(inputs) == 1:
        given['input'] = inputs[0]
    for name, entry in _TABLE.items():
        # Check the value here and not in rclpy, which refuses an integer for a float.
        values[name] = _checked(name, given.get(name, entry.default))
        node.declare_parameter(name, values[name], descriptor(name), ignore_override=True)
    return NodeConfig(**values)


def named_topics(text: str) -> dict[str, str]:
    """Read the parameter `topics`: topics by input; ParameterError for a malformed text."""
    try:
        names = dict(map(parse_name, text.split(','))) if '=' in text else {}
        names = read_names(text) if text and not names else names
        Topics.named(names)
    except ValueError as error:
        raise ParameterError(f'parameter `topics`: {error}') from error
    return names


def descriptor(name: str) -> ParameterDescriptor:
    """Return the descriptor of a parameter for ROS tools: type, range and description."""
    entry = _TABLE[name]
    described = ParameterDescriptor(
        name=name,
        type=Parameter.Type.from_parameter_value(entry.default).value,
        description=entry.metadata['description'],
        read_only=entry.metadata['is_fixed'],
    )
    if entry.metadata['bounds']:
        lower, upper = entry.metadata['bounds']
        described.floating_point_range = [FloatingPointRange(from_value=lower, to_value=upper)]
    if entry.metadata['choices']:
        described.additional_constraints = f'one of: {", ".join(entry.metadata["choices"])}'
    return described


def updated(config: NodeConfig, parameters: Iterable[Parameter]) -> NodeConfig:
    """Apply the values of known parameters together; ParameterError if a value is invalid."""
    values = {new.name: _checked(new.name, new.value) for new in parameters if new.name in _TABLE}
    return replace(config, **values)


def parameters_help() -> str:
    """Return the parameters as text for a terminal."""
    return '\n'.join(
        f'  {name}:={entry.default!r}\n      {entry.metadata["description"]}'
        for name, entry in _TABLE.items()
    )


def _checked(name: str, value: Any) -> Any:
    """Return a value in its parameter's type; ParameterError for an invalid value."""
    metadata, rule, got = _TABLE[name].metadata, '', f'{value!r:.60}'
    if isinstance(_TABLE[name].default, str):
        longest, choices = metadata['longest'], metadata['choices']
        if not isinstance(value, str):
            rule = 'a string'
            got += f' ({type(value).__name__}); quote it: \'"{value!s:.60}"\''
        elif not (value.isprintable() and len(value) <= longest):
            rule = f'one printable line of at most {longest} characters'
            got = f'{len(value)} characters: {got}'
        elif choices and value not in choices:
            rule = f'one of {", ".join(choices)}'
    elif isinstance(value, bool) or not isinstance(value, int | float):
        rule = 'a number'
    else:
        lower, upper = metadata['bounds']
        if not (math.isfinite(value) and lower <= value <= upper):
            rule, got = f'between {lower:g} and {upper:g}', f'{value:g}'
        value = float(value)
    if rule:
        raise ParameterError(f'parameter `{name}` must be {rule}, got {got}')
    return value


class ParameterRequests:
    """Answers a node's parameter services."""

    # `prepare` reads files for a parameter change in parallel to the samples, `apply` sets the
    # prepared result between two samples; an exception of one of the functions refuses the change.
    def __init__(
        self,
        loop: WaitLoop,
        prepare: Callable[[list[Parameter]], Any],
        apply: Callable[[list[Parameter], Any], SetParametersResult],
    ) -> None:
        self._loop, self._prepare, self._apply = loop, prepare, apply
        self._n_waiting = 0
        # A second thread answers requests without `calibration_file`, which read no file.
        self._slow, self._quick = (ThreadPoolExecutor(1, 'parameters') for _ in range(2))
        for service in loop.node.services:
            if service.srv_type in (srv.SetParameters, srv.SetParametersAtomically):
                loop.handlers[service] = partial(self._take, service.srv_type)
            elif service.srv_type.__module__.startswith('rcl_interfaces.'):
                loop.handlers[service] = partial(_reply, service)

    def close(self) -> None:
        """Wait for the request in preparation; apply no more requests."""
        for pool in (self._slow, self._quick):
            pool.shutdown(cancel_futures=True)

    def _take(self, kind: Any, request: Any, answer: Callable[[Any], None]) -> None:
        is_each, n, reason = kind is srv.SetParameters, len(request.parameters), ''
        groups = [[change] for change in request.parameters] if is_each else [request.parameters]
        reads_file = any(parameter.name == 'calibration_file' for parameter in request.parameters)
        results: list[SetParametersResult] = []

        def respond() -> None:
            answer(kind.Response(results=results) if is_each else kind.Response(result=results[0]))

        def end(prepared: Future[Any]) -> None:
            """Apply a group of parameters in the loop's thread; answer after the last group."""
            try:
                self._set(prepared, results)
            finally:
                if len(results) == len(groups):
                    self._n_waiting -= reads_file
                    respond()

        if n > PARAMETERS_LIMIT:
            reason = f'{n} parameters in one request, at most {PARAMETERS_LIMIT} are allowed'
        elif reads_file and self._n_waiting >= WAITING_LIMIT:
            reason = 'too many requests are waiting, try again'
        elif groups:
            self._n_waiting += reads_file
            for group in groups:
                future = (self._slow if reads_file else self._quick).submit(self._read, group)
                future.add_done_callback(lambda done: self._loop.call_soon(partial(end, done)))
            return
        # Send at most `PARAMETERS_LIMIT` results: each takes as long as reading a parameter.
        results += [_refusal(reason)] * min(len(groups), PARAMETERS_LIMIT)
        respond()

    def _read(self, group: list[ParameterMessage]) -> tuple[list[Parameter], Any]:
        changes = [read_parameter(message) for message in group]
        return changes, self._prepare(changes)

    def _set(self, prepared: Future[Any], results: list[SetParametersResult]) -> None:
        """Apply one group of parameters; an unexpected error refuses the group and is logged."""
        try:
            changes, preparation = prepared.result()
            news = [change for change in changes if not self._repeats_fixed_value(change)]
            result = SetParametersResult(successful=True)
            result = self._apply(news, preparation) if news else result
            results.append(result if result.successful else _refusal(result.reason))
        except (ThermoCompError, ParameterNotDeclaredException) as error:
            results.append(_refusal(str(error)))
        except Exception as error:
            reason = f"internal error ({type(error).__name__}), see the node's log"
            results.append(_refusal(reason))
            raise

    def _repeats_fixed_value(self, change: Parameter) -> bool:
        """Whether a fixed parameter is set to its present value, as by `ros2 param load`."""
        node = self._loop.node
        return bool(
            node.has_parameter(change.name)
            and node.describe_parameter(change.name).read_only
            and node.get_parameter(change.name).value == change.value
        )


def _reply(service: Service, request: Any, answer: Callable[[Any], None]) -> None:
    """Let rclpy answer a request; with too many names, answer as if none of them existed."""
    names = request.prefixes if service.srv_type is srv.ListParameters else request.names
    response = service.srv_type.Response()
    answer(response if len(names) > PARAMETERS_LIMIT else service.callback(request, response))


def read_parameter(message: ParameterMessage) -> Parameter:
    """Read a received parameter; integers become floats if the parameter is a float."""
    if not message.name:
        # rclpy would treat a parameter with an empty name as declared.
        raise ParameterError('a parameter without a name')
    try:
        given = Parameter.from_parameter_msg(message)
    except (ValueError, TypeError) as error:
        raise ParameterError(
            f'parameter {message.name!r:.60} has no readable value (type {message.value.type})'
        ) from error
    is_whole = given.type_ == Parameter.Type.INTEGER and given.name in _TABLE
    if is_whole and isinstance(_TABLE[given.name].default, float):
        return Parameter(given.name, Parameter.Type.DOUBLE, float(given.value))
    return given


def _refusal(reason: str) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=one_line(reason[:_LONGEST_REASON]))
