# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""For any calibration file and any messages the output is finite, bounded and in order."""

import base64
import json
import math
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from builders import START_NS, UNCHECKED, rich_calibration
from fault_rig import unit
from hypothesis import example, given, settings
from hypothesis import strategies as st

from thermo_comp.errors import CalibrationError
from thermo_comp.online.compensator import Compensator
from thermo_comp.online.status import CompensatorConfig
from thermo_comp.online.trial import is_sound_sample, tried
from thermo_comp.quantities import QUANTITIES
from thermo_comp.unit.calibration import Calibration
from thermo_comp.unit.calibration_file import dump_calibration, parse_calibration
from thermo_comp.unit.schema import SchemaError, build

UNITS = (rich_calibration(), unit())
TREE = yaml.safe_load(dump_calibration(rich_calibration()))


def leaves(tree, path=()):
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, key))


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=6,
)


@settings(deadline=None)
@given(st.sampled_from(list(leaves(TREE))), anything)
def test_a_wrong_value_at_any_key_is_refused_with_the_key(place, value):
    tree = json.loads(json.dumps(TREE))
    *way, last = place
    reduce(getitem, way, tree)[last] = value
    content = yaml.dump(tree, Dumper=yaml.CSafeDumper, allow_unicode=True).encode()
    try:
        parsed = parse_calibration(content, 'unit.yaml')
    except CalibrationError as error:
        text, key = str(error), error.key
        assert '\n' not in text
        assert key or 'not valid YAML' in text or 'nested deeper' in text, text
        assert not key or key.split('.')[0].split('[')[0] in TREE, text
    else:
        assert parse_calibration(dump_calibration(parsed).encode()) == parsed


EXAMPLE = Path(__file__).parents[1] / 'config' / 'calibration.example.yaml'
TREES = (TREE, yaml.safe_load(dump_calibration(unit())), yaml.safe_load(EXAMPLE.read_text()))
#: For each value of the calibrations in TREES: number of its calibration, and path to the value.
EDITS = [(k, place) for k, tree in enumerate(TREES) for place in leaves(tree)]
magnitudes = st.builds(
    lambda sign, digits, power: sign * digits * 10.0**power,
    *(st.sampled_from([1.0, -1.0]), st.floats(1.0, 9.99), st.integers(-308, 307)),
)
#: The limits of all quantities of a calibration file, and the numbers next to each limit.
edges = st.sampled_from(
    [
        near
        for bounds in QUANTITIES.values()
        for bound in (bounds.above, bounds.at_least, bounds.nil_or, bounds.below, bounds.at_most)
        if bound is not None
        for near in (bound, -bound, bound * (1 - 1e-12), bound * (1 + 1e-12))
    ]
)
factors = st.integers(-60, 60).map(lambda power: 2.0**power)


class Edited(dict[str, Any]):
    """The content of a calibration file; hypothesis prints only the changed values."""

    edits: tuple[Any, ...] = ()

    def __repr__(self):
        return f'{self.get("unit")!r:.40} with {self.edits}'


@st.composite
def edited(draw):
    """Draw a calibration file in which one to three values are replaced by other values."""
    which = draw(st.sampled_from(range(len(TREES))))
    tree = Edited(json.loads(json.dumps(TREES[which])))
    own = [place for k, place in EDITS if k == which]
    for *way, last in draw(st.lists(st.sampled_from(own), min_size=1, max_size=3)):
        try:
            branch = reduce(getitem, way, tree)
            value = branch[last]
        except (KeyError, IndexError, TypeError):
            continue  # an earlier change has removed this key
        if isinstance(value, str) and last in ('factor', 'diagonal'):
            shape = np.frombuffer(base64.b64decode(value), '<f4')
            factor = draw(factors)
            with np.errstate(over='ignore'):
                scaled = (shape * np.float32(factor)).astype('<f4')
            branch[last] = base64.b64encode(scaled.tobytes()).decode()
        elif isinstance(value, int | float) and not isinstance(value, bool):
            branch[last] = draw(magnitudes | edges | factors.map(lambda f, v=value: f * v))
        elif isinstance(value, list) and value and all(isinstance(v, float) for v in value):
            branch[last] = draw(
                st.permutations(value)
                | st.lists(magnitudes | edges, max_size=20)
                | factors.map(lambda f, v=value: [f * x for x in v])
            )
        else:
            branch[last] = draw(anything | edges)
        tree.edits += ((*way, last), branch[last])
    return tree


def changed(which, place, value):
    tree = Edited(json.loads(json.dumps(TREES[which])))
    reduce(getitem, place[:-1], tree)[place[-1]] = value
    tree.edits = (place, value)
    return tree


def whole_range(of):
    """List messages over the temperature range of a calibration, and far outside this range."""
    edges_c = [edge for regime_set in of.regime_sets() for edge in regime_set.temperature_range_c]
    middle = of.reference_temperature_c
    temperatures = [middle, middle + 0.5, *edges_c, middle, -273.0, 999.0, middle, middle]
    steps_s = [1.0, 5.0, 20.0, 60.0, 1.0, 400.0, 60.0, 5.0, 90_000.0, 2.0, 0.5]
    largest = of.unit.full_scale * (1.0 - 1e-9)
    sent = []
    now_ns = START_NS
    for k, (celsius, step_s) in enumerate(zip(temperatures, steps_s, strict=True)):
        for m in range(6):
            # Each temperature is read six times, because a single reading may count as an outlier.
            now_ns += round(step_s / 6.0 * 1e9)
            sent.append(('board', now_ns, celsius))
            sent += [(name, now_ns, celsius + 0.1 * m) for name in of.sensors]
            sign = (-1.0) ** m
            for size in (1e-3 * largest, largest):
                now_ns += 1_000_000
                row = [sign * size, size * (-1.0) ** k, (0.5 + 0.07 * m) * size]
                sent.append(('counts', now_ns, tuple(row)))
    return sent


@settings(deadline=None, max_examples=max(120, settings.default.max_examples))
@given(edited())
# Variances of axes differ by 23 powers of ten (example 1), or two lags are almost equal (2).
@example(changed(1, ('axes', 'z', 'scale_factor'), 1.0))
@example(changed(0, ('response', 3, 'sensor_share'), 1e-12))
def test_whatever_file_is_accepted_gives_finite_numbers_over_its_whole_range(tree):
    # WHY: a `delta` of 1e300, a lag of 1e-300 s or a weight of 1e160 gave infinite or NaN output.
    try:
        of = build(Calibration, dict(tree))
    except SchemaError:
        return
    tried(of)
    compensator = Compensator(of, UNCHECKED)
    n_sound = 0
    for topic, stamp_ns, value in whole_range(of):
        if topic != 'counts':
            compensator.push(topic, stamp_ns, value)
            continue
        row = compensator.process(stamp_ns, *value)
        if row is None:
            continue
        n_sound += 1
        assert is_sound_sample(row)
        if compensator.corrects_rate:
            rate = compensator.correct_rate(stamp_ns, 1.0, -2.0, 30.0)
            assert all(map(math.isfinite, rate))
            assert min(rate[3:]) > 0.0
    counters = compensator.counters
    assert counters.n_unsound == 0
    # Samples have output unless they came too fast, or temperatures were too old or missing.
    assert n_sound or counters.n_too_fast or counters.n_stale or counters.n_no_temperature
    assert all(map(math.isfinite, compensator.status().state))


numbers = st.sampled_from([0.0, 1.0, -1.0, 2941.0, 32766.0, 32767.0, -32767.0, 1e300, 5e-324])
numbers = st.floats(allow_nan=True, allow_infinity=True) | numbers
across = st.floats(-4e4, 4e4)
counts = st.tuples(numbers, numbers, numbers) | st.tuples(across, across, st.floats(2e3, 4e3))
celsius = st.floats(-50.0, 100.0) | st.sampled_from([20.0, 20.5, 35.1, 1e9, -1e300]) | numbers
steps = st.sampled_from([0, 1, 10**7, 10**7, 8 * 10**7, 10**9, 3 * 10**10, 10**12, 10**15])
steps |= st.integers(-(10**11), 10**11)
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


def largest(axis, regime, of):
    """Return upper limits of |bias change| [counts] and of |relative scale change| of an axis."""
    edges = (*of.static.temperature_range_c, *of.dynamic.temperature_range_c)
    # Curves continue along their tangents by a quarter of the temperature range.
    t = max(abs(edge - of.reference_temperature_c) for edge in edges)
    t += 0.25 * (max(edges) - min(edges))
    curves = regime.axes()[axis]

    def terms(name):
        function = getattr(curves, f'{name}_function').coefficients[1:]
        response = (
            abs(getattr(term, name)[axis]) * max(map(abs, term.range)) * t**term.power
            for term in of.response
        )
        return sum(abs(c) * t**power for power, c in enumerate(function, 1)) + sum(response)

    return abs(curves.delta) + terms('bias'), terms('scale')


def bound(of):
    """Return an upper limit of the specific force corrected with a calibration [m/s^2]."""
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
def test_the_output_for_any_messages_is_finite_and_bounded(of, config, sent):
    compensator = Compensator(of, config)
    limit = bound(of) * (1.0 + 1e-9)
    now_ns, last_ns, n_jumps, n_counts = START_NS, -math.inf, 0, 0
    for topic, step, value in sent:
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
        covariance = np.array(row)[[[3, 4, 5], [4, 6, 7], [5, 7, 8]]]
        assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert compensator.counters.n_out <= n_counts
