# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Calibration files of version 1: what they gave by their own equations, the converted ones give.

The file beside this test was written by the release that wrote version 1; its equations are
written out again here, from the plain values of the file.
"""

from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import yaml

from thermo_comp.errors import CalibrationError
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.calibration_file import dump_calibration, parse_calibration

TEXT = Path(__file__).with_name('calibration_version_1.yaml').read_text()
OLD = yaml.safe_load(TEXT)
NEW = parse_calibration(TEXT.encode())
#: t, gradient [K], rate [K/s], lags [K].
STATES = [(3.0, 2.0, 0.01, (5.0, -7.0)), (-12.0, -8.0, -0.016, (0.3, 11.0))]


def old_regressors(one, state):
    """List what the old bias parameters multiplied: 1, t, t^2.., gradient, rate, lags."""
    t, gradient, rate, lags = state
    size = len(one['bias_function']['coefficients'])
    return np.array([*(t**power for power in range(size)), gradient, rate, *lags])


def new_columns(state, weight):
    _, gradient, rate, lags = state
    values = {'now': gradient, 'rate': rate, ('board', 600.0): lags[0], ('board', 2400.0): lags[1]}
    factor = {'static': 1.0 - weight, 'dynamic': weight, 'always': 1.0}
    return np.array(
        [
            factor[term.during] * values.get(term.kind, values.get((term.kind, term.tau_s)))
            for term in NEW.response
        ]
    )


@pytest.mark.parametrize('state', STATES)
@pytest.mark.parametrize(('regime', 'weight'), [('static', 0.0), ('dynamic', 1.0)])
@pytest.mark.parametrize('axis', range(3))
def test_bias_scale_and_covariance_are_those_of_the_old_equations(state, regime, weight, axis):
    one = OLD[regime]['xyz'[axis]]
    t = state[0]
    phi = old_regressors(one, state)
    bias, scale = (
        np.array(
            [
                *one[f'{part}_function']['coefficients'],
                *(one[term][part] for term in ('gradient', 'rate')),
                *one['memory'][part],
            ]
        )
        for part in ('bias', 'scale')
    )
    columns = new_columns(state, weight)
    curves = getattr(NEW, regime).axes()[axis]
    assert curves.delta == one['delta']
    new_bias = curves.bias_function.value(t) + columns @ [term.bias[axis] for term in NEW.response]
    assert new_bias == pytest.approx(bias @ phi, rel=1e-14)
    new_scale = columns @ [term.scale[axis] for term in NEW.response]
    assert new_scale + curves.scale_function.value(t) == pytest.approx(scale @ phi, rel=1e-14)

    n = len(phi)
    rows = one['covariance']
    old = np.zeros((2 * n, 2 * n))
    for i, row in enumerate(rows):
        old[i, : i + 1] = old[: i + 1, i] = row
    layout = parameter_layout(NEW)
    new = NEW.posterior.covariance()
    regressors = np.zeros((2, layout.n_parameters))
    powers = t ** np.arange(curves.bias_function.n_free + 1)
    for row, block in zip(regressors, (layout.bias[axis], layout.scale[axis]), strict=True):
        level = getattr(block, regime)
        row[level : level + len(powers)] = powers
        row[block.response : block.end] = columns
    both = np.kron(np.eye(2), phi)
    # The posterior is written in single precision.
    np.testing.assert_allclose(
        regressors @ new @ regressors.T, both @ old @ both.T, rtol=1e-5, atol=1e-14
    )


def test_what_was_known_of_the_misalignment_stays_known():
    at = parameter_layout(NEW).misalignment
    variances = np.diag(NEW.posterior.covariance())[at : at + 3]
    np.testing.assert_allclose(np.sqrt(variances), OLD['misalignment_sd'], rtol=1e-6)
    assert NEW.misalignment_sd == tuple(OLD['misalignment_sd'])


def test_terms_without_weight_and_covariance_are_left_out():
    data = deepcopy(OLD)
    for regime in ('static', 'dynamic'):
        data[regime]['rate_range_k_min'] = [-1.2, 0.6]
        for axis in 'xyz':
            for key in ('gradient', 'memory', 'covariance'):
                del data[regime][axis][key]
            data[regime][axis]['rate'] = {'bias': 2.0 if axis == 'y' else 0.0}
    value = parse_calibration(yaml.safe_dump(data).encode())
    assert [(term.kind, term.during) for term in value.response] == [
        ('rate', 'static'),
        ('rate', 'dynamic'),
    ]
    assert value.response[0].bias == (0.0, 2.0, 0.0)
    assert value.response[0].range == (-0.02, 0.01)
    assert value.posterior is None


def test_it_is_written_as_version_2():
    text = dump_calibration(NEW)
    assert text.startswith('format_version: 2')
    assert parse_calibration(text.encode()) == NEW


@pytest.mark.parametrize(
    ('old', 'new', 'key', 'message'),
    [
        ('unit:', 'response: []\nunit:', 'response', 'unknown key in a file of version 1'),
        ('gradient: {bias: 0.5', 'gradient: {bia: 0.5', 'static.x.gradient.bia', 'unknown key'),
        (
            'gradient: {bias: 0.5',
            'gradient: {bias: a',
            'static.x.gradient.bias',
            "number, got 'a'",
        ),
        ('    delta: 0.2', '    dleta: 0.2', 'static.x.dleta', 'unknown key'),
        ('static:', 'statics:', 'statics', 'unknown key'),
        ('[600.0, 2400.0]', '[600.0]', 'static.x.memory', 'per memory_time_constants_s'),
        ('[600.0, 2400.0]', '[600.0, -1.0]', 'memory_time_constants_s[1]', 'greater than 0'),
        ('[0.1, -0.05]', '[0.1]', 'static.x.memory', 'as many bias as scale'),
        ('    - [1.0e-08]', '    - [-1.0e-08]', 'static.x.covariance', 'negative variance'),
        ('    - [1.0e-08]', '    - [1.0e-30]', 'static.x.covariance', 'positive semidefinite'),
        ('    - [1.0e-08]', '    - [1.0e-320]', 'static.x.covariance', 'positive semidefinite'),
        ('    - [1.0e-08]\n', '', 'static.x.covariance', 'rows of a lower triangle'),
        ('scale: 2.0e-05', 'scale: 0.1', 'static.x.scale_function', 'must stay above 0.1'),
        (
            '  x:\n',
            '  gradient_range_k: [1, 1]\n  x:\n',
            'static.gradient_range_k',
            'lower < upper',
        ),
        ('  x:\n', '  memory_range_k: [2, 1]\n  x:\n', 'static.memory_range_k', 'lower < upper'),
    ],
)
def test_refusals_name_the_keys_of_the_old_file(old, new, key, message):
    text = TEXT.replace('  gradient_range_k: [-50.0, 50.0]\n', '')
    text = text.replace('  memory_range_k: [-50.0, 50.0]\n', '')
    assert old in text
    with pytest.raises(CalibrationError, match=message) as caught:
        parse_calibration(text.replace(old, new, 1).encode())
    assert caught.value.key == key
