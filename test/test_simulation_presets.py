# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The ready-made units have the published properties of such units."""

from __future__ import annotations

import numpy as np
import pytest
from triads import TRIAD_NAMES, unit_of

from thermo_comp.simulation.drift import PartHistory, drift_of
from thermo_comp.simulation.presets import UNIT_NAMES, unit_preset
from thermo_comp.simulation.unit import UnitModel
from thermo_comp.typing import Floats

NAMES = (*UNIT_NAMES, *TRIAD_NAMES)


def _static(unit: UnitModel, board: Floats) -> tuple[Floats, ...]:
    """Return bias [ug] and relative scale after endless soaks at board temperatures."""
    still = []
    for temperature in board:
        parts = unit.network.equilibrium(unit.network.air_for('board', float(temperature)))
        deviation = (parts - unit.origin)[None]
        history = PartHistory(unit.network.nodes, deviation, unit.origin, 1.0)
        still.append(drift_of(unit.drift, history))
    bias, scale = zip(*still, strict=True)
    return np.concatenate(bias), np.concatenate(scale)


@pytest.mark.parametrize('name', NAMES)
def test_constants_hold_at_the_reference(name: str) -> None:
    unit = unit_of(name, 3)
    bias, scale = _static(unit, np.array([20.0]))
    np.testing.assert_allclose(bias, 0.0, atol=1e-9)
    np.testing.assert_allclose(scale, 0.0, atol=1e-12)
    np.testing.assert_array_equal(np.triu(unit.M, 1), 0.0)
    np.testing.assert_array_equal(np.diag(unit.M), 1.0)


@pytest.mark.parametrize('seed', range(8))
def test_bare_quartz_has_the_published_slopes(seed: int) -> None:
    """
    Q-Flex class: scale slope 68..87 ppm/K from 5 to 35 degC with 0.31 ppm/K^2 of curvature, bias
    slope 0.3..5 ug/K.
    """
    unit = unit_preset('bare-quartz', seed)
    board = np.array([4.5, 5.5, 19.5, 20.0, 20.5, 34.5, 35.5])
    bias, scale = _static(unit, board)
    cold, hot = (scale[1] - scale[0]) * 1e6, (scale[6] - scale[5]) * 1e6
    # Specimens scatter by 1 % of the slope about the published values.
    np.testing.assert_allclose(cold, 68.0, atol=1.5)
    np.testing.assert_allclose(hot, 87.0, atol=1.5)
    curvature = 2.0 * (scale[4] + scale[2] - 2.0 * scale[3]) * 1e6
    np.testing.assert_allclose(curvature, 0.31, rtol=0.03)
    slope = np.abs(bias[4] - bias[2])
    assert np.all((slope > 0.29) & (slope < 5.05))


@pytest.mark.parametrize('seed', range(8))
def test_mems_bias_moves_by_hundreds_of_micro_g(seed: int) -> None:
    bias, _ = _static(unit_preset('mems', seed), np.array([19.5, 20.5]))
    slope = np.abs(bias[1] - bias[0])
    assert np.all((slope > 90.0) & (slope < 550.0))


def test_specimens_differ_and_return() -> None:
    for name in NAMES:
        assert unit_of(name, 1) == unit_of(name, 1)
        assert unit_of(name, 1) != unit_of(name, 2)
        assert unit_of(name, 1).serial == f'{name}-0001'
    with pytest.raises(ValueError, match=r"`name` must be one of thermostatted, .*, got 'laser'"):
        unit_preset('laser')

    # Noise of the reference: 5 ug/sqrt(Hz) over 60 s is 0.65 ug; a count per minute at 10 Hz adds
    # 0.23.
