# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns simulated rests of a unit, in the form in which the node logs them."""

from dataclasses import replace

import builders
import numpy as np

from thermo_comp.field.rest import Rest, Start, encode
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.correction import Correction
from thermo_comp.unit.gravity import MICRO_G
from thermo_comp.unit.posterior import posterior_of
from thermo_comp.unit.prediction import ramp_states

DAY_NS = 86_400 * 10**9
#: The day 2030-01-01 in days since 1970; it is later than the date of any calibration in tests.
FIRST_DAY = 21_915
ZERO = np.zeros(3)


def rests(calibration, attitudes, error, days=20, seed=1, turn_on=20.0 * MICRO_G, rate=0.0):
    """Draw rests: 3 turn-ons a day of 4 windows; `error(day)`: bias error; `rate`: ramp [K/s]."""
    rng = np.random.default_rng(seed)
    correction = Correction(calibration)
    M, logged = np.array(calibration.misalignment), []
    noise = np.array(calibration.noise_density_m_s2_sqrt_hz) / np.sqrt(10.0)
    shares = (0.0,) * len(correction.memory.lags)
    for k in range(3 * days):
        since = k / 3.0
        begin = int((FIRST_DAY + 0.3 + since) * DAY_NS)
        start = Start(
            begin, calibration.unit.serial, calibration.unit.input, calibration.gravity_m_s2,
            'laboratory', correction.memory,
        )  # fmt: skip
        offset = error(since) + turn_on * rng.standard_normal(3)
        state = ramp_states(calibration, rng.uniform(15.0, 25.0, 1), rate, 3600.0)
        state[:, 1] = 1e-8
        bias, scale = correction.bias_scale(state.T)[:, :, 0]
        force = calibration.gravity_m_s2 * np.linalg.solve(M, attitudes(rng))
        for window in range(4):
            x = force + offset + noise * rng.standard_normal(3)
            sd = noise * np.sqrt(1000.0) * np.abs(correction.K[:, 0])
            mean = tuple((bias + scale * x).tolist())
            stamp = begin + (window + 1) * 10 * 10**9
            logged.append((start, Rest(stamp, 1000, mean, tuple(sd), tuple(state[0]), shares)))
    return logged


def write_log(folder, found):
    folder.mkdir(parents=True)
    for start, rest in found:
        day = np.datetime64(rest.stamp_ns, 'ns').astype('datetime64[D]')
        with (folder / f'{day}.rests').open('ab') as file:
            file.write(encode(start) + encode(rest))
    return folder


def upright(_rng):
    return np.array([0.0, 0.0, 1.0])


def in_any_attitude(rng):
    u = rng.standard_normal(3)
    return np.asarray(u / np.linalg.norm(u))


def precise(**keys):
    """Make a calibration with an sd of 10 ug of each bias and of 10 ppm of each scale factor."""
    value = builders.calibration(noise_density_m_s2_sqrt_hz=(60 * MICRO_G,) * 3, **keys)
    layout = parameter_layout(value)
    sd = np.zeros(layout.n_parameters)
    to_file = np.zeros((layout.n_parameters, 6))
    for axis in range(3):
        bias, scale = layout.bias[axis], layout.scale[axis]
        to_file[[bias.static, bias.dynamic], axis] = 300.0 * 10 * MICRO_G
        to_file[[scale.static, scale.dynamic], axis + 3] = 10e-6
    sd[layout.misalignment :] = 1e-6
    return replace(value, posterior=posterior_of(to_file @ to_file.T + np.diag(sd**2)))


def no_error(_days):
    return ZERO


def jump_of(size, day):
    return lambda days: size * MICRO_G * np.array([0.0, 0.0, float(days >= day)])
