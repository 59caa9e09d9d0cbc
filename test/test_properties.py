# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Properties: whatever comes, what goes out is finite, sound, in order and within what is possible.

The suite tries each a few times; `make nightly` ten thousand times.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import yaml
from builders import calibration, rich_calibration
from fault_rig import unit
from hypothesis import given, settings
from hypothesis import strategies as st

from thermo_comp.errors import CalibrationError
from thermo_comp.online.compensator import Compensator
from thermo_comp.online.status import CompensatorConfig
from thermo_comp.unit.calibration import Calibration, RegimeSet
from thermo_comp.unit.calibration_file import dump_calibration, parse_calibration
from thermo_comp.unit.functions import Polynomial

START_NS = 1_767_225_600_000_000_000
UNITS = (rich_calibration(), unit())
TREE = yaml.safe_load(dump_calibration(rich_calibration()))


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Name every place of a calibration file, the inner ones too."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, key))


PLACES = list(leaves(TREE))
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=6,
)


@settings(deadline=None)
@given(st.binary(max_size=2000) | st.text(max_size=500).map(str.encode))
def test_any_bytes_are_a_calibration_or_one_clear_line(content: bytes) -> None:
    with contextlib.suppress(CalibrationError):
        value = parse_calibration(content, 'unit.yaml')
        assert parse_calibration(dump_calibration(value).encode()) == value


@settings(deadline=None)
@given(st.sampled_from(PLACES), anything)
def test_any_value_at_any_key_is_good_or_its_key_is_named(place: Any, value: Any) -> None:
    tree = json.loads(json.dumps(TREE))
    *way, last = place
    branch = tree
    for key in way:
        branch = branch[key]
    branch[last] = value
    content = yaml.dump(tree, Dumper=yaml.CSafeDumper, allow_unicode=True).encode()
    refusal: CalibrationError | None = None
    try:
        found = parse_calibration(content, 'unit.yaml')
    except CalibrationError as error:
        refusal = error
    else:
        assert parse_calibration(dump_calibration(found).encode()) == found
    if refusal is not None:
        text = str(refusal)
        assert '\n' not in text
        # What is YAML of the accepted kind is refused for a key; the others for a line.
        assert refusal.key or 'not valid YAML' in text or 'nested deeper' in text, text
        if refusal.key:
            assert refusal.key.split('.')[0].split('[')[0] in TREE, text


numbers = st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from(
    [0.0, 1.0, -1.0, 2941.0, 32766.0, 32767.0, -32767.0, 1e300, 5e-324]
)
counts = st.tuples(numbers, numbers, numbers) | st.tuples(
    st.floats(-4e4, 4e4), st.floats(-4e4, 4e4), st.floats(2e3, 4e3)
)
celsius = st.floats(-50.0, 100.0) | st.sampled_from([20.0, 20.5, 35.1, 1e9, -1e300]) | numbers
steps = st.sampled_from(
    [0, 1, 10_000_000, 10_000_000, 80_000_000, 1_000_000_000, 30_000_000_000, 10**12, 10**15]
) | st.integers(-(10**11), 10**11)
messages = st.lists(
    st.tuples(st.just('counts'), steps, counts)
    | st.tuples(st.sampled_from(['board', 'case']), steps, celsius),
    max_size=60,
)
configs = st.builds(
    CompensatorConfig,
    transition_time_s=st.sampled_from([0.0, 5.0]),
    temperature_timeout_s=st.sampled_from([1.0, 60.0]),
    case_timeout_s=st.sampled_from([1.0, 30.0]),
    stuck_timeout_s=st.sampled_from([0.0, 2.0]),
    gravity_tolerance_m_s2=st.sampled_from([0.0, 0.5]),
)


def largest(axis: int, regime: RegimeSet, of: Calibration) -> tuple[float, float]:
    """Bound an axis' |bias| without the reference's, and the distance of its scale from 1."""
    edges = (*of.static.temperature_range_c, *of.dynamic.temperature_range_c)
    t = max(abs(edge - of.reference_temperature_c) for edge in edges)
    curves = regime.axes()[axis]

    def terms(name: str) -> float:
        function = getattr(curves, f'{name}_function').coefficients[1:]
        response = (
            abs(getattr(term, name)[axis]) * max(map(abs, term.range)) * t**term.power
            for term in of.response
        )
        return sum(abs(c) * t**power for power, c in enumerate(function, 1)) + sum(response)

    return abs(curves.delta) + terms('bias'), terms('scale')


def bound(of: Calibration) -> float:
    """Bound the specific force that a unit can give, from its calibration alone [m/s^2]."""
    worst = 0.0
    for regime in (of.static, of.dynamic):
        for axis, reference in enumerate((of.axes.x, of.axes.y, of.axes.z)):
            bias, scale = largest(axis, regime, of)
            assert scale < 0.5
            span = of.unit.full_scale + abs(reference.bias) + bias
            worst = max(worst, span / (abs(reference.scale_factor) * (1.0 - scale)))
    return worst * float(np.abs(np.array(of.misalignment)).sum(axis=1).max())


@settings(deadline=None)
@given(st.sampled_from(UNITS), configs, messages)
def test_any_messages_give_sound_numbers(
    of: Calibration, config: CompensatorConfig, sent: list[tuple[str, int, Any]]
) -> None:
    compensator = Compensator(of, config)
    limit = bound(of) * (1.0 + 1e-9)
    now_ns, last_ns, n_jumps, n_counts = START_NS, -math.inf, 0, 0
    for topic, step, value in sent:
        # Stamps are those that a message can carry.
        now_ns = min(max(now_ns + step, -(2**31) * 10**9), 2**31 * 10**9 - 1)
        if topic != 'counts':
            compensator.push(topic, now_ns, value)
            continue
        n_counts += 1
        row = compensator.process(now_ns, *value)
        counters = compensator.counters
        assert counters.n_in == n_counts
        if row is None:
            continue
        assert now_ns > last_ns or counters.n_time_jumps > n_jumps
        last_ns, n_jumps = now_ns, counters.n_time_jumps
        assert all(map(math.isfinite, row))
        assert max(map(abs, row[:3])) <= limit
        xx, xy, xz, yy, yz, zz = row[3:]
        covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert compensator.counters.n_out <= n_counts


finite = st.floats(-1e3, 1e3)


@settings(deadline=None)
@given(
    st.lists(st.floats(-1e-3, 1e-3), min_size=6, max_size=6),
    st.lists(finite, min_size=6, max_size=6),
    st.text(st.characters(codec='utf-8', exclude_categories=['Cc', 'Cs']), min_size=1, max_size=9),
)
def test_any_calibration_survives_its_file(
    small: list[float], numbers: list[float], serial: str
) -> None:
    plain = calibration()
    axis = replace(
        plain.static.x,
        delta=numbers[0],
        bias_function=Polynomial((0.0, *numbers[1:4])),
        scale_function=Polynomial((1.0, small[0], small[4] * 1e-3)),
    )
    try:
        value = replace(
            plain,
            static=replace(plain.static, x=axis),
            misalignment=((1.0, 0.0, 0.0), (small[1], 1.0, 0.0), (small[2], small[3], 1.0)),
            unit=replace(plain.unit, serial=serial),
        )
        text = dump_calibration(value)
    except (ValueError, CalibrationError):
        return  # one that the reader would refuse is not written
    assert parse_calibration(text.encode()) == value
