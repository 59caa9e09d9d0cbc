# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The fit as a whole, on simulated units whose truth is known.

"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from thermo_comp.errors import FitError
from thermo_comp.fitting import ArrayBlock, FitOptions, FitResult, FitSource, fit
from thermo_comp.simulation import STANDARD_GRAVITY, cyclogram_preset, positions, unit_preset
from thermo_comp.simulation.run import simulate_blocks

RATE_HZ = 50.0


def simulated_source(preset: str, cyclogram: str, up: np.ndarray, seed: int) -> FitSource:
    unit = unit_preset(preset, 1)

    def blocks() -> Iterator[ArrayBlock]:
        for run in simulate_blocks(
            unit, cyclogram_preset(cyclogram), up, rate_hz=RATE_HZ, seed=seed
        ):
            yield ArrayBlock(
                run.accel_stamp_ns,
                run.counts.astype(float),
                run.board_stamp_ns,
                run.board,
                run.case_stamp_ns,
                run.case,
            )

    return FitSource(f'bag{seed}', blocks, serial=unit.serial)


@pytest.fixture(scope='module')
def golovach() -> FitResult:
    sources = [
        simulated_source('thermostatted', 'demo', up, seed)
        for seed, up in enumerate(positions(12, 0))
    ]
    return fit(sources, FitOptions(gravity=STANDARD_GRAVITY, model='golovach'))


def test_first_fit_finds_the_unit(golovach: FitResult) -> None:
    unit = unit_preset('thermostatted', 1)
    axes = golovach.calibration.axes
    # The paper's scheme leaves some 100 ug on this unit's ramps, so K and the bias are known to
    # about 100 ppm and 100 ug; M does not depend on temperature and comes out to a few ppm.
    found = [axes.x.scale_factor, axes.y.scale_factor, axes.z.scale_factor]
    np.testing.assert_allclose(found, unit.scale_factor, rtol=3e-4)
    micro_g = np.array(unit.scale_factor) * STANDARD_GRAVITY * 1e-6
    bias = np.array([axes.x.bias, axes.y.bias, axes.z.bias])
    assert np.abs((bias - unit.bias_at_reference) / micro_g).max() < 300.0
    np.testing.assert_allclose(golovach.calibration.misalignment, unit.M, atol=3e-5)


def test_two_regimes_beat_one_set_beats_raw(golovach: FitResult) -> None:
    # On the ramps and over all; this short program has too few soaks to compare those.
    for row in golovach.residuals[1:]:
        assert row.fitted.rms < row.one_set.rms < row.raw.rms, row.section


def test_attitudes_have_unit_norm(golovach: FitResult) -> None:
    up = np.array([position.up for position in golovach.positions])
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1.0, rtol=1e-14)
    # Found within some 100 urad of the true direction, without ever being told.
    np.testing.assert_allclose(up, positions(12, 0), atol=3e-4)


def test_too_few_positions_are_refused() -> None:
    sources = [simulated_source('mems', 'demo', up, 0) for up in positions(3, 0)]
    with pytest.raises(FitError, match='3 still positions, need 6'):
        fit(sources, FitOptions(gravity=STANDARD_GRAVITY))


def test_no_source_is_refused() -> None:
    with pytest.raises(FitError, match='no bag was given'):
        fit([], FitOptions(gravity=STANDARD_GRAVITY))
