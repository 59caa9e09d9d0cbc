# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Mode, covariance, evidence and left-out errors of the fit agree with dense linear algebra."""

from dataclasses import replace

import numpy as np
import pytest
from fitting_truth import (
    GRAVITY,
    GROUPS,
    MICRO,
    NOMINAL,
    START,
    Truth,
    begin,
    column_sd,
    mode_of,
    prior_of,
    rows_of,
    table_of,
    without_starts,
)
from scipy.optimize import least_squares

from thermo_comp.errors import FitError
from thermo_comp.fitting.elimination import factored
from thermo_comp.fitting.initial_triad import constant_calibration
from thermo_comp.fitting.left_out import score_of
from thermo_comp.fitting.regression import Regression
from thermo_comp.fitting.unknowns import Noise, State, inverse_misalignment, tangent_basis

#: Sd by which attitudes differ from their common pose [rad].
POSE_SD = 1e-4


class Dense:
    """The posterior of a `Regression` by dense linear algebra and numerical derivatives."""

    def __init__(self, regression, prior, at):
        self.windows, self.prior, self.at = regression.windows, prior, at
        self.start_root = regression.start_root
        self.n = at.layout.n
        windows = self.windows
        same = windows.position[:, None] == windows.position
        distance = np.abs(windows.time[:, None] - windows.time)
        slow = np.where(same, np.exp(-distance / prior.noise.time_s), 0.0) * prior.noise.ratio
        noise = np.linalg.cholesky(slow + np.diag(1.0 / windows.weight))
        self.roots = [np.linalg.inv(sigma * noise) for sigma in prior.sigma]
        self.determinant = -2.0 * sum(np.log(np.diag(root)).sum() for root in self.roots)

    def state(self, x):
        """Return the state whose parameters differ by x from the mode of `Regression`."""
        layout, at = self.at.layout, self.at.state
        padded = np.append(x, 0.0)
        pose, pose_of = at.pose, at.pose_of
        up = at.up + np.einsum('pij,pj->pi', tangent_basis(at.up), x[layout.up])
        if len(pose):
            basis = tangent_basis(pose)
            pose = pose + np.einsum('kij,kj->ki', basis, x[layout.pose])
            pose = pose / np.linalg.norm(pose, axis=1, keepdims=True)
            turn = x[layout.up] + x[layout.pose][pose_of]
            turned = at.up + np.einsum('pij,pj->pi', basis[pose_of], turn)
            up = np.where(pose_of[:, None] < 0, up, turned)
        return State(
            at.kappa + x[layout.kappa], at.bias + x[layout.bias],
            at.weights + padded[layout.weights], at.misalignment + x[layout.misalignment],
            up / np.linalg.norm(up, axis=1, keepdims=True), at.offset + x[layout.offset],
            at.tilt + x[layout.tilt], at.start + x[layout.start], at.turn_on + x[layout.turn_on],
            pose=pose, pose_of=pose_of,
        )  # fmt: skip

    def residual(self, x):
        """Return residual / sd of each window, and (parameter - prior mean) / prior sd."""
        w, prior, state = self.windows, self.prior, self.state(x)
        rms = np.sqrt(np.mean(w.columns**2, axis=0))
        moved = w.columns.copy()
        for k in np.flatnonzero(w.lag >= 0):
            start = state.start @ self.start_root.T
            moved[:, k] += w.start[:, k] * start[w.bag, w.lag[k]]
        moved /= rms
        A = inverse_misalignment(state.misalignment)
        force = GRAVITY * state.up[w.position] @ A.T
        predicted = state.kappa * force * (1.0 + moved @ state.weights[1].T)
        across = np.einsum('pij,pkj->pki', state.tangents, state.tilt)[w.position]
        predicted += state.kappa * GRAVITY * np.einsum('nk,nki->ni', w.tilt, across) @ A.T
        predicted += state.bias + moved @ state.weights[0].T + state.offset[w.position]
        if state.turn_on.size:
            predicted += state.turn_on[w.bag]
        left = w.mean / NOMINAL - predicted
        parts = [self.roots[axis] @ left[:, axis] for axis in range(3)]
        parts += [
            (state.kappa - 1.0) / prior.scale_sd,
            state.bias / prior.bias_sd,
            state.misalignment / prior.misalignment_sd,
            state.offset.ravel() / prior.offset_sd,
            state.tilt.ravel() / prior.tilt_sd,
            state.turn_on.ravel() / prior.turn_on_sd,
            state.start.ravel() / np.sqrt(prior.start_variance_ratio),
            # The mean initial lag state over all bags has 0.1 of the prior sd of one bag's state.
            state.start.mean(axis=0) / (0.1 * np.sqrt(prior.start_variance_ratio)),
        ]
        if len(state.pose):
            posed = state.pose_of[state.pose_of >= 0]
            basis = tangent_basis(self.at.state.pose)[posed]
            change = state.up[state.pose_of >= 0] - state.pose[posed]
            from_pose = np.einsum('pi,pij->pj', change, basis)
            # Each pose has a prior sd of 1 rad about its value at the mode.
            parts += [from_pose.ravel() / prior.pose_sd, x[self.at.layout.pose].ravel()]
        for weights, sd in zip(state.weights, prior.column_sd, strict=True):
            parts.append((weights[:, sd > 0.0] / sd[sd > 0.0]).ravel())
        return np.concatenate(parts)

    def jacobian(self, x):
        """Return the Jacobian by central differences over 0.1 sd, which have an error of 1e-9."""
        sd = np.sqrt(self.at.variance)
        columns = []
        for k in range(self.n):
            step = np.zeros(self.n)
            step[k] = 0.1 * sd[k]
            columns.append((self.residual(x + step) - self.residual(x - step)) / (2.0 * step[k]))
        return np.column_stack(columns)


@pytest.fixture(
    scope='module',
    params=[(1, ()), (4, ()), (1, (0,) * 10), (1, (0,) * 5 + (1,) * 4 + (-1,))],
    ids=['a position per bag', 'up to 4', 'one pose', 'two poses'],
)
def solved(request):
    n_positions, pose_of = request.param
    rng = np.random.default_rng(5)
    # The bag of one position has a random initial lag state, a bag of several positions has 0.
    truth = Truth(
        start_sd=0.5 if n_positions == 1 else 0.0, noise=Noise(4.0, 2000.0),
        offset_sd=2.0 * MICRO, tilt_sd=2e-7 if pose_of else 5e-6,
    )  # fmt: skip
    pose, up = (np.array(pose_of) if pose_of else None), None
    if pose_of:
        # Each attitude differs by `POSE_SD` from one of three poses.
        poses = np.array([[0.577, 0.577, 0.578], [-0.577, 0.578, 0.577], [0.578, -0.577, 0.577]])
        up = poses[pose] + POSE_SD * rng.standard_normal((len(pose), 3))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
    windows, up = table_of(truth, 10, rng, n_windows=12, step_s=400.0, up=up)
    weight = rng.uniform(0.3, 1.0, len(windows.time))
    windows = replace(windows, weight=weight, bag=windows.position // n_positions, pose=pose)
    regression, state = begin(windows, up)
    # One or two poses do not determine bias, scale and M: narrow priors limit their changes.
    narrow = {'scale_sd': 1e-5, 'misalignment_sd': 1e-5, 'bias_sd': np.full(3, 1e-4)}
    narrow['column_sd'] = column_sd(('curve', 'board'), 1e-2, 1e-5)
    narrow = narrow if pose_of else {}
    prior = prior_of(truth, start_variance_ratio=0.7, pose_sd=POSE_SD, **narrow)
    return regression, prior, mode_of(regression, state, prior)


def test_mode_covariance_and_evidence_agree_with_dense_linear_algebra(solved):
    regression, prior, fitted = solved
    dense = Dense(regression, prior, fitted)
    at, sd = dense.residual(np.zeros(dense.n)), np.sqrt(fitted.variance)
    assert np.abs(dense.jacobian(np.zeros(dense.n)).T @ at * sd).max() < 1e-4
    other = least_squares(dense.residual, np.zeros(dense.n), x_scale=sd, method='trf').x
    assert np.abs(other / sd).max() < 1e-3
    np.testing.assert_allclose(regression.start_root @ regression.start_root.T, START, atol=1e-12)
    beside = []
    for share in (prior.start_variance_ratio, 0.1):
        wide = replace(prior, start_variance_ratio=share)
        mode = mode_of(regression, fitted.state, wide)
        dense = Dense(regression, wide, mode)
        at, jacobian = dense.residual(np.zeros(dense.n)), dense.jacobian(np.zeros(dense.n))
        hessian, sd, n = jacobian.T @ jacobian, np.sqrt(mode.variance), mode.layout.n_unit
        covariance = np.linalg.inv(hessian * np.outer(sd, sd))[:n, :n]
        # Correlations of 0.999 in the Hessian lose three of the eight digits of the derivatives.
        correlation = mode.covariance / np.outer(sd[:n], sd[:n])
        np.testing.assert_allclose(correlation, covariance, atol=1e-4)
        assert np.diag(covariance) == pytest.approx(1.0, rel=1e-4)
        # Laplace's formula: -2 ln Z = misfit + ln det(noise) + ln det(prior) + ln det(Hessian).
        precision = regression.precision(wide, mode.layout)
        known = np.log(precision[precision > 0.0]).sum()
        determinants = dense.determinant + np.linalg.slogdet(hessian)[1] - known
        beside.append(mode.log_evidence + 0.5 * (at @ at + determinants))
    # The evidence less this formula is a constant that `start_variance_ratio` does not change.
    assert beside[1] == pytest.approx(beside[0], abs=1e-3)


def test_errors_of_the_regression_divided_by_the_claimed_sd_have_an_rms_of_1():
    # The RMS of error / sd of 36 units with 33 correlated parameters is uncertain by 13 % at most.
    rng = np.random.default_rng(11)
    truth = Truth(noise=Noise(0.5, 1000.0), offset_sd=MICRO, start_sd=0.3)
    errors = []
    for _ in range(36):
        windows, up = table_of(truth, 12, rng, n_windows=15, step_s=320.0)
        regression, state = begin(windows, up)
        errors.append(truth.errors(regression, regression.solve(state, prior_of(truth))))
    every = {name: np.concatenate([error[name] for error in errors]) for name in errors[0]}
    for name, values in every.items():
        assert 0.7 < np.sqrt(np.mean(values**2)) < 1.4, name
    assert np.sqrt(np.mean(np.concatenate([*every.values()]) ** 2)) == pytest.approx(1.0, abs=0.1)


def refit_of(whole, regression, prior, kept):
    """Fit the rows `kept`; return weights in units of the column RMS of the whole table."""
    windows = regression.windows
    rest = Regression(rows_of(windows, np.flatnonzero(kept)), GRAVITY, NOMINAL)
    units = rest.rms / regression.rms
    there = np.unique(windows.position[kept])
    state = replace(
        whole.state, weights=whole.state.weights * units,
        **{name: getattr(whole.state, name)[there] for name in ('up', 'offset', 'tilt', 'start')},
    )  # fmt: skip
    mode = mode_of(rest, state, replace(prior, column_sd=prior.column_sd * units)).state
    return replace(mode, weights=mode.weights / units)


#: The left-out score linearises the model: it is exact for LINEAR, and approximate for PRODUCTS.
LINEAR, PRODUCTS = ('curve',), ('curve', 'board')


def scored(groups, n, rng, *, n_windows, step_s, **changes):
    """Fit a unit with effects of the given groups; return table, fit and left-out score."""
    used = np.isin(GROUPS, groups)
    truth = Truth(on_bias=Truth().on_bias * used, on_scale=Truth().on_scale * used, start_sd=0.3,
                  **changes)  # fmt: skip
    windows, up = table_of(truth, n, rng, n_windows=n_windows, step_s=step_s)
    regression, state = begin(windows, up)
    prior = prior_of(truth, groups)
    whole = mode_of(regression, state, prior)
    return windows, up, regression, prior, whole, score_of(regression, whole)


@pytest.mark.parametrize(('groups', 'tolerance'), [(LINEAR, 0.002), (PRODUCTS, 0.2)])
def test_the_left_out_error_of_a_position_is_that_of_a_fit_to_all_others(rng, groups, tolerance):
    windows, _, regression, prior, whole, score = scored(
        groups, 14, rng, n_windows=20, step_s=240.0, offset_sd=3.0 * MICRO,
        noise=Noise(0.1, 1000.0),
    )  # fmt: skip
    before = regression.force(whole.state)
    for p in (0, 6, 13):
        left = windows.position == p
        expected = regression.force(refit_of(whole, regression, prior, ~left))[left]
        size = np.linalg.norm(expected - before[left])
        assert size > 1e-7
        assert np.linalg.norm(score.force[left] - expected) < tolerance * size
        drift = expected - expected.mean(axis=0)
        np.testing.assert_allclose(score.drift[left], drift, atol=tolerance * size)
        assert score.positions.square[p] == pytest.approx(np.mean(score.drift[left] ** 2))
        norm = np.linalg.norm(score.force[left], axis=1) - GRAVITY
        assert score.norms.square[p] == pytest.approx(np.mean(norm**2))


@pytest.mark.parametrize(('groups', 'tolerance'), [(LINEAR, 0.002), (PRODUCTS, 0.05)])
def test_the_left_out_error_of_a_section_is_that_of_a_fit_to_all_others(rng, groups, tolerance):
    size = {'n_windows': 24, 'step_s': 200.0}
    windows, up, regression, prior, whole, score = scored(groups, 12, rng, **size)
    for section in range(windows.section.max() + 1):
        left = windows.section == section
        force = regression.force(refit_of(whole, regression, prior, ~left))
        places = (windows.position == p for p in range(12))
        expected = [force[left & at] - force[~left & at].mean(axis=0) for at in places]
        expected = np.concatenate(expected)
        size = np.sqrt(np.mean(expected**2))
        assert score.sections.square[section] == pytest.approx(size**2, rel=2.0 * tolerance)
    assert score.sections.rms == pytest.approx(np.sqrt(score.sections.square.mean()))
    # With a single position the score is the drift of |f| in the position's left-out sections.
    alone, state = begin(rows_of(windows, np.arange(24)), up[:1])
    alone_score = score_of(alone, alone.solve(state, prior))
    assert np.isnan(alone_score.positions.rms)
    assert np.isfinite(alone_score.drift).all()
    assert alone_score.rms == alone_score.sections.rms


def test_a_position_that_alone_determines_a_parameter_has_no_left_out_norm(rng):
    # Five faces do not separate bias and scale of the axis that is along gravity on the sixth.
    truth = Truth(misalignment=np.zeros(3))
    windows, up = table_of(truth, 6, rng, up=np.vstack((np.eye(3), -np.eye(3))))
    regression, state = begin(windows, up)
    mode = mode_of(regression, state, prior_of(truth, misalignment_sd=1e-3))
    score = score_of(regression, mode)
    assert np.isnan(score.force).all()
    assert np.isnan(score.norms.square).all()
    # Bias and scale do not change the drift of a left-out position, so the drift is predicted.
    assert np.isfinite(score.positions.square).all()
    np.testing.assert_allclose(mode.state.misalignment, 0.0, atol=1e-6)
    places = mode.layout.misalignment
    np.testing.assert_allclose(np.sqrt(mode.variance[places]), 1e-3, rtol=1e-3)


def test_a_damped_step_moves_all_linear_unknowns_and_no_others(solved):
    # WHY: turn-on offsets, which are linear unknowns, were kept constant.
    regression, prior, fitted = solved
    layout, sd = fitted.layout, np.sqrt(fitted.variance)
    for name in ('offset', 'turn_on'):
        places = getattr(layout, name)
        if places.size:
            moved = replace(
                fitted.state, **{name: getattr(fitted.state, name) + 10.0 * sd[places]}
            )
            step = regression.at(moved, prior).linear_step() / sd
            np.testing.assert_allclose(step[places], -10.0, atol=0.1)
            assert (
                np.abs(step[np.concatenate((layout.start.ravel(), layout.up.ravel()))]).max() < 0.1
            )


@pytest.mark.parametrize('seed', [0, 1, 5, 7, 8, 11])
def test_no_step_of_the_solver_increases_the_objective(seed):
    # The bags start far from thermal equilibrium, so products of lag state and weight are large.
    rng = np.random.default_rng(seed)
    truth = Truth(start_sd=5.0, sigma=np.full(3, 5.0 * MICRO))
    windows, up = table_of(truth, 4, rng, n_windows=12, step_s=400.0)
    regression, state = begin(replace(windows, start_covariance=100.0 * START), up)
    prior, sizes = prior_of(truth), []
    for _ in range(10):
        solution = regression.solve(state, prior, n_steps=1)
        state, dense = solution.state, Dense(regression, prior, solution)
        sizes.append(0.5 * float(np.sum(dense.residual(np.zeros(dense.n)) ** 2)))
    assert np.diff(sizes).max() < 1e-9 * sizes[0]


def test_published_huygens_coefficients_come_back(rng):
    # Huygens HASI accelerometer: sf = 1.30675e-3 - 1.35046e-7 T + 4.02821e-10 T^2 [A/g] and offset
    # = -8.9642327e-4 + 3.83652e-6 T - 7.61e-9 T^2 [g], T in kelvin. The test computes the
    # current over a chamber program in counts of 1 nA, fits it, and converts the result back.
    sf, offset = (1.30675e-3, -1.35046e-7, 4.02821e-10), (-8.9642327e-4, 3.83652e-6, -7.61e-9)
    counts_per_ampere = 1e9
    windows, up = table_of(Truth(misalignment=np.zeros(3)), 12, rng)
    t = windows.columns[:, 0]
    kelvin = t + 293.15
    polynomial = np.polynomial.polynomial
    per_g = polynomial.polyval(kelvin, sf) * counts_per_ampere
    zero = polynomial.polyval(kelvin, offset)
    K0 = float(polynomial.polyval(293.15, sf)) * counts_per_ampere / GRAVITY
    powers = np.column_stack([t**k for k in (1, 2, 3, 4)])
    table = replace(
        windows,
        mean=per_g[:, None] * (up[windows.position] + zero[:, None]),
        columns=powers, groups=('curve',) * 4, lag=np.full(4, -1), start=np.zeros_like(powers),
        kelvins=np.ones(4), start_covariance=np.zeros((0, 0)), in_scale=np.ones(4, dtype=bool),
    )  # fmt: skip
    regression, state = begin(table, up)
    regression = Regression(table, GRAVITY, np.full(3, K0))
    sd, sigma = np.repeat([[1e-2], [1e-3]], 4, axis=1), np.full(3, 1e-6 * MICRO)
    mode = mode_of(regression, state, prior_of(Truth(), column_sd=sd, sigma=sigma)).state
    for axis in range(3):
        relative = np.append(1.0, mode.weights[1, axis] / regression.rms)
        scale = K0 * mode.kappa[axis] * relative
        shifted = np.polynomial.Polynomial([-293.15, 1.0])
        got = np.polynomial.Polynomial(scale)(shifted).coef * GRAVITY / counts_per_ampere
        printed = [f'{each:.5e}' for each in got[:3]]
        assert printed == ['1.30675e-03', '-1.35046e-07', '4.02821e-10']
        powers = np.append(mode.bias[axis], mode.weights[0, axis] / regression.rms)
        bias = K0 * polynomial.polyval(t[:40], powers)
        ratio = bias / (polynomial.polyval(t[:40], scale) * GRAVITY)
        got = np.polynomial.Polynomial.fit(kelvin[:40], ratio, 2).convert().coef
        printed = [f'{got[0]:.7e}', f'{got[1]:.5e}', f'{got[2]:.2e}']
        assert printed == ['-8.9642327e-04', '3.83652e-06', '-7.61e-09']


@pytest.mark.parametrize('noise', [Noise(), Noise(0.5, 1500.0)])
def test_scores_of_inactive_columns_agree_with_a_fit_in_which_they_are_active(noise):
    # If active, the columns would have weights S^-1 Q, covariance S^-1 (sparsity S, quality Q).
    truth, asked = Truth(noise=noise), np.isin(GROUPS, ('board', 'idle'))
    windows, up = table_of(truth, 12, np.random.default_rng(4), n_windows=30)
    regression, state = begin(without_starts(windows), up)
    prior = prior_of(truth, ('curve',))
    posterior = mode_of(regression, state, prior)
    inactive = regression.inactive(posterior, asked)
    wide = column_sd(('board', 'idle'), 1e-2, 1e-3)
    mode = mode_of(regression, posterior.state, replace(prior, column_sd=prior.column_sd + wide))
    places = mode.layout.weights[:, :, asked].transpose(0, 2, 1).ravel()
    covariance, expected = mode.covariance[np.ix_(places, places)], np.linalg.inv(inactive.S)
    sd = np.sqrt(np.diag(covariance))
    outer = np.outer(sd, sd)
    np.testing.assert_allclose(covariance / outer, expected / outer, atol=0.01)
    weights = mode.state.weights[:, :, asked].transpose(0, 2, 1).ravel()
    np.testing.assert_allclose(weights / sd, expected @ inactive.Q / sd, atol=0.05)
    gains = []
    for part in 10.0 ** np.arange(-2.0, -0.4, 0.25):
        with_them = replace(prior, column_sd=prior.column_sd + part * wide)
        gains.append(mode_of(regression, posterior.state, with_them).log_evidence)
    gain = max(gains) - posterior.log_evidence
    assert gain > 100.0
    assert inactive.gain(wide, asked) == pytest.approx(gain, rel=0.01)
    chosen = inactive.chosen(wide, asked, 4.0, 9)
    assert np.array(GROUPS)[chosen].tolist() == ['board'] * (np.array(GROUPS) == 'board').sum()
    assert inactive.chosen(wide, asked, 4.0, 1).sum() == 1
    assert not inactive.chosen(wide, asked, 1e9, 9).any()


def test_inactive_and_active_columns_share_initial_lag_states(solved):
    # WHY: the sparsity lacked the prior of the sum of lag states, and was 50 times too large.
    regression, prior, mode = solved
    of_scale = np.isin(GROUPS, ('board',)) * [[0.0], [1.0]]
    without = replace(prior, column_sd=np.where(of_scale > 0.0, 0.0, prior.column_sd))
    posterior = regression.solve(mode.state, without, n_steps=2)
    inactive = regression.inactive(posterior, np.isin(GROUPS, ('board',)))
    assert inactive.part.tolist() == [1, 1]
    wide = replace(without, column_sd=without.column_sd + 1e3 * of_scale)
    fitted = regression.solve(posterior.state, wide, n_steps=0)
    places = fitted.layout.weights[1, :, inactive.column].ravel()
    expected = np.linalg.inv(fitted.covariance[np.ix_(places, places)])
    outer = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(inactive.S / outer, expected / outer, atol=1e-3)


def test_only_a_matrix_made_indefinite_by_rounding_gets_diagonal_jitter(rng):
    root = rng.standard_normal((3, 3))
    good, bad = root @ root.T, np.ones((3, 3)) - 1e-10 * np.eye(3)
    factor = factored(np.stack((good, bad)))
    np.testing.assert_array_equal(factor[0], factored(good))
    np.testing.assert_allclose(factor[0] @ factor[0].T, good, rtol=1e-11)
    np.testing.assert_allclose(factor[1] @ factor[1].T, bad, atol=2e-9)
    with pytest.raises(np.linalg.LinAlgError):
        factored(np.stack((good, bad - 0.5 * np.eye(3))))


def test_positions_in_motion_and_an_axis_with_equal_means_in_all_positions_are_refused(rng):
    means = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    with pytest.raises(FitError, match='reads the same in all positions'):
        constant_calibration(means, GRAVITY, 1e-3)
    with pytest.raises(FitError, match='not lie on an ellipsoid'):
        constant_calibration(rng.standard_normal((30, 3)), GRAVITY, 1e-3)
