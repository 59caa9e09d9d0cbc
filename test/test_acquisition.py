# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""During a recording the positions of the unit are found, in blocks of samples of any length."""

from dataclasses import replace

import numpy as np
import pytest

from thermo_comp.cli.acquisition import Acquisition
from thermo_comp.recording.blocks import Block, Readings

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
    # Finally the unit is turned and put back in its previous position.
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
    zeros = Block(stamp_ns, np.zeros((3000, 3)), '', None, {}, {'accel': stamp_ns})
    assert test.add(zeros) == []
    account = test.account()
    assert [position.reason for position in account.positions] == ['all axes read zero']
    assert (account.n_good, account.farthest_deg) == (0, 180.0)


def test_a_backward_jump_of_the_clock_begins_a_new_position(stream):
    stream.rest((0, 0, 1), 40.0)
    test = Acquisition(1, 30.0)
    for start_ns in (START_NS, 10**15):
        begins = [begin for block in stream.blocks(0.5, start_ns) for begin in test.add(block)]
    assert begins == [10**15]
    still_s = [position.still_s for position in test.account().positions]
    assert still_s == pytest.approx([40.0] * 2, abs=1.0)


def test_the_zero_of_unsigned_words_is_in_mid_range(stream):
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
