# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Each named refusal of a fit can be overridden by its name; the fit gives a calibration."""

import re
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from position_helpers import GRAVITY, MG, Rest

from thermo_comp.errors import FitError
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.options import REFUSALS
from thermo_comp.simulation.campaign import positions

# Refusals do not depend on the model; the model golovach is the fastest to fit.
COUNTS = FitOptions(gravity=GRAVITY, model='golovach')
FORCE = replace(COUNTS, input='m/s^2')


def saturated(rest):
    rest.accel = np.rint(rest.accel * 400.0)
    rest.accel[::7] = 32767.0


def jumped(rest):
    rest.add(20.0 * MG * np.array(rest.level) / GRAVITY, from_s=300.0)


def compensated(rest):
    rest.accel = rest.level + 0.01 * (rest.accel - rest.level)
    rest.fall = 30.0


as_it_is = id  # a function that leaves a rest unchanged


def swapped(source, rest):
    """Replace the thermometers: the board cools at once, the case with a lag of two minutes."""
    (block,) = source.blocks()
    time = (block.board_stamp_ns - block.board_stamp_ns[0]) * 1e-9
    late = np.empty_like(block.board)
    late[0] = block.board[0]
    for i in range(1, len(late)):
        late[i] = late[i - 1] + (block.board[i] - late[i - 1]) * (time[i] - time[i - 1]) / 120.0
    block = replace(block, case_stamp_ns=block.board_stamp_ns, case=late)
    return replace(source, blocks=lambda: [block])


@pytest.mark.parametrize(
    ('name', 'spoil', 'options', 'n'),
    [
        ('saturation', saturated, COUNTS, 7),
        ('units', as_it_is, COUNTS, 1),
        ('jump', jumped, FORCE, 1),
        ('jump', jumped, FORCE, 7),
        # The test replaces the thermometers of the bags by `swapped`, so that the board leads.
        ('swapped', as_it_is, FORCE, 7),
        ('compensated', compensated, FORCE, 12),
    ],
)
def test_an_allowed_refusal_ends_in_a_calibration(rng, name, spoil, options, n):
    assert name in REFUSALS
    sources = []
    for number, up in enumerate(positions(n, 3)):
        rest = Rest(rng, level=tuple(GRAVITY * up))
        spoil(rest)
        source = rest.source(name=f'bag{number}')
        sources.append(swapped(source, rest) if name == 'swapped' else source)
    with pytest.raises(FitError, match=rf'\(override with --allow {name}\)$'):
        fit(sources, options)
    result = fit(sources, replace(options, allow=(name,)))
    assert any(note.name == name and 'allowed: ' in note.message for note in result.findings)
    assert f'{name}: allowed' in ' '.join(result.calibration.provenance.notes)


def test_a_saturated_bag_is_refused_with_the_share_of_samples(rng):
    rest = Rest(rng)
    rest.accel[:] = -40000.0
    with pytest.raises(FitError, match='100 % of its samples are at the full scale: is --full'):
        fit([rest.source()], replace(COUNTS, allow=('saturation',)))


def late_by(shift_s):
    return lambda rest: setattr(rest, 'board_time', rest.board_time + shift_s)


def dropping_out(rest):
    rest.board_time = rest.board_time[(rest.board_time < 250.0) | (rest.board_time > 450.0)]


def in_thousandths(rest):
    rest.warm, rest.fall = 35000.0, 20000.0


def dead(rest):
    rest.accel = rest.level + 0.1 * (rest.accel - rest.level)
    rest.accel[:, 1] = 0.0


def frozen(rest):
    rest.accel[:] = rest.level


def in_kelvins(rest):
    rest.warm += 273.15


def in_whole_degrees(rest):
    rest.quantum = 1.0
    rest.temperature = lambda time: 35.0 - 0.05 * np.maximum(time - 150.0, 0.0)


@pytest.mark.parametrize(
    ('spoil', 'text'),
    [
        (late_by(18000.0), r'^bag0: no temperatures .* two clocks\?$'),
        (in_thousandths, r'^bag0: 600 readings of board are beyond 1000 degC: is the topic'),
        (dead, 'an axis is exactly zero at rest'),
    ],
)
def test_bags_without_usable_numbers_are_refused_in_a_sentence(rng, spoil, text):
    # WHY: temperatures of another clock or in mK, or a dead axis, ended the fit with a traceback.
    with pytest.raises(FitError, match=text):
        fit(spoilt(rng, spoil), FORCE)


@pytest.mark.parametrize(
    ('spoil', 'name', 'text'),
    [
        (late_by(120.0), 'unmeasured', '^2[0-9] % .* has no temperatures .* use the same clock'),
        # WHY: if readings dropped out in the middle, the message asked whether two clocks differ.
        (
            dropping_out,
            'unmeasured',
            r'^2\d % .* has no temperatures .* stick, or drop out\? bag\d: temperature/board '
            'has no new value for 20[0-2] s$',
        ),
        # WHY: a fit of readings in whole degrees, which first changed after a soak, was refused
        # with the question whether the clocks are the same.
        (in_whole_degrees, 'steps', r'^2\d % .* temperature/board \(steps of 1 K\) changes for'),
        (frozen, 'stuck', '^at rest all samples are equal'),
        (in_kelvins, 'kelvins', r'^temperature/board reads 2\d+\S* .. \d+\S* degC: that looks'),
    ],
)
def test_likely_mistakes_are_refused_by_name(rng, spoil, name, text):
    findings = {note.name: note.message for note in fit(spoilt(rng, spoil), FORCE).findings}
    assert re.search(text, findings[name])
    assert name == 'unmeasured' or 'unmeasured' not in findings


def test_rests_without_noise_advise_the_parameter_of_the_node(rng):
    # WHY: the node, which takes equal samples for a stuck converter, dropped 60 % of the samples.
    rests = [Rest(rng, level=tuple(GRAVITY * up), sd=0.3 * MG) for up in positions(7, 3)]
    for rest in rests[:2]:
        # The drift of 40 mg changes the samples by steps of 4 mg.
        drift = 40.0 * MG * np.linspace(0.0, 1.0, len(rest.accel))[:, np.newaxis]
        rest.accel = np.rint((rest.accel + drift) / (4.0 * MG)) * 4.0 * MG
    findings = {note.name: note.message for note in fit(sources_of(rests), FORCE).findings}
    assert 'at rest all samples are equal for half a second or' in findings['stuck']
    assert 'in 2 of 7 rests' in findings['stuck']
    assert 'set stuck_timeout of the node to 0' in findings['stuck']


def test_an_axis_that_is_dead_in_one_position_is_named(rng):
    # WHY: in one position the y axis read exactly 3000 for hours, and the missing drift of y was
    # attributed to all other positions.
    rests = [Rest(rng, level=tuple(GRAVITY * up)) for up in positions(7, 3)]
    rests[4].accel[:, 1] = rests[4].level[1]
    with pytest.raises(FitError, match=r'^bag4: y reads exactly \S+ for 0\.\d+ h: the axis is'):
        fit(sources_of(rests), FORCE)
    for rest in rests:
        rest.accel[:, 2] = rest.level[2]
    # WHY: an axis that repeated one number in each position ended the fit with a traceback.
    with pytest.raises(FitError, match=r'^bag0: z reads exactly \S+ for 0\.\d+ h; bag1: z .*dead'):
        fit(sources_of(rests), FORCE)
    rests = [Rest(rng, level=tuple(GRAVITY * up)) for up in positions(7, 3)]
    # WHY: axes at the full scale, here 10 m/s^2, were taken for dead axes.
    rests[2].accel[:, 0], rests[4].accel[:, 1] = -10.0, 10.0
    with pytest.raises(FitError, match=r'^bag2: x .*; bag4: y .* full scale: .*-scale 9.999 '):
        fit(sources_of(rests), FORCE)


def sources_of(rests):
    return [rest.source(name=f'bag{number}') for number, rest in enumerate(rests)]


def spoilt(rng, spoil):
    rests = [Rest(rng, level=tuple(GRAVITY * up)) for up in positions(7, 3)]
    for rest in rests:
        spoil(rest)
    return sources_of(rests)


@pytest.mark.parametrize(('n', 'n_prior', 'step'), [(8, 6, 1e-2), (2, 1, 1e-4)])
def test_steps_far_above_the_noise_end_in_a_calibration_or_a_sentence(rng, n, n_prior, step):
    # WHY: constant samples of an axis had a noise of 1e-8 m/s^2 in the fit, and the equations of
    # an update by such bags ended in a LinAlgError.
    rests = [Rest(rng, level=tuple(GRAVITY * up), sd=1e-5) for up in positions(n, 3)]
    for rest in rests:
        drift = 1e-2 * np.outer((rest.temperature(rest.time) - 25.0) / 20.0, (1.0, -0.5, 0.3))
        rest.accel = np.rint((rest.accel + drift) / step) * step
    sources = sources_of(rests)
    known = fit(sources[:n_prior], FORCE).calibration
    result = None
    with suppress(FitError):
        result = fit(sources[n_prior:], replace(FORCE, prior=known))
    assert result is None or np.isfinite(result.calibration.posterior.covariance()).all()
