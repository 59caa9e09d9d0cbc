# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Positions are found during a recording; the expected accuracy for given positions is right."""

from dataclasses import replace

import numpy as np
import pytest

from thermo_comp.cli.acquisition import Acquisition
from thermo_comp.fitting import coverage
from thermo_comp.recording.blocks import Block, Readings
from thermo_comp.simulation.campaign import positions

START_NS = 10**18
RATE = 50.0
UPS = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0.8, 0.6, 0), (0, -1, 0)]


class Stream:
    def __init__(self, rng):
        self._rng = rng
        self._pieces = []
        self.celsius = []

    @property
    def seconds(self):
        return sum(map(len, self._pieces)) / RATE

    def rest(self, up, seconds, ramp=0.0, noise=3.0):
        n = round(seconds * RATE)
        force = 2942.0 * np.array(up) / np.linalg.norm(up) + (60.0, -90.0, 30.0)
        self._pieces.append(np.rint(force + self._rng.normal(0.0, noise, (n, 3))))
        last = self.celsius[-1][-1] if self.celsius else 20.0
        self.celsius.append(last + ramp / 60.0 / RATE * np.arange(n))

    def turn(self, seconds=6.0):
        self.rest((0, 0, 1), seconds, noise=900.0)

    def blocks(self, seconds, start_ns=START_NS):
        accel = np.concatenate(self._pieces)
        celsius = np.concatenate(self.celsius)
        stamp_ns = start_ns + (np.arange(len(accel)) * 1e9 / RATE).astype(np.int64)
        size = round(seconds * RATE)
        for begin in range(0, len(accel), size):
            rows = slice(begin, begin + size)
            places = np.arange(begin, min(begin + size, len(accel)))
            at = places[places % round(RATE) == 0]
            board = Readings(stamp_ns[at], celsius[at], at - begin)
            log_ns = {'accel': stamp_ns[rows], 'board': stamp_ns[at]}
            yield Block(stamp_ns[rows], accel[rows], '', None, {'board': board}, log_ns)


@pytest.fixture
def stream(rng):
    return Stream(rng)


@pytest.mark.parametrize('seconds', [0.7, 25.0, 1e4])
def test_positions_do_not_depend_on_the_length_of_blocks(stream, seconds):
    begins = []
    for up in UPS:
        begins.append(stream.seconds)
        stream.rest(up, 60.0, ramp=1.0)
        stream.turn()
    test = Acquisition(6, 50.0)
    starts = [begin for block in stream.blocks(seconds) for begin in test.add(block)]
    # A position begins within 1.1 s after the end of a turn.
    seconds = np.array(starts) * 1e-9 - START_NS * 1e-9
    assert seconds == pytest.approx(np.array(begins[1:]) + 0.5, abs=0.6)
    account = test.account()
    assert account.is_complete
    for position, up in zip(account.positions, UPS, strict=True):
        # The bias of 0.04 g changes the measured direction of gravity by up to 2 degrees.
        assert position.up @ up > np.cos(np.radians(2.5))
        assert position.still_s == pytest.approx(60.0, abs=2.0)
        board = position.thermometers['board']
        assert board.highest - board.lowest == pytest.approx(1.0, abs=0.15)
        assert (position.n_rests, position.reason) == (1, '')
    board, parts = account.thermometers['board'], account.positions
    assert board.lowest == 20.0
    assert board.n == sum(position.thermometers['board'].n for position in parts)
    assert board.highest == pytest.approx(26.0, abs=0.1)


def test_a_position_is_good_after_the_required_time_at_rest(stream):
    stream.rest((0, 0, 1), 40.0)
    test = Acquisition(2, 30.0)
    collected = []
    for block in stream.blocks(1.0):
        test.add(block)
        account = test.account()
        collected.append((account.positions[-1].reason, account.is_still))
    words = list(dict.fromkeys(reason for reason, _ in collected))
    assert words == ['not at rest yet', 'keep at rest for 30 s', '']
    assert collected[-1] == ('', True)
    assert 'positions missing: ' in account.findings[0]
    assert not account.is_complete
    assert account.next_deg == pytest.approx(np.degrees(np.arccos(account.next_up @ account.now)))


def test_faults_of_a_position_are_reported(stream):
    for up, seconds, noise in (
        *(((0, 0, 1), 60.0, 3.0), ((1, 0, 0), 20.0, 3.0), ((0, 0.03, 1), 60.0, 3.0)),
        *(((0, 1, 0), 60.0, 15.0), ((0, -1, 0), 30.0, 3.0), ((0, -1, 0), 30.0, 3.0)),
    ):
        stream.rest(up, seconds, noise=noise)
        stream.turn()
    test = Acquisition(5, 50.0)
    for block in stream.blocks(0.5):
        test.add(block)
    account = test.account()
    assert [position.reason for position in account.positions] == [
        '', 'left before 50 s', 'repeats position 1', 'restless', '',
    ]  # fmt: skip
    assert account.positions[-1].n_rests == 2
    test = Acquisition(1, 30.0)
    stamp_ns = START_NS + np.arange(3000) * 20_000_000
    assert test.add(Block(stamp_ns, np.zeros((3000, 3)), '', None, {}, {'accel': stamp_ns})) == []
    account = test.account()
    assert [position.reason for position in account.positions] == ['all axes read zero']
    assert (account.n_good, account.farthest_deg) == (0, 180.0)


def test_a_position_that_shows_its_noise_is_good_beside_positions_without_visible_noise(stream):
    # WHY: the median noise was 0, and a position whose samples toggle counted as restless.
    for up, noise in (((0, 0, 1), 0.0), ((1, 0, 0), 0.0), ((0, 1, 0), 0.0), ((0, -1, 0), 0.6)):
        stream.rest(up, 60.0, noise=noise)
        stream.turn()
    test = Acquisition(4, 50.0)
    for block in stream.blocks(1.0):
        test.add(block)
    with np.errstate(all='raise'):
        positions = test.account().positions
    assert [position.reason for position in positions] == [''] * 4


def test_a_backward_jump_of_the_clock_begins_a_new_position(stream):
    stream.rest((0, 0, 1), 40.0)
    test = Acquisition(1, 30.0)
    for start_ns in (START_NS, 10**15):
        begins = [begin for block in stream.blocks(0.5, start_ns) for begin in test.add(block)]
    assert begins == [10**15]
    still_s = [position.still_s for position in test.account().positions]
    assert still_s == pytest.approx([40.0] * 2, abs=1.0)


def test_the_zero_of_unsigned_counts_is_in_mid_range(stream):
    for up in [*UPS, UPS[0]]:
        stream.rest(up, 40.0)
        stream.turn()
    test = Acquisition(6, 30.0, offset=32768.0)
    for block in stream.blocks(5.0):
        test.add(replace(block, accel=block.accel + 32768.0))
    positions = test.account().positions
    for position, up in zip(positions, [*UPS, UPS[0]], strict=True):
        assert position.up @ up > np.cos(np.radians(3.0))
    assert [place.reason for place in positions] == [''] * 6 + ['repeats position 1']


PRIOR_SD = np.repeat([1.0 / 9.80665, 0.05, 1e-3], 3)  # bias [g], scale, misalignment [rad]
FACES = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)
NOTHING = np.empty((0, 3))
SD = 2e-5


def units(rng, n):
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def mean_variance(ups, at):
    covariance = coverage.constants_covariance(ups, np.full(len(ups), SD))
    columns = coverage.force_columns(at)
    return float(np.mean(np.trace(columns @ covariance @ columns.transpose(0, 2, 1), 0, 1, 2)))


def test_the_columns_equal_the_derivatives_of_the_measured_force(rng):
    up, step = units(rng, 20), 1e-6

    def force(constants):
        bias, scale, misalignment = constants.reshape(3, 3)
        inverse = np.eye(3)
        inverse[1, 0], inverse[2, 0], inverse[2, 1] = misalignment
        return (up @ inverse.T) * (1.0 + scale) + bias

    for k, step_of in enumerate(step * np.eye(9)):
        slope = (force(step_of) - force(-step_of)) / (2.0 * step)
        np.testing.assert_allclose(coverage.force_columns(up)[:, :, k], slope, atol=1e-9)
        norm = [np.linalg.norm(force(step), axis=1) for step in (step_of, -step_of)]
        slope = (norm[0] - norm[1]) / (2.0 * step)
        np.testing.assert_allclose(coverage.norm_columns(up)[:, k], slope, atol=1e-9)


def test_constants_that_the_positions_do_not_determine_keep_their_prior_sd():
    covariance = coverage.constants_covariance(NOTHING, np.empty(0))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), PRIOR_SD)
    # Along an axis the variance of |f| is the sum of the variances of its bias and scale.
    assert coverage.worst_sd(covariance) == pytest.approx(
        np.hypot(PRIOR_SD[0], PRIOR_SD[3]), rel=1e-3
    )
    sd = np.sqrt(np.diag(coverage.constants_covariance(FACES[:2], np.full(2, SD))))
    # The bias error is half the difference, the scale error half the sum of errors on +x and -x.
    assert sd[[0, 3]] == pytest.approx(SD / np.sqrt(2.0), rel=1e-6)
    np.testing.assert_allclose(sd[[1, 2, 4, 5, 6, 7, 8]], PRIOR_SD[[1, 2, 4, 5, 6, 7, 8]])


def test_the_covariance_equals_that_of_simulated_estimates(rng):
    up, n = positions(12, 3), 4000
    covariance = coverage.constants_covariance(up, np.full(12, SD))
    truth = rng.standard_normal((n, 9)) * PRIOR_SD
    columns = coverage.norm_columns(up)
    seen = truth @ columns.T + SD * rng.standard_normal((n, 12))
    # The estimate is the conditional mean of the constants for the given values of |f|.
    joint = columns * PRIOR_SD**2 @ columns.T + SD**2 * np.eye(12)
    estimate = seen @ np.linalg.solve(joint, columns * PRIOR_SD**2)
    # 4000 trials determine a standard deviation to 1.1 %.
    scatter = np.std(estimate - truth, axis=0)
    np.testing.assert_allclose(scatter, np.sqrt(np.diag(covariance)), rtol=0.06)


@pytest.mark.parametrize('n', [0, 1, 4, 7, 11])
def test_the_next_direction_reduces_the_mean_variance(n, rng):
    up, at = units(rng, n), units(rng, 2000)
    covariance = coverage.constants_covariance(up, np.full(n, SD))
    proposed = coverage.next_direction(covariance, SD, up)
    before = mean_variance(up, at)
    gain = before - mean_variance(np.vstack([up, proposed]), at)
    others = [before - mean_variance(np.vstack([up, unit]), at) for unit in units(rng, 300)]
    # The proposed direction is a face if a face gains at least half as much as the best direction.
    assert gain > 0.45 * max(others)
    assert np.max(up @ proposed, initial=-1.0) < np.cos(np.radians(20.0))


def test_a_direction_is_proposed_if_positions_are_near_all_directions(rng):
    up = units(rng, 1000)
    covariance = coverage.constants_covariance(up, np.full(len(up), SD))
    assert coverage.next_direction(covariance, SD, up).tolist() == [0.0, 0.0, 1.0]


def test_a_mean_reading_of_zero_has_no_direction_and_hides_none():
    means = np.vstack([np.zeros(3), FACES, FACES])
    assert coverage.n_directions(means) == coverage.n_directions(means[::-1]) == 6


def test_proposed_and_farthest_directions_are_nearly_as_good_as_spread_positions():
    up = NOTHING
    for _ in range(18):
        covariance = coverage.constants_covariance(up, np.full(len(up), SD))
        up = np.vstack([up, coverage.next_direction(covariance, SD, up)])
    assert up[0].tolist() == [0.0, 0.0, 1.0]
    assert {tuple(row) for row in up[:6]} == {tuple(face) for face in FACES}
    proposed = coverage.worst_sd(coverage.constants_covariance(up, np.full(18, SD)))
    spread = coverage.worst_sd(coverage.constants_covariance(positions(18), np.full(18, SD)))
    assert proposed < 1.1 * spread
    assert coverage.farthest(up)[1] < 36.0
    up, angle = coverage.farthest(FACES)
    assert np.abs(up) == pytest.approx(1.0 / np.sqrt(3.0))
    assert angle == pytest.approx(np.degrees(np.arccos(1.0 / np.sqrt(3.0))))
    assert coverage.farthest(FACES[4:5])[0] == pytest.approx([0.0, 0.0, -1.0])
    assert coverage.farthest(NOTHING)[1] == 180.0


@pytest.mark.parametrize(
    ('up', 'words'),
    [
        ((0, 0, 1), '+z up: x +0.00 g, y +0.00 g, z +1.00 g'),
        ((1, -1, 0), '+x and -y equally up: x +0.71 g, y -0.71 g, z +0.00 g'),
        ((-1, 1, 1), '-x, +y and +z equally up: x -0.58 g, y +0.58 g, z +0.58 g'),
        ((3, 1, 0), '+x and +y partly up: x +0.95 g, y +0.32 g, z +0.00 g'),
    ],
)
def test_a_direction_is_described_in_words(up, words):
    assert coverage.direction_text(np.array(up, float) / np.linalg.norm(up)) == words
