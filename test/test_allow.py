# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A fit refuses wrong data for a named reason; if the user allows the reason, the fit goes on."""

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

# Refusals do not depend on the model; a fit with the model golovach takes the shortest time.
COUNTS = FitOptions(gravity=GRAVITY, model='golovach')
FORCE = replace(COUNTS, input='m/s^2')


def saturated(rest):
    rest.accel = np.rint(rest.accel * 400.0)
    rest.accel[::7] = 32767.0


def jumped(rest):
    rest.add(20.0 * MG * np.array(rest.level) / GRAVITY, from_s=300.0)


def full(rest):
    rest.accel[:] = -40000.0


def compensated(rest):
    rest.accel = rest.level + 0.01 * (rest.accel - rest.level)
    rest.fall = 30.0


as_it_is = id  # a function that leaves a rest unchanged


def swapped(source):
    """Replace the readings: the board follows the chamber, the case lags the board by 2 min."""
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
        ('saturation', saturated, COUNTS, 7), ('units', as_it_is, COUNTS, 1),
        ('jump', jumped, FORCE, 1), ('jump', jumped, FORCE, 7),
        ('swapped', as_it_is, FORCE, 7), ('compensated', compensated, FORCE, 12),
    ],
)  # fmt: skip
def test_a_fit_with_an_allowed_refusal_gives_a_calibration(rng, name, spoil, options, n):
    assert name in REFUSALS
    sources = sources_of(rests_of(rng, n), spoil)
    sources = [swapped(source) if name == 'swapped' else source for source in sources]
    with pytest.raises(FitError, match=rf'\(override with --allow {name}\)$'):
        fit(sources, options)
    result = fit(sources, replace(options, allow=(name,)))
    assert any(note.name == name and 'allowed: ' in note.message for note in result.findings)
    assert f'{name}: allowed' in ' '.join(result.calibration.provenance.notes)


def rests_of(rng, n=7, **keys):
    return [Rest(rng, level=tuple(GRAVITY * up), **keys) for up in positions(n, 3)]


def sources_of(rests, spoil=as_it_is):
    for rest in rests:
        spoil(rest)
    return [rest.source(name=f'bag{number}') for number, rest in enumerate(rests)]


def findings_of(sources):
    return {note.name: note.message for note in fit(sources, FORCE).findings}


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
    ('spoil', 'text', 'options'),
    [
        (late_by(18000.0), r'^bag0: no temperatures .* two clocks\?$', FORCE),
        (in_thousandths, r'^bag0: 600 readings of board are beyond 1000 degC: is the t', FORCE),
        (dead, 'an axis is exactly zero at rest', FORCE),
        (in_kelvins, r'^bag0: temperature/board reads 2\d+\S* degC in the median: .* kel', FORCE),
        (full, '100 % of its samples are at the full scale: is --full',
         replace(COUNTS, allow=('saturation',))),
    ],
)  # fmt: skip
def test_bags_without_usable_numbers_are_refused_with_a_message(rng, spoil, text, options):
    with pytest.raises(FitError, match=text):
        fit(sources_of(rests_of(rng), spoil), options)


@pytest.mark.parametrize(
    ('spoil', 'name', 'text'),
    [
        (late_by(120.0), 'unmeasured', '^2[0-9] % .* has no temperatures .* use the same clock'),
        # WHY: for readings that were missing for 200 s the message suggested a second clock.
        (dropping_out, 'unmeasured', r'^2\d % .* has no temperatures .* stick, or drop out\? '
         r'bag\d: temperature/board has no new value for 20[0-2] s$'),
        # WHY: for readings in whole degrees the message suggested a second clock.
        (in_whole_degrees, 'steps', r'^2\d % .* temperature/board \(steps of 1 K\) changes for'),
        (frozen, 'stuck', '^at rest all samples are equal'),
    ],
)  # fmt: skip
def test_likely_mistakes_are_refused_with_the_name_of_the_refusal(rng, spoil, name, text):
    findings = findings_of(sources_of(rests_of(rng), spoil))
    assert re.search(text, findings[name])
    assert name == 'unmeasured' or 'unmeasured' not in findings


def test_one_bag_in_kelvins_or_with_a_constant_axis_is_refused_by_name(rng):
    # WHY: a fit with one of ten bags in kelvins gave no message, and was valid up to 313 degC.
    rests = rests_of(rng)
    in_kelvins(rests[4])
    with pytest.raises(FitError, match=r'^bag4: temperature/board reads 2\d+\S* degC .* kelvins'):
        fit(sources_of(rests), FORCE)
    # WHY: y was constant in one position; the fitted drift of y was too small in all positions.
    rests = rests_of(rng)
    rests[4].accel[:, 1] = rests[4].level[1]
    with pytest.raises(FitError, match=r'^bag4: y reads exactly \S+ for 0\.\d+ h: the axis is'):
        fit(sources_of(rests), FORCE)
    for rest in rests:
        rest.accel[:, 2] = rest.level[2]
    # WHY: an axis that repeated one number in each position ended the fit with a traceback.
    with pytest.raises(FitError, match=r'^bag0: z reads exactly \S+ for 0\.\d+ h; bag1: z .*dead'):
        fit(sources_of(rests), FORCE)
    rests = rests_of(rng)
    # WHY: axes that were constant at the full scale, here 10 m/s^2, were reported as dead.
    rests[2].accel[:, 0], rests[4].accel[:, 1] = -10.0, 10.0
    with pytest.raises(FitError, match=r'^bag2: x .*; bag4: y .* full scale: .*-scale 9.999 '):
        fit(sources_of(rests), FORCE)


def test_the_advice_for_rests_without_noise_names_the_parameter_of_the_node(rng):
    # WHY: the node takes equal samples for a stuck converter, so it dropped 60 % of the samples.
    rests = rests_of(rng, sd=0.3 * MG)
    for rest in rests[:2]:
        # The samples have no noise; with a drift of 40 mg they change by steps of 4 mg.
        drift = 40.0 * MG * np.linspace(0.0, 1.0, len(rest.accel))[:, np.newaxis]
        rest.accel = np.rint((rest.accel + drift) / (4.0 * MG)) * 4.0 * MG
    findings = findings_of(sources_of(rests))
    assert 'at rest all samples are equal for half a second or' in findings['stuck']
    assert 'in 2 of 7 rests' in findings['stuck']
    assert 'set stuck_timeout of the node to 0' in findings['stuck']


@pytest.mark.parametrize(('n', 'n_prior', 'step'), [(8, 6, 1e-2), (2, 1, 1e-4)])
def test_samples_with_steps_above_their_noise_are_fitted_or_refused(rng, n, n_prior, step):
    # WHY: for constant samples the fit assumed a noise of 1e-8 m/s^2, and a LinAlgError ended it.
    rests = rests_of(rng, n, sd=1e-5)
    for rest in rests:
        drift = 1e-2 * np.outer((rest.temperature(rest.time) - 25.0) / 20.0, (1.0, -0.5, 0.3))
        rest.accel = np.rint((rest.accel + drift) / step) * step
    sources = sources_of(rests)
    known = fit(sources[:n_prior], FORCE).calibration
    result = None
    with suppress(FitError):
        result = fit(sources[n_prior:], replace(FORCE, prior=known))
    assert result is None or np.isfinite(result.calibration.posterior.covariance()).all()
