# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The columns of the thermal response have the right number, lags, values and slopes."""

import math
from collections import Counter

import numpy as np
import pytest
from builders import SECOND_NS, calibration, term

from thermo_comp.thermal.lags import Lag, MemorySpec
from thermo_comp.thermal.state import BOARD, GRADIENT, Rate, StateLayout
from thermo_comp.thermal.tracker import ThermalTracker
from thermo_comp.unit.columns import (
    BANK_TAUS,
    FINE_TAUS,
    UNBOUNDED,
    Column,
    ColumnTable,
    bank,
    memory_of,
)
from thermo_comp.unit.correction import VARIANCES, Correction
from thermo_comp.unit.covariance import N_ROWS
from thermo_comp.unit.terms import TERMS, Term

WIDE = {'range': UNBOUNDED}


def by_group(columns):
    return Counter(column.group for column in columns)


def test_columns_of_the_bank_differ_bend_within_the_span_or_are_even_about_rest():
    assert tuple(60.0 * 2.0**k for k in range(8)) == BANK_TAUS
    assert pytest.approx([60.0 * 2.0 ** (k / 2) for k in range(15)]) == FINE_TAUS
    assert by_group(bank()).keys() == by_group(bank(('case', 'tip'))).keys()
    assert len(set(bank(('case', 'tip')))) == len(bank(('case', 'tip')))
    assert 'bend' not in by_group(bank(span_k=(-0.4, 0.4)))
    bends = [column for column in bank(span_k=(-10.0, 2.0)) if column.group == 'bend']
    assert len(bends) == 12 * len({column.tau_s for column in bends}) == 96
    assert all(-10.0 < column.knee_k < 2.0 for column in bends)
    warm = bank(('case', 'tip'), {'case': -0.5, 'tip': 0.0})
    change = [column for column in warm if column.group == 'gradient_even_about_rest']
    assert by_group(warm)['gradient_even_about_rest'] == 21
    assert {(column.sensor, column.rest_k) for column in change} == {('case', -0.5)}
    table = ColumnTable(change, MemorySpec(('case', 'tip')), 20.0)
    states = np.zeros((StateLayout(MemorySpec(('case', 'tip'))).width, 3))
    # The gradients differ from the value in a soak, -0.5 K, by 0, +1.5 and -1.5 K.
    states[GRADIENT] = -0.5, 1.0, -2.0
    values = table.raw(states)
    assert np.all(values[:, 0] == 0.0)
    np.testing.assert_array_equal(values[:, 1], values[:, 2])
    slopes, _ = table.slopes(states)
    np.testing.assert_allclose(slopes[:, 1], -slopes[:, 2])


def test_the_memory_has_the_lags_that_columns_need_and_ignores_other_time_constants():
    spec = memory_of(bank(('case', 'tip')), ('case', 'tip'))
    taus = {x: tuple(lag.tau_s for lag in spec.lags if lag.input == x) for x in spec.inputs}
    board = tuple(sorted((*FINE_TAUS, 450.0, 900.0, 1800.0)))
    assert taus == {'board': board, 'case': FINE_TAUS, 'tip': FINE_TAUS}
    assert len(spec.plays) == 20
    assert memory_of(()) == MemorySpec()
    with pytest.raises(ValueError, match="one of \\('case',\\), got tip"):
        memory_of(bank(('tip',)))
    columns = [Column('gradient', kind, tau_s=60.0, **WIDE) for kind in ('gradient', 'size')]
    assert memory_of(columns) == MemorySpec()
    state = np.array([[20.0, 0.0, 0.0, 0.0, 0.0, -1.5, 0.0]]).T
    assert ColumnTable(columns, MemorySpec(), 20.0).values(state).tolist() == [[-1.5], [1.5]]


def test_the_value_of_each_kind_of_column_agrees_with_hand_numbers():
    columns = [
        Column('gradient', 'gradient', 'tip', **WIDE),
        Column('rate', 'rate', **WIDE),
        Column('board', 'board', tau_s=60.0, **WIDE),
        Column('gradient_lag', 'gradient_lag', 'tip', 120.0, **WIDE),
        Column('product', 'gradient_lag', 'tip', 120.0, power=1, **WIDE),
        Column('gradient_even', 'gradient_even', 'case', width_k=1.5, power=2, **WIDE),
        Column('play', 'play', tau_s=60.0, width_k=0.4, **WIDE),
        Column('board', 'board', tau_s=60.0, range=(-0.25, 0.25)),
        Column('board', 'board', tau_s=60.0, during='static', **WIDE),
        Column('board', 'board', tau_s=60.0, during='dynamic', power=3, **WIDE),
        Column('square', 'square', tau_s=60.0, **WIDE),
        Column('gradient_even', 'square', 'tip', power=1, **WIDE),
        Column('gradient_even', 'size', 'tip', **WIDE),
        Column('gradient_even', 'size', 'tip', power=1, range=(0.0, 0.5)),
        Column('bend', 'bend', knee_k=2.0, **WIDE),
        Column('bend', 'bend', tau_s=60.0, knee_k=2.0, **WIDE),
        Column('bend', 'bend', tau_s=60.0, knee_k=2.6, **WIDE),
    ]
    spec = memory_of(columns, ('case', 'tip'))
    layout = StateLayout(spec)
    # T_board, its variance, rate; weight; unknown regime; 4 times gradient or lag, variance; play.
    state = [23.0, 0.0, 0.01, 0.25, 0.0, 1.2, 0.0, -0.7, 0.0, 0.5, 0.0, -0.3, 0.0, 0.1]
    state = np.array([state]).T
    assert layout.width == len(state)
    values = ColumnTable(columns, spec, 20.0).values(state)[:, 0]
    expected = [
        -0.7, 0.01, 0.5, -0.3, -0.9, math.tanh(0.64) * 9.0, 0.1, 0.25, 0.375, 0.125 * 27.0,
        0.25, 0.49 * 3.0, 0.7, 0.5 * 3.0, 1.0, 0.5, 0.0,
    ]  # fmt: skip
    assert values == pytest.approx(expected)
    # A factor t of a column is limited to calibrated temperatures; the column `board` has no t.
    at_edge = ColumnTable(columns, spec, 20.0, (-10.0, 22.0)).values(state)[:, 0]
    assert (at_edge[4], at_edge[2]) == (pytest.approx(-0.6), 0.5)


def test_bends_have_slopes_and_go_on_along_their_tangent_beyond_the_range():
    columns = [Column('bend', 'bend', tau_s=tau, knee_k=2.0, **WIDE) for tau in (0.0, 60.0)]
    spec = memory_of(columns)
    table = ColumnTable(columns, spec, 20.0)
    state = np.zeros((StateLayout(spec).width, 1))
    lag = StateLayout(spec).places[Lag('board', 60.0)]
    state[BOARD], state[lag] = 24.0, 0.5
    # Slopes of column 0 over t, of column 1 over its lag, and of both columns over T_board.
    assert np.ravel(table.slopes(state)).tolist() == [1.0, -1.0, 1.0, 1.0]
    state[BOARD] = 21.0
    assert not np.any(table.slopes(state))
    flow = ColumnTable([Column('gradient', 'gradient', **WIDE)], MemorySpec(), 20.0)
    assert flow.slopes(np.zeros((7, 1)))[1] is None
    # WHY: `bend` columns became constant at different temperatures: slopes erred by 200 ug/K.
    columns = [Column('bend', 'bend', knee_k=k, range=(-12.0 - k, 8.0 - k)) for k in (2.0, 6.0)]
    table = ColumnTable(columns, MemorySpec(), 20.0)
    states = np.zeros((StateLayout(MemorySpec()).width, 3))
    states[BOARD] = 20.0 + np.array([8.0, 12.0, 15.0])
    raw = table.raw(states)
    # The tangent ends 5 K (1/4 of the width) outside the range; inside the range `beyond` is 0.
    assert table.held(raw).tolist() == [[6.0, 10.0, 11.0], [2.0, 6.0, 7.0]]
    assert table.beyond(raw).tolist() == [[0.0, 4.0, 7.0]] * 2


def test_a_new_kind_of_column_needs_one_term_only(monkeypatch):
    form = TERMS['square'].form
    new = Term('rate_square', '(dT_s/dt)^2', lambda column: Rate(column.sensor), form, order=2)
    monkeypatch.setitem(TERMS, 'rate_square', new)
    unit = calibration(response=(term('rate_square', (0.0, 0.0, 3e6), range=(0.0, 1e-3)),))
    correction = Correction(unit)
    assert correction.memory == MemorySpec(rates=('case',))
    tracker = ThermalTracker(unit.detector, correction.memory)
    for second in range(600):
        tracker.read('board', second * SECOND_NS, 20.0)
        tracker.read('case', second * SECOND_NS, 20.0 + 0.01 * second)
    state = tracker.sample(599 * SECOND_NS)
    place = StateLayout(correction.memory).places[Rate('case')]
    rate, variance = state[place : place + 2]
    line = correction.line(state, state, np.zeros(N_ROWS), 0.0)
    assert line[8] == pytest.approx(3e6 * rate**2) == pytest.approx(300.0, rel=0.02)
    # The slope of the bias over the rate is 2 * 3e6 * rate [counts s/K]; K: 300 counts per m/s^2.
    by_rate = (2.0 * 3e6 * rate / 300.0) ** 2 * variance
    assert line[VARIANCES[2]] - correction.noise[2] == pytest.approx(by_rate, rel=1e-6)
    with pytest.raises(ValueError, match=r'keep the largest effect of the column within'):
        calibration(response=(term('rate_square', (1e13, 0.0, 0.0), range=(0.0, 1e9)),))


@pytest.mark.parametrize(
    ('keys', 'message'),
    [
        ({'kind': 'pressure', **WIDE}, '`kind` must be one of .*, got pressure'),
        ({'range': (1.0, 1.0)}, '`range` must be .* got .1.0, 1.0.'),
        *(({'kind': kind, **WIDE}, f'`{name}` must be greater than 0 for {kind}')
          for kind, name in (('board', 'tau_s'), ('cube', 'tau_s'), ('play', 'width_k'))),
    ],
)  # fmt: skip
def test_impossible_columns_are_refused(keys, message):
    with pytest.raises(ValueError, match=message):
        Column(**{'group': 'gradient', 'kind': 'gradient', **keys})
