# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The fit checks its rests: a jump in any bag stops it, a single attitude or motion does not."""

from __future__ import annotations

from dataclasses import replace

import pytest
from position_helpers import GRAVITY, MG, Rest

from thermo_comp.errors import FitError
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.data_checks import describe
from thermo_comp.fitting.jumps import find_jumps
from thermo_comp.fitting.reduction import reduce_source
from thermo_comp.simulation.campaign import positions

OPTIONS = FitOptions(gravity=GRAVITY, input='m/s^2', groups=('curve',))


def reduced(source):
    return reduce_source(source, window_s=10.0, cell_s=2.0, min_rest_s=5.0, full_scale=None)


def bags(rng, n=9, jump_in=None, size=20.0):
    result = []
    for number, up in enumerate(positions(n, 3)):
        rest = Rest(rng, level=tuple(GRAVITY * up))
        if number == jump_in:
            rest.add(size * MG * up, from_s=300.0)
        result.append(rest.source(name=f'bag{number}'))
    return result


def test_jump_in_one_bag_stops_the_fit(rng):
    sources = bags(rng, jump_in=4)
    with pytest.raises(FitError, match=r'bag4: at 300.0 s the sensor jumped by \+') as refused:
        fit(sources, OPTIONS)
    assert 'not a function of temperature' in str(refused.value)
    assert '--allow jump' in str(refused.value)
    allowed = fit(sources, replace(OPTIONS, allow=('jump',)))
    assert any(finding.name == 'jump' for finding in allowed.findings)


def test_good_bags_pass(rng):
    assert not any(find_jumps(reduced(source)) for source in bags(rng, n=6))


def test_turning_is_no_jump(rng):
    rest = Rest(rng)
    rest.accel[rest.time > 300.0] = rest.accel[rest.time > 300.0][:, [1, 2, 0]]
    bag = reduced(rest.source())
    assert find_jumps(bag) == ()


def test_bag_without_neighbours_is_not_read_again(rng):
    n_passes = 0
    source = Rest(rng).source()

    def blocks():
        nonlocal n_passes
        n_passes += 1
        return source.blocks()

    bag = reduced(replace(source, blocks=blocks))
    assert len(bag.intervals) == 1
    assert find_jumps(bag) == ()
    assert n_passes == 1


def test_steps_are_said_in_words(rng):
    rest = Rest(rng)
    rest.add((0.0, 0.0, 20.0 * MG), from_s=300.0)
    (jump,) = find_jumps(reduced(rest.source()))
    assert 'jumped by +20' in describe(jump, MG)
