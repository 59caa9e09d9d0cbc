# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""What the fit claims of real units, against what they do from position to position."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders import ArrayBlock

from thermo_comp.fitting import FitOptions, FitSource, fit_bags
from thermo_comp.fitting.posterior import Regression
from thermo_comp.fitting.reduction import reduce_source
from thermo_comp.fitting.windows import FEWEST_WINDOWS
from thermo_comp.unit.gravity import STANDARD_GRAVITY


def ratio(path: Path) -> float:
    """Fit one log; jackknife over its positions, in units of the claimed sd."""
    accel = np.loadtxt(path, usecols=(0, 1, 2))
    stamps = np.arange(len(accel), dtype=np.int64) * 10_000_000
    nothing_ns, nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
    block = ArrayBlock(stamps, accel, nothing_ns, nothing, nothing_ns, nothing)
    options = FitOptions(gravity=STANDARD_GRAVITY, input='m/s^2')
    source = FitSource(path.stem, lambda: [block])
    short = {'window_s': 1.0, 'cell_s': 0.2, 'min_rest_s': 1.0, 'fewest_windows': FEWEST_WINDOWS}
    bags = [reduce_source(source, full_scale=None, **short)]
    result = fit_bags(bags, options)
    posterior, prior = result.learnt.posterior, result.learnt.prior
    axes = (result.calibration.axes.x, result.calibration.axes.y, result.calibration.axes.z)
    nominal = np.array([axis.scale_factor for axis in axes]) / posterior.state.kappa
    regression = Regression(result.windows.data, STANDARD_GRAVITY, nominal)
    places = np.concatenate((posterior.layout.kappa, posterior.layout.bias, posterior.layout.skew))
    found = []
    for p in range(result.windows.data.n_positions):
        state = regression.without(posterior, prior, p)
        if state is not None:
            found.append(np.concatenate((state.kappa, state.bias, state.skew)))
    n = len(found)
    scatter = np.var(np.array(found), axis=0) * (n - 1)
    return float(np.sqrt(np.mean(scatter / posterior.variance[places])))


def test_claimed_sd_is_the_jackknife_s(real_data: Path) -> None:
    logs = [real_data / f'mikoff-mpu9150/mk_imu{k}.log' for k in range(3)]
    if not all(path.is_file() for path in logs):
        pytest.skip('the logs of the MPU-9150 units are not there')
    ratios = [ratio(path) for path in logs]
    # Some 20 positions each, nine parameters: a jackknife knows the sd to 15 %.
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4, ratios
