# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the node's parameters: one table gives types, defaults, ranges, descriptors and documentation.

The table is `NodeConfig` itself, a frozen dataclass: what the node runs with at any moment is one
such object, and a change makes another one or is refused as a whole.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from ..errors import ThermoCompError
from ..online.status import CompensatorConfig
from ..text import LONGEST_SERIAL
from .conversions import LONGEST_FRAME

_DEFAULTS = CompensatorConfig()

_TYPES = {str: Parameter.Type.STRING, float: Parameter.Type.DOUBLE}


def _parameter(
    default: Any, description: str, bounds: tuple[float, float] | None = None, **more: Any
) -> Any:
    others = {'choices': (), 'longest': LONGEST_SERIAL, 'is_fixed': False, **more}
    metadata = {'description': description, 'bounds': bounds, **others}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """The parameters, all live but `calibration_directory`; descriptions have the units."""

    calibration_file: str = _parameter(
        '',
        'Path of the calibration (YAML). Required. Setting it again reads the file again.',
        longest=4096,
    )
    calibration_directory: str = _parameter(
        '',
        'Folder that `calibration_file` must lie in, wherever links lead; empty allows any. Only '
        'at start.',
        longest=4096,
        is_fixed=True,
    )
    serial: str = _parameter(
        '', 'Serial number that the calibration must be for; empty accepts any.'
    )
    input: str = _parameter(
        'counts',
        'What is compensated: accel/counts (Vector3Stamped) or imu/uncompensated (Imu).',
        choices=('counts', 'imu'),
    )
    frame_id: str = _parameter(
        '',
        "Frame of the output; empty keeps the input's. The values are not rotated.",
        longest=LONGEST_FRAME,
    )
    transition_time: float = _parameter(
        _DEFAULTS.transition_time_s,
        'Time over which the sets cross over at a switch [s], up to ten times as long where the '
        'output would move faster than 1 ug per second; 0 switches at once.',
        (0.0, 3600.0),
    )
    temperature_timeout: float = _parameter(
        _DEFAULTS.temperature_timeout_s,
        'Age of the board temperature at which publishing stops [s].',
        (0.1, 86400.0),
    )
    case_timeout: float = _parameter(
        _DEFAULTS.case_timeout_s,
        'Age of the case temperature at which the board sensor decides the regime [s].',
        (0.1, 86400.0),
    )
    stuck_timeout: float = _parameter(
        _DEFAULTS.stuck_timeout_s,
        'Time after which samples that are equal to the bit are not published [s]; three exact '
        'zeros never are; 0 publishes any sample.',
        (0.0, 3600.0),
    )
    local_gravity: float = _parameter(
        _DEFAULTS.local_gravity_m_s2,
        'Gravity at this place [m/s^2], for the check at rest; 0 takes that of the calibration.',
        (0.0, 100.0),
    )
    gravity_tolerance: float = _parameter(
        _DEFAULTS.gravity_tolerance_m_s2,
        'Error of the magnitude at rest [m/s^2] at which publishing stops: another unit, a '
        'reversed axis; 0 never stops.',
        (0.0, 100.0),
    )
    diagnostics_period: float = _parameter(1.0, 'Time between diagnostics [s].', (0.01, 60.0))

    def compensator_config(self) -> CompensatorConfig:
        """Return the part that the compensator takes."""
        # There the names say the units.
        names = {one.name: one.name.removesuffix('_m_s2') for one in fields(CompensatorConfig)}
        return CompensatorConfig(
            **{name: getattr(self, own.removesuffix('_s')) for name, own in names.items()}
        )


_TABLE: Mapping[str, Field[Any]] = {entry.name: entry for entry in fields(NodeConfig)}


class ParameterError(ThermoCompError):
    """A parameter value that the node can't take; names the parameter, the rule and the value."""


def declare(node: Node) -> NodeConfig:
    """Declare every parameter with the user's value; ParameterError where it does not fit."""
    values: dict[str, Any] = {}
    for name, entry in _TABLE.items():
        # Looked at before it is declared for good: an integer override of a float is welcome.
        probe = ParameterDescriptor(dynamic_typing=True)
        override = node.declare_parameter(name, entry.default, probe).value
        node.undeclare_parameter(name)
        values[name] = _checked(name, override)
        node.declare_parameter(name, values[name], descriptor(name), ignore_override=True)
    return NodeConfig(**values)


def descriptor(name: str) -> ParameterDescriptor:
    """Describe one parameter as ROS tools show it: type, range and description."""
    entry = _TABLE[name]
    described = ParameterDescriptor(
        name=name,
        type=_TYPES[type(entry.default)].value,
        description=entry.metadata['description'],
        read_only=entry.metadata['is_fixed'],
    )
    if entry.metadata['bounds']:
        lower, upper = entry.metadata['bounds']
        described.floating_point_range = [FloatingPointRange(from_value=lower, to_value=upper)]
    if entry.metadata['choices']:
        described.additional_constraints = f'one of: {", ".join(entry.metadata["choices"])}'
    return described


def coerce(parameters: Iterable[Parameter]) -> list[Parameter]:
    """Turn whole numbers into floats where this node wants floats (``ros2 param set ... 5``)."""
    return [
        Parameter(one.name, Parameter.Type.DOUBLE, float(one.value))
        if one.type_ == Parameter.Type.INTEGER
        and one.name in _TABLE
        and isinstance(_TABLE[one.name].default, float)
        else one
        for one in parameters
    ]


def updated(config: NodeConfig, parameters: Iterable[Parameter]) -> NodeConfig:
    """Apply values set together, passing over others' parameters; ParameterError as above."""
    values = {one.name: _checked(one.name, one.value) for one in parameters if one.name in _TABLE}
    return replace(config, **values)


def parameters_table() -> str:
    """Write the parameters as a Markdown table for the documentation."""
    rows = ['| parameter | type | default | range | what it does |', '|---|---|---|---|---|']
    for name, entry in _TABLE.items():
        kind = _TYPES[type(entry.default)].name.lower()
        default = f"'{entry.default}'" if isinstance(entry.default, str) else f'{entry.default:g}'
        limits = ''
        if entry.metadata['bounds']:
            limits = '{:g} .. {:g}'.format(*entry.metadata['bounds'])
        if entry.metadata['choices']:
            limits = ', '.join(f'`{choice}`' for choice in entry.metadata['choices'])
        description = entry.metadata['description']
        rows.append(f'| `{name}` | {kind} | `{default}` | {limits} | {description} |')
    return '\n'.join(rows) + '\n'


def parameters_help() -> str:
    """Write the parameters as plain text for a terminal."""
    return '\n'.join(
        f'  {name}:={entry.default!r}\n      {entry.metadata["description"]}'
        for name, entry in _TABLE.items()
    )


def _checked(name: str, value: Any) -> Any:
    """Return a value in its parameter's type; ParameterError where it does not fit."""
    metadata, rule, got = _TABLE[name].metadata, '', f'{value!r:.60}'
    if isinstance(_TABLE[name].default, str):
        longest, choices = metadata['longest'], metadata['choices']
        if not isinstance(value, str):
            rule = 'a string'
            got += f' ({type(value).__name__}); quote it: \'"{value!s:.60}"\''
        elif not (value.isprintable() and len(value) <= longest):
            rule = f'one printable line of at most {longest} characters'
            got = f'{len(value)}: {got}'
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
