# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The claimed covariance covers a start in a ramp, a lost thermometer, and forces beyond 1 g."""

import math
from dataclasses import replace

import numpy as np
import pytest
from builders import GRAVITY, SECOND_NS, UNCHECKED, axis_set, calibration, regime_set, term, warm

from thermo_comp.online.compensator import Compensator
from thermo_comp.unit.calibration import LackOfFit
from thermo_comp.unit.prediction import ramp_states, sd_of_states


def test_the_claimed_sd_covers_a_start_in_a_ramp():
    # WHY: after a restart in a ramp the claimed sd was a third of the error. At the start the lag
    # of a part is unknown: it is 1 K (rate times time constant) in this ramp, and has an sd of 0.4
    # K at rest. The claimed sd must not change if the ramp ends 40 s after the start.
    unit = calibration(response=(term('board', (30.0, 0.0, 0.0), tau_s=60.0),))
    sd = {}
    for rate, end in ((0.0, 60), (1.0 / 60.0, 60), (1.0 / 60.0, 40)):
        compensator = Compensator(unit, UNCHECKED)
        for second in range(61):
            stamp, risen = 10**12 + second * SECOND_NS, rate * min(second, end)
            # Exactly constant readings would make both thermometers count as faulty.
            flicker = 1e-5 * (-1) ** second
            compensator.push('board', stamp, 10.0 + risen + flicker)
            compensator.push('case', stamp, 10.0 + risen - flicker)
            row = compensator.process(stamp, 0.0, 0.0, 1.0)
        sd[rate, end] = math.sqrt(row[3] - compensator.thermal.correction.noise[0])
    # Sensitivity 30 counts per K of the lag, scale factor 300 counts per m/s^2; after 60 s, one
    # time constant, a lag error has decayed to 1 / e.
    left = 30.0 / 300.0 / math.e
    assert sd.pop((0.0, 60)) == pytest.approx(0.387 * left, rel=0.2)
    assert [*sd.values()] == pytest.approx([math.hypot(1.0, 0.387) * left] * 2, rel=0.2)


def test_if_the_case_sensor_is_lost_the_gradient_is_its_last_value_at_rest():
    # WHY: the board is 1 K warmer than the case, but after a loss of the case 0 K was assumed.
    unit = calibration(response=(term('gradient', (30.0, 0.0, 0.0)),))
    compensator = Compensator(unit, UNCHECKED)
    corrected = []
    for second in range(2000):
        stamp = 10**12 + second * SECOND_NS
        # The readings change by some mK, as a thermometer with constant readings counts as faulty.
        compensator.push('board', stamp, 20.0 + 2e-3 * (second % 3))
        if second < 1500:
            compensator.push('case', stamp, 19.0 + 2e-3 * (second % 5))
        corrected.append(compensator.process(stamp, 300.0, 300.0, 2943.0 + second % 2))
    # An error of the gradient of 0.1 K is 3 counts, or 0.01 m/s^2 at 300 counts per m/s^2.
    assert corrected[-1][0] == pytest.approx(corrected[1499][0], abs=0.01)


def test_if_the_case_sensor_never_reads_the_gradient_is_that_of_the_fit_at_rest():
    of_gradient = (term('gradient', (30.0, 0.0, 0.0)),)
    unit = calibration(response=of_gradient, rest_gradient_range_k=(-1.1, -0.9))
    compensator = Compensator(unit, UNCHECKED)
    for second in range(60):
        stamp = 10**12 + second * SECOND_NS
        compensator.push('board', stamp, 20.0 + 2e-3 * (second % 3))
        row = compensator.process(stamp, 300.0, 300.0, 2943.0 + second % 2)
    # A gradient of -1 K changes the raw value by -30 counts, or 0.1 m/s^2.
    assert row[0] == pytest.approx(1.1, abs=0.01)
    assert not compensator.thermal.tracker.loose_k(-1.0)


def test_beyond_1_g_the_covariance_includes_an_unknown_k2():
    # Rests do not determine K2, the error proportional to the square of the force. Its assumed sd
    # is 100 ug/g^2, for forces above 1.01 g.
    compensator = Compensator(calibration(), UNCHECKED)
    warm(compensator, start_s=1000, until_s=1001)
    at_1_g, at_4_g = (
        compensator.process(10**12 + k * 10**6, 0.0, 0.0, 300.0 * 9.80665 * force)
        for k, force in enumerate((1.0, 4.0))
    )
    grown = 9.80665e-4 * (4.0 - 1.01) ** 2
    assert math.sqrt(at_4_g[8] - at_1_g[8]) == pytest.approx(grown, rel=0.01)
    assert at_4_g[3] == pytest.approx(at_1_g[3])


@pytest.mark.parametrize('fault', ['both stand still', 'swapped topics'])
def test_the_claimed_sd_covers_thermometer_errors_for_parts_that_lag_the_board(fault):
    # WHY: the claimed sd lacked the effect of lasting errors of the board temperature. The bias
    # depends on a part that lags the board by 10 min, so a short error hardly changes the output.
    per_kelvin, axis = 30.0, axis_set((0.0, 30.0))
    part = term('board', (-per_kelvin, 0.0, 0.0), tau_s=600.0)
    parts = regime_set(x=axis, rate_range_k_min=(-5.0, 5.0))
    compensator = Compensator(
        calibration(static=parts, dynamic=parts, response=(part,), board_lag_s=60.0), UNCHECKED
    )
    of_part, errors, sds = 20.0, [], []
    for second in range(3600):
        stamp = 10**12 + second * SECOND_NS
        ramp_s = max(second - 1200.0, 0.0)
        # The case ramps at 1 K/min; the board lags the case by 60 s, which is 1 K.
        case, board = 20.0 + ramp_s / 60.0, 20.0 + max(ramp_s - 60.0, 0.0) / 60.0
        of_part += (board - of_part) / 600.0
        flicker = 2e-3 * (second % 3)
        readings = {'board': board + flicker, 'case': case - flicker}
        if fault == 'swapped topics':
            readings = {'board': readings['case'], 'case': readings['board']}
        elif second >= 1500:
            readings = {'board': 24.0, 'case': 25.0}
        for name, celsius in readings.items():
            compensator.push(name, stamp, celsius)
        if second % 4:
            continue
        row = compensator.process(stamp, per_kelvin * (of_part - 20.0), 0.0, 2943.0)
        if second >= 1800:
            errors.append(row[0])
            sds.append(math.sqrt(row[3] - compensator.thermal.correction.noise[0]))
    ratio = np.abs(errors) / sds
    assert ratio.max() < 3.0
    assert ratio.max() > 0.1


def test_the_lack_of_fit_is_divided_between_bias_and_scale():
    # WHY: the certificate stated an sd of 11 ppm for a scale factor at temperatures at which no
    # position had gravity along the axis, and added the whole unknown error to the bias.
    lacks = LackOfFit(0.0, (0.0, 3e-3, 4e-3)), LackOfFit(20.0, (0.0, 0.0, 0.0))
    plain = calibration()
    lacking = replace(plain, static=replace(plain.static, lack_of_fit=lacks))
    states = ramp_states(plain, np.array([0.0, 20.0]))
    before, after = (np.square(sd_of_states(unit, states)) for unit in (plain, lacking))
    added = np.array([[0.0, 3e-3, 4e-3], [0.0, 0.0, 0.0]]) ** 2
    np.testing.assert_allclose(after[0] - before[0], added, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(after[1] - before[1], added / GRAVITY**2, rtol=1e-9, atol=1e-18)
