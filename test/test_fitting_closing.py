# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A fit estimates correlated noise, and selects models by the evidence or by left-out data."""

from dataclasses import replace
from types import SimpleNamespace as Parts

import numpy as np
import pytest
from test_fitting import FACES, sources_of
from triads import triad

from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.left_out import Folds, Score, is_better, is_undecided
from thermo_comp.fitting.selection import Trial, better_start
from thermo_comp.fitting.series import Whitener
from thermo_comp.fitting.unknowns import Noise
from thermo_comp.simulation.campaign import Position, parse_cyclogram
from thermo_comp.simulation.run import arrays
from thermo_comp.thermal.settings import DetectorSettings
from thermo_comp.thermal.state import WEIGHT
from thermo_comp.thermal.tracker import ThermalTracker
from thermo_comp.unit.gravity import MICRO_G, STANDARD_GRAVITY

#: Chamber program of a bag; in its soaks the board settles.
PROGRAM = parse_cyclogram('20 40min, 45@1.5 120min')
#: Bias in the dynamic regime less bias in the static regime [m/s^2]; noise of a window: 2 ug.
STEP = np.array([120.0, -80.0, 60.0]) * MICRO_G


def weight(record, end_condition):
    """Return the weight of the dynamic curves at each sample, with the true detector settings."""
    tracker = ThermalTracker(replace(DetectorSettings(), end_condition=end_condition))
    readings = sorted(
        (stamp, name, value)
        for name, stamps, values in (
            ('board', record.board_stamp_ns, record.board),
            ('case', record.case_stamp_ns, record.case),
        )
        for stamp, value in zip(stamps.tolist(), values.tolist(), strict=True)
    )
    at, result = 0, []
    # The weights change over 300 s, so every fourth sample (at 2 Hz) suffices.
    for stamp in record.accel_stamp_ns[::4].tolist():
        while at < len(readings) and readings[at][0] <= stamp:
            tracker.read(readings[at][1], readings[at][0], readings[at][2])
            at += 1
        result.append(tracker.sample(stamp)[WEIGHT])
    return np.repeat(result, 4)[: len(record.accel_stamp_ns)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ('end_condition', 'options'),
    [('board', {'model': 'golovach'}), ('case', {'groups': ('curve', 'set', 'board')})],
)
def test_the_evidence_selects_the_condition_that_ends_the_dynamic_regime(end_condition, options):
    # A reading every four seconds suffices: the case changes by at most 0.1 K in 4 s.
    unit = triad('plain', 1).with_thermometers(rate_hz=0.25)
    records = []
    for record in arrays(unit, [Position(PROGRAM, up) for up in FACES[:4]], 11, rate_hz=2.0):
        step = np.outer(weight(record, end_condition), STEP * unit.scale_factor)
        records.append(replace(record, counts=record.counts + step))
    result = fit(sources_of(records), FitOptions(gravity=STANDARD_GRAVITY, **options))
    assert result.calibration.detector.end_condition == end_condition
    # The estimated detector settings switch the regime at slightly different times.
    last = result.residuals[-1]
    assert last.fitted.rms < 0.35 * last.raw.rms


@pytest.mark.parametrize(
    'noise',
    [
        *(Noise(), Noise(1e-6, 30.0), Noise(1e-2, 1e4), Noise(10.0, 3.0), Noise(1e3, 1e4)),
        *(Noise(1e-2, 30.0, 3), Noise(10.0, 3.0, 4)),
    ],
)
def test_products_and_determinant_equal_those_of_the_dense_matrix(rng, noise):
    # Four positions of 7, 1, 12 and 4 windows, with a gap in the third, and random weights.
    position = np.repeat(np.arange(4), (7, 1, 12, 4))
    steps = rng.uniform(1.0, 9.0, len(position))
    steps[12] = 4000.0
    time = np.concatenate([100.0 * p + np.cumsum(steps[position == p]) for p in range(4)])
    weight = rng.uniform(0.1, 3.0, len(position))
    series = rng.standard_normal((len(time), 5))
    whitener = Whitener(position, time)
    white = whitener.filter(series, weight, noise)
    # Noise with exponential correlation in each position, plus white noise, has this covariance.
    distance = np.abs(time[:, None] - time)
    times_s = [noise.time_s * 10.0**k for k in range(noise.n_times)]
    slow = noise.ratio * sum(np.exp(-distance / time_s) for time_s in times_s)
    covariance = np.where(position[:, None] == position, slow, 0.0) + np.diag(1.0 / weight)
    expected = series.T @ np.linalg.solve(covariance, series)
    # The tolerance allows for rounding, as condition numbers of the covariance are below 1e6.
    np.testing.assert_allclose(white.T @ white, expected, rtol=1e-9, atol=1e-10)
    determinant = np.linalg.slogdet(covariance)[1]
    assert whitener.log_determinant(weight, noise) == pytest.approx(determinant, abs=1e-9)


def drawn(rng, n, steps, noise):
    """Draw Gauss-Markov noise plus white noise of n positions on three axes."""
    time = np.cumsum(rng.uniform(20.0, 100.0, steps))
    weight = rng.uniform(0.3, 1.0, steps)
    slow = np.sqrt(noise.ratio) * rng.standard_normal((n, steps, 3))
    for k, decay in enumerate(np.exp(-np.diff(time) / noise.time_s), start=1):
        slow[:, k] = decay * slow[:, k - 1] + np.sqrt(1.0 - decay**2) * slow[:, k]
    series = slow + rng.standard_normal((n, steps, 3)) / np.sqrt(weight)[:, None]
    whitener = Whitener(np.repeat(np.arange(n), steps), np.tile(time, n))
    return whitener, np.tile(weight, n), series.reshape(-1, 3)


@pytest.mark.parametrize('noise', [Noise(1.0, 600.0), Noise(0.3, 2000.0), Noise(30.0, 300.0)])
def test_variance_ratio_and_correlation_time_are_estimated(rng, noise):
    # 240 correlation times of data determine the variance to 9 %, the correlation time to 15 %.
    whitener, weight, series = drawn(rng, 9, 300, noise)
    fitted = whitener.estimate(5.0 * series, weight)
    assert 0.5 < fitted.ratio / noise.ratio < 2.0
    assert 0.5 < fitted.time_s / noise.time_s < 2.0
    # The search tries correlation times up to a sixth of a position, which lasts 2000 s at most.
    whitener, weight, series = drawn(rng, 12, 20, Noise(100.0, 1e5))
    assert 0.0 < whitener.estimate(series, weight).time_s <= 20.0 * 100.0 / 5.0
    # Gauss-Markov noise is found in 1 % of all series of white noise, but in none of these.
    for _ in range(4):
        whitener, weight, series = drawn(rng, 5, 100, Noise())
        assert whitener.estimate(series, weight) == Noise()
    alone = Whitener(np.arange(3), np.zeros(3))
    assert alone.estimate(rng.standard_normal((3, 3)), np.ones(3)) == Noise()


MICRO = 9.80665e-6  # a micro-g [m/s^2]


def score(drift, norms=(), by_thermometer=0.0, by_offsets=0.0):
    """Return the score of drifts `drift` and errors of |f| `norms` on left-out data [ug]."""
    drifts = Folds(np.full(18, (drift * MICRO) ** 2), np.full(18, 20.0))
    of_norms = Folds((np.array(norms) * MICRO) ** 2, np.full(len(norms), 20.0))
    none = np.zeros((0, 3))
    given = {'by_thermometer': by_thermometer * MICRO, 'by_offsets': by_offsets * MICRO}
    return Score(drifts, drifts, of_norms, none, none, drifts, **given)


def test_neither_few_norms_nor_errors_of_a_coarse_thermometer_select_a_model():
    # WHY: only four left-out |f| of six faces were predicted, and these rejected a right curve.
    constants = score(20.0, [22.4, 457.7, 54.6, 26.1])
    curve = score(20.0, [16.8, 21.0, 22.5, 25.2])
    assert not is_better(constants, curve)
    assert is_undecided(constants, curve)
    assert not is_undecided(curve, constants)
    assert is_better(constants, score(20.0, [2.0, 40.0, 5.0, 2.0]))
    # WHY: knees fitted errors of readings in steps of 1 K, which are equal in all bags.
    by_thermometer = 49.0
    curve, parts, bends = (score(drift, (), by_thermometer) for drift in (120.0, 46.0, 20.0))
    assert is_better(curve, parts)
    assert not is_better(parts, bends)
    flat, curved = (score(46.0, size * np.ones(9), by_thermometer) for size in (3000.0, 60.0))
    assert is_better(flat, curved)
    assert not is_better(curved, score(20.0, 30.0 * np.ones(9), by_thermometer))
    assert is_better(score(46.0, (), 5.0), score(20.0, (), 5.0))


def test_left_out_norms_that_stated_offsets_explain_do_not_reject_a_model():
    # WHY: random differences of left-out |f| rejected lags that reduce the drift from 9.4 to 1 ug.
    norms = np.array([1016.0, 142.0, 1258.0, 244.0, 647.0, 467.0])
    for by_offsets, is_accepted in ((700.0, True), (300.0, False)):
        curve = score(9.4, norms, by_offsets=by_offsets)
        parts = score(1.0, norms * (1.6, 2.8, 1.2, 2.2, 1.3, 1.5), by_offsets=by_offsets)
        assert is_better(curve, parts) == is_accepted
    # The drifts are equal and offsets explain the smaller |f| errors, so no model is better.
    assert not is_better(score(1.0, norms, by_offsets=700.0), score(1.0, 0.5 * norms))


def test_a_fit_with_large_mounting_offsets_must_not_increase_left_out_norms():
    # WHY: a fit with mounting offsets of 5 mg had a larger evidence, but a force error of 5 mg.
    def trial(norm, log_evidence):
        prior, layout = Parts(offset_scale=0.0, informative=None), Parts(pose=np.zeros(0))
        posterior = Parts(prior=prior, layout=layout, log_evidence=log_evidence)
        return Trial((), score(17.0, norm * np.linspace(0.5, 1.5, 12)), posterior, np.zeros(0))

    small, spoilt, likelier = trial(67.0, 54462.0), trial(33564.0, 55002.0), trial(67.0, 55002.0)
    assert better_start([small, spoilt]) is small
    assert better_start([small, likelier]) is likelier
