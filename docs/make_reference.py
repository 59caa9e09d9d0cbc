# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the files made from the code: JSON schema, and pages on calibration file and ROS interface.

Run ``python docs/make_reference.py`` after a change of a key of the calibration file or of a
parameter of the node. A test compares the generated files with the code.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from thermo_comp.quantities import QUANTITIES, Bounds
from thermo_comp.ros.parameters import NodeConfig
from thermo_comp.topics import INPUTS, OUTPUTS, STATUS, NodeTopic
from thermo_comp.unit.calibration import Calibration
from thermo_comp.unit.schema import fields_of, plain

ROOT = Path(__file__).resolve().parent.parent
TYPES = {str: 'string', int: 'integer', float: 'number', bool: 'boolean', type(None): 'null'}
KEYWORDS = {
    'above': 'exclusiveMinimum',
    'at_least': 'minimum',
    'below': 'exclusiveMaximum',
    'at_most': 'maximum',
    'shortest': 'minLength',
    'longest': 'maxLength',
}
LIST_KEYWORDS = {'shortest': 'minItems', 'longest': 'maxItems'}
AXES = ('x', 'y', 'z')

CALIBRATION_HEAD = """\
# The calibration file

A calibration file describes one unit in YAML, and is written by `thermo_comp fit`, `update` or `import`.
`config/calibration.example.yaml` is an annotated example, `config/calibration.schema.json` the JSON
Schema; this page is generated from the schema.

A file is refused if it has unknown or missing keys, text in place of a number, NaN or infinity, ranges that do not rise,
functions that are not normalised at the reference temperature, a relative scale that could leave the range 0.1 to 10, a
posterior of the wrong size, another `format_version` than 2, YAML aliases or tags, or a size above 8 MiB. The error message
names the file, the key, the value and the expected value. Numbers are written with all digits and the posterior in single
precision, so that no number changes if a file is read and written. The last line of a written file is `...`: a written file
that was cut, for example by a copy that has not ended, is refused.

The main keys:

```yaml
format_version: 2
unit: {serial: EXAMPLE-1, input: counts, full_scale: 32767.0, cycle_time_s: 0.01}
reference_temperature_c: 20.0
gravity_m_s2: 9.80665                # local gravity, input of the fit
gravity_sd_m_s2: 0.0                 # sd of local gravity, input of the fit
axes:                                # at the reference temperature
  x: {scale_factor: 299.1, bias: 4.2}   # counts per m/s^2, counts
static:                              # the set of the static regime
  temperature_range_c: [4.0, 37.0]   # outside: along the tangent
  x:
    # Fs(t), 0 at t = 0, and Fc(t), 1 at t = 0
    bias_function: {kind: polynomial, coefficients: [0.0, 0.0031]}
    scale_function: {kind: polynomial, coefficients: [1.0, 7.7e-05]}
response:                            # columns added to both sets
  - kind: gradient                   # T_case - T_board
    group: gradient
    range: [-9.0, 9.0]               # the value is limited to this range
    bias: [0.0021, 0.0014, -0.0006]  # x, y, z: counts per K
    scale: [1.1e-06, 9.0e-07, 1.3e-06]  # relative, per K
  - kind: board                      # T_board - lagged T_board
    group: board
    tau_s: 960.0
    range: [-20.0, 20.0]
    bias: [0.0008, 0.0, 0.0003]
    scale: [2.0e-07, 1.0e-07, 0.0]
# posterior: the covariance of all parameters
# evidence: contribution of each group of columns
```

The parameters of the posterior are, for each axis x, y, z: first the bias in input units (level of
the static set, free coefficients of its Fs, level of the dynamic set, free coefficients of its Fs,
weights of the response in the order of the file); then the parameters of the relative scale in the
same order. A `nonlinearity` adds parameters for each axis: the coefficients of its terms, then their
changes per kelvin. The last three parameters of a posterior are `M[1][0]`, `M[2][0]` and `M[2][1]`. The
covariance of all parameters is `factor @ factor.T + diag(diagonal)`. The posterior of a `gyroscope`
has only the parameters of the bias, in rad/s and in the order of the accelerometer's bias. The
`gyroscope` uses the ranges, the reference temperature and the thermometers of the accelerometer.
"""

BOUNDS = """\
## Bounds

Each number in a calibration is one of the quantities in the table. The bounds are wider than any instrument needs; a
calibration within them gives finite results and a positive definite covariance. The bias at the reference temperature, and
its change over temperature, must each be within twice the full scale of the unit. The relative scale, plus or minus the sum
of the largest effects of its columns, must stay between 0.1 and 10. The largest effect of a column on the bias must be at
most a million times the limit of the bias. The effect of a parameter's sd on the bias, or on the relative scale, must be at
most a million times the limit of the bias, or of the relative scale.
"""

INTERFACE = """\
# ROS interface of the node

The node is `thermo_comp`, its executable `thermo_comp_node`. All topic names but `/diagnostics` are relative, and can be
remapped. Samples and regime flags have the stamps of the inputs; only `/diagnostics` is stamped by the node's clock, so the
node needs no `use_sim_time`.

## Topics

| direction | topic | type | QoS |
|---|---|---|---|
{topics}

Each QoS policy can be overridden at start with the usual `qos_overrides./topic.subscription.reliability`
parameters.

With Fast DDS the node uses a profile with `nackSupressionDuration` = 20 ms for its publishers, as no ROS QoS setting has
this parameter. With the default of `nackSupressionDuration`, 0 s, a thread of the middleware wakes about four times for each
sample to a reliable subscriber, and takes a quarter of the node's CPU time. With NACKs suppressed for 20 ms, a lost sample
is resent up to 20 ms later. A user's profile (`FASTRTPS_DEFAULT_PROFILES_FILE`, or `DEFAULT_FASTRTPS_PROFILES.xml` in the
working directory) replaces the profile of the node: repeat `nackSupressionDuration` in this file.

`linear_acceleration_covariance` is a full 3x3 matrix: noise of the sample plus uncertainty of the calibration at the
present thermal state. Without an angular rate or an orientation in the input, the first element of the covariance of the
missing quantity is -1 (REP 145). If the calibration has a `gyroscope`, the bias at the current thermal state is subtracted
from `angular_velocity`, and `angular_velocity_covariance` is the noise of a message plus the uncertainty of that bias.

## The topics of a driver

The parameter `topics` names the driver's topics, like the option `--topic` of the offline commands:
`topics:=imu=/imu/data,board=/fmu/out/sensor_accel:temperature`, or a file of such lines, as in [config/drivers](drivers.md).
`TOPIC:FIELD` is a number inside a message, written as for `ros2 topic echo --field`. The node takes the message type from
the publisher; the driver's message package must be installed. A reading without a header gets the stamp of the newest sample
before the reading. `output=TOPIC` names the output, for a driver that publishes `imu/data_raw` itself; the node refuses an
output topic that is one of its inputs.

## Recording a test

`thermo_comp record` runs a separate node, `thermo_comp_record`, which subscribes to the inputs of the compensating node and
to every further `temperature/<name>`, once the topic has a publisher; the subscription is reliable if the publisher is
reliable. `thermo_comp_record` publishes no topic. See [Recording](recording.md#recording).

## Parameters

{parameters}

A `set_parameters_atomically` request is checked as a whole before any of its parameters is applied. A separate process
reads and checks a calibration while samples flow; the node then exchanges the calibration between two samples. An
invalid `calibration_file` is refused in the response, with the reason, and the running calibration stays. The
coefficients of a calibration are not parameters: parameters arrive one at a time, and a polynomial that mixes old and new
coefficients gives a wrong correction.

If lags, play operators and `detector` of the new calibration equal those of the running calibration, as after `update`, the
estimates of temperatures and regime continue. With a calibration of a new fit the estimation restarts from the last
temperatures: after a reload in a ramp the output may step, with a larger covariance until `memory settled` in `/diagnostics`
is True. Load a calibration of a new fit when the temperature has been constant for an hour.

```console
$ ros2 param set /thermo_comp calibration_file /new/unit42.yaml
```

## What is not published

| input | what happens |
|---|---|
| NaN or infinite counts | dropped, counted, WARN |
| counts at full scale | dropped, counted, ERROR while such counts arrive |
| no board temperature yet | nothing is published, ERROR |
| no board temperature, and a calibration without temperature correction | the constants are applied; the covariance includes the effect of an unknown temperature, with an sd of 10 K |
| board temperature older than `temperature_timeout` | nothing is published, ERROR (WARN from half of the time-out or, if shorter, five reading intervals on) |
| case temperature older than `case_timeout` | the board decides the regime, the covariance is increased, WARN |
| board temperature outside the calibrated range | curves continue along their tangent for a quarter of the range, and are constant beyond; the covariance is increased, WARN with the distance |
| gradient or rate outside the calibrated range | the value is limited to the range, the covariance is increased, WARN with the distance |
| a temperature that is NaN, below -273.15 or above 1000 degC | dropped, counted |
| readings that jump faster than the temperature of any part can change | the readings are not used until they are plausible again or the thermometer counts as lost; if the readings stay at the new value, the jump adds to the covariance until a jump back, WARN |
| a temperature that is constant while the temperature of the second thermometer changes | the constant readings are not used: the last used value is held, then the thermometer counts as lost |
| both temperatures constant over at least 20 readings and 5 s | the temperatures are used with a growing covariance, WARN |
| ten changed readings in a row of the case that repeat the readings of the board (one topic for both) | the readings are used; the expected difference of case and board temperature adds to the covariance, WARN |
| a sample whose stamp goes back by a second or more, after the force at rest has refuted the calibration | nothing is published until the force at rest agrees with gravity in two windows, ERROR |
| a board temperature that leads the case temperature in ramps (swapped topics) | the covariance is increased, ERROR |
| counts constant for `stuck_timeout` and more than 50 samples, on all axes, or on one axis while the other axes change or show their noise; samples of three zeros | dropped, counted, ERROR |
| counts that come faster than their conversion cycle | dropped, counted, ERROR |
| a magnitude of the specific force at rest that differs from gravity by more than `gravity_tolerance` plus 5 sd; a smooth acceleration has this effect if the force has turned by over 3 degrees, or over 60 s have passed, since its magnitude last agreed with gravity | nothing is published, ERROR |
| after motion, a constant force in the direction of the force at the last rest, but larger or smaller, as in a coordinated turn | published: the platform accelerates |
| a second publisher of a topic | the topic is not used, ERROR, until one publisher is left or for one second all messages are from one publisher (WARN while the middleware still lists a killed publisher, for 20 s) |
| a sample without a finite correction | dropped, counted, ERROR |
| a message of more than 1 kB (a very long `frame_id`) | dropped, counted |
| a temperature stamped more than 5 s after the next reading of the same thermometer | the reading is not used |
| a sample whose stamp repeats, or goes back by less than a second | dropped, counted |
| a sample stamped more than 15 s (or ten cycles, if longer) after the last sample, until a reading or a second sample confirms the time | dropped, counted |
| a sample whose stamp goes back by a second or more | all estimators restart, which is reported once |

[Faults](faults.md) lists every fault with its test.
"""


def json_schema(cls: type) -> dict[str, Any]:
    """Return the JSON Schema of a dataclass including nested dataclasses."""
    definitions: dict[str, Any] = {}
    top = _schema(cls, definitions)['$ref'].rpartition('/')[2]
    result = definitions.pop(top)
    return {'$defs': dict(sorted(definitions.items())), **result}


def calibration_schema() -> dict[str, Any]:
    """Return the JSON Schema of the calibration file."""
    return {'$schema': 'https://json-schema.org/draft/2020-12/schema', **json_schema(Calibration)}


def _schema(hint: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if hint in TYPES:
        return {'type': TYPES[hint]}
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        _define(hint, definitions)
        return {'$ref': f'#/$defs/{hint.__name__}'}
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        result = _schema(arguments[0], definitions)
        for note in arguments[1:]:
            if isinstance(note, Bounds):
                result |= _limits(note, result['type'] == 'array')
            else:
                result['description'] = note
        return result
    if origin is Literal:
        is_one = len(arguments) == 1
        return {'const': arguments[0]} if is_one else {'enum': list(arguments), 'type': 'string'}
    if origin is not tuple:
        return {'anyOf': [_schema(kind, definitions) for kind in arguments]}
    if arguments[-1] is Ellipsis:
        return {'type': 'array', 'items': _schema(arguments[0], definitions)}
    items = [_schema(kind, definitions) for kind in arguments]
    return {'type': 'array', 'prefixItems': items, 'minItems': len(items), 'maxItems': len(items)}


def _limits(bounds: Bounds, is_list: bool) -> dict[str, Any]:
    given = {name: limit for name, limit in vars(bounds).items() if limit is not None}
    if 'at_least' in given:
        given.pop('above', None)
    words = {**KEYWORDS, **(LIST_KEYWORDS if is_list else {})}
    return {words[name]: limit for name, limit in given.items() if name in words}


def _define(cls: Any, definitions: dict[str, Any]) -> None:
    if cls.__name__ in definitions:
        return
    hints, required = fields_of(cls)
    # The schema of a dataclass comes before the schemas of its fields.
    result = definitions[cls.__name__] = {
        'type': 'object',
        'description': inspect.cleandoc(cls.__doc__),
        'additionalProperties': False,
    }
    result['properties'] = {name: _schema(hint, definitions) for name, hint in hints.items()}
    for field in dataclasses.fields(cls):
        if field.name not in required:
            factory = field.default_factory
            value = field.default if factory is dataclasses.MISSING else factory()
            result['properties'][field.name]['default'] = plain(value)
    result['required'] = list(required)


def calibration_page() -> str:
    """Return the page on the calibration file."""
    definitions: dict[str, Any] = {}
    _schema(Calibration, definitions)
    schema = definitions.pop(Calibration.__name__)
    parts = [CALIBRATION_HEAD, *_section('The top level', schema, definitions, heading=2)]
    for name, part in definitions.items():
        parts += _section(name, part, definitions, heading=3)
    return '\n'.join([*parts, *_bounds_table()])


def _bounds_table() -> list[str]:
    rows = []
    for name, bounds in QUANTITIES.items():
        if bounds.longest:
            lower, upper = f'{bounds.shortest or 0}', f'{bounds.longest}'
            unit = 'entries'
        else:
            lower = f'{bounds.above if bounds.at_least is None else bounds.at_least:g}'
            lower += f', or {bounds.nil_or:g}' if bounds.nil_or else ''
            upper = f'{bounds.below if bounds.at_most is None else bounds.at_most:g}'
            unit = bounds.unit
        rows.append(f'| {name} | {lower} | {upper} | {unit} | {bounds.why} |')
    table = ['| quantity | from | to | unit | reason |', '|---|---|---|---|---|', *rows]
    return [BOUNDS, *table, '']


def _section(
    name: str, part: dict[str, Any], definitions: dict[str, Any], heading: int
) -> list[str]:
    text = part.get('description', '').strip().split('\n\n')[0].replace('\n', ' ')
    lines = [f'{"#" * heading} {name}', '', text if heading > 2 else '', '']
    lines += ['| key | type | default | meaning |', '|---|---|---|---|']
    required = part.get('required', [])
    for key, value in part.get('properties', {}).items():
        default = 'required' if key in required else f'`{json.dumps(value.get("default"))}`'
        if len(default) > 40:
            default = 'in the schema'
        meaning = value.get('description', '') or _described(value, definitions)
        # Without code marks, Markdown would read the brackets of M[1][0] as a link.
        meaning = re.sub(r'\w+(\[\d\]){2}', r'`\g<0>`', meaning)
        lines.append(f'| `{key}` | {_type(value)} | {default} | {meaning} |')
    return [*lines, '']


def _described(value: dict[str, Any], definitions: dict[str, Any]) -> str:
    reference = value.get('$ref', '').rpartition('/')[2]
    text: str = definitions.get(reference, {}).get('description', '')
    return text.strip().split('\n\n')[0].replace('\n', ' ')


def _type(value: dict[str, Any]) -> str:
    if '$ref' in value:
        return str(value['$ref'].rpartition('/')[2])
    for several in ('oneOf', 'anyOf'):
        if several in value:
            return ' or '.join(_type(part) for part in value[several])
    if 'enum' in value:
        return ' or '.join(f'`{word}`' for word in value['enum'])
    if 'const' in value:
        return f'`{value["const"]}`'
    kind = str(value.get('type', ''))
    if kind == 'array':
        items = value.get('prefixItems')
        inner = _type(items[0]) if items else _type(value.get('items', {}))
        return f'list of {len(items)} {inner}' if items else f'list of {inner}'
    bounds = [
        f'{sign} {value[word]:g}'
        for word, sign in (
            ('exclusiveMinimum', '>'),
            ('minimum', '>='),
            ('exclusiveMaximum', '<'),
            ('maximum', '<='),
        )
        if word in value
    ]
    return ' '.join([kind, *bounds])


def topics_table() -> str:
    """Return the node's topics as the rows of a Markdown table."""
    directions = {'in': INPUTS.values(), 'out': (*OUTPUTS, STATUS)}

    def qos(topic: NodeTopic) -> str:
        words = ['reliable' if topic.is_reliable else 'best effort']
        words += ['transient local'] * topic.is_latched
        return ', '.join([*words, f'keep last {topic.depth}'])

    return '\n'.join(
        f'| {direction} | `{topic.name}` | {topic.type.replace("/msg/", "/")}: {topic.meaning} '
        f'| {qos(topic)} |'
        for direction, topics in directions.items()
        for topic in topics
    )


def parameters_table() -> str:
    """Return the node's parameters as a Markdown table."""
    rows = ['| parameter | type | default | range | what it does |', '|---|---|---|---|---|']
    for field in dataclasses.fields(NodeConfig):
        is_text = isinstance(field.default, str)
        kind, default = (
            ('string', f"'{field.default}'") if is_text else ('double', f'{field.default:g}')
        )
        limits = ''
        if field.metadata['bounds']:
            limits = '{:g} .. {:g}'.format(*field.metadata['bounds'])
        if field.metadata['choices']:
            limits = ', '.join(f'`{choice}`' for choice in field.metadata['choices'])
        # An unescaped bar, as in |f|, would begin a new cell of the table.
        meaning = field.metadata['description'].replace('|', r'\|')
        rows.append(f'| `{field.name}` | {kind} | `{default}` | {limits} | {meaning} |')
    return '\n'.join(rows) + '\n'


def pages() -> dict[Path, str]:
    """Return the text of each generated file."""
    return {
        ROOT / 'config' / 'calibration.schema.json': json.dumps(calibration_schema(), indent=2)
        + '\n',
        ROOT / 'docs' / 'calibration_file.md': calibration_page(),
        ROOT / 'docs' / 'ros_interface.md': INTERFACE.format(
            topics=topics_table(), parameters=parameters_table()
        ),
    }


if __name__ == '__main__':
    for path, text in pages().items():
        path.write_text(text)
