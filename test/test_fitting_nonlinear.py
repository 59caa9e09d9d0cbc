# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits to forces beyond 1 g determine nonlinear terms and the radius of a rotation."""

import math
from dataclasses import replace

import numpy as np
import pytest
from builders import arrays_of, source_of
from fitting_truth import GRAVITY, MICRO, NOMINAL, Truth, begin, prior_of, table_of
from triads import triad

from thermo_comp.errors import FitError, ThermoCompError
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.claim import claim_of
from thermo_comp.fitting.equations import with_step
from thermo_comp.fitting.left_out import score_of
from thermo_comp.fitting.nonlinear import Forces, choose, prior_sd, starting_sd
from thermo_comp.fitting.population import population
from thermo_comp.fitting.selection import Fit, Selected
from thermo_comp.fitting.sources import (
    MAGNITUDE,
    ROTATION,
    ForceOptions,
    KnownForce,
    Magnitude,
    Section,
    known_force,
    parse_sections,
)
from thermo_comp.judging.evaluation import judge_bags
from thermo_comp.recording.reader import inspect_recording
from thermo_comp.recording.stillness import CellAccumulator, still_intervals, without_rotation
from thermo_comp.recording.writer import BagWriter
from thermo_comp.report.certificate import results
from thermo_comp.report.evidence import evidence_of_fit
from thermo_comp.report.statements import CertificateInfo
from thermo_comp.simulation.campaign import Cyclogram, Position, Spin, positions, steps
from thermo_comp.simulation.run import arrays
from thermo_comp.simulation.unit import Bend
from thermo_comp.unit.gravity import STANDARD_GRAVITY as G
from thermo_comp.unit.nonlinearity import POWERS
from thermo_comp.unit.prediction import nonlinear_coefficients

OPTIONS = FitOptions(gravity=GRAVITY)
SIZES = np.tile([GRAVITY, 30.0, 60.0, 95.0], 6)


def table(rng, k2=0.0, kq=0.0, k3=0.0, *, share=0.01, radius_sd=0.0, radius_error=0.0):
    """Draw windows at 24 centrifuge positions; nonlinear terms grow by 100 * `share` % per K."""
    truth = Truth(on_bias=np.zeros((3, 6)), on_scale=np.zeros((3, 6)), offset_sd=MICRO)
    windows, up = table_of(truth, 24, rng, n_windows=10)
    t = windows.columns[:, 0]
    A = np.eye(3)
    A[1, 0], A[2, 0], A[2, 1] = truth.misalignment
    at_1_g = (GRAVITY * up @ A.T)[windows.position]
    spin = np.sqrt(SIZES**2 - GRAVITY**2)
    size = np.hypot(GRAVITY, spin * (1.0 + radius_error))[windows.position, None]
    f = at_1_g * size / GRAVITY
    bent = k2 * f**2 / G + kq * np.abs(f) * f / G + k3 * f**3 / G**2
    added = truth.kappa * (f - at_1_g + (1.0 + share * t)[:, None] * bent)
    forces = Forces(tuple(POWERS), t, np.full(24, GRAVITY), spin, np.zeros(24), radius_sd)
    windows = replace(windows, mean=windows.mean + NOMINAL * added, forces=forces)
    return truth, *begin(windows, up)


def chosen(rng, **terms):
    """Fit windows of a centrifuge; return the fit, the chosen terms and their claimed sd."""
    truth, regression, state = table(rng, **terms)
    prior = prior_of(truth, (), nonlinear_sd=starting_sd(regression.forces, OPTIONS))
    posterior = regression.solve(state, prior, n_steps=12)
    begun = Selected(posterior, score_of(regression, posterior), ())
    selected, found = choose(regression, begun, OPTIONS)
    return truth, selected.posterior, found


def test_derivatives_of_nonlinear_terms_agree_with_finite_differences(rng):
    _, regression, state = table(rng, 1e-5, 1e-5, 1e-6, radius_sd=0.01)
    regression.forces = replace(regression.forces, sd=rng.uniform(1e-4, 1e-3, 24))
    coefficients = rng.standard_normal((3, 6)) * [1e-5, 1e-5, 1e-6, 1e-7, 1e-7, 1e-8]
    state = replace(state, nonlinear=coefficients)
    used = np.zeros((2, 6), dtype=bool)
    used[:, 0] = True
    regression.whiten(prior_of(Truth()).noise)
    layout, base = regression.layout(used), regression.products(used).base
    every = np.broadcast_to(np.eye(base.size), (24, base.size, base.size))
    derivatives = regression.tangent(state, layout, base).of(every)
    for p in (1, 3):
        for axis in range(3):
            places = [*layout.own[p, layout.of_axis[axis]], *layout.unit[axis, :-1]]
            assert len(places) == derivatives.shape[-1] - 1
            for column, place in enumerate(places):
                step = np.zeros(layout.n)
                step[place] = 1e-6
                states = (with_step(state, sign * step, layout) for sign in (1.0, -1.0))
                above, below = (regression.misfit(moved, base)[p, axis] for moved in states)
                expected = (below - above) / 2e-6
                derived = derivatives[p, axis, :, column]
                # The tolerance is the rounding error: 1e-14 / 1e-6 (step) * 95 m/s^2 (force).
                scale = np.abs(expected).max()
                np.testing.assert_allclose(derived, expected, rtol=1e-5, atol=1e-7 * scale + 1e-6)


def test_the_terms_of_the_unit_are_chosen_and_their_errors_are_below_4_claimed_sd(rng):
    _, posterior, terms = chosen(rng, k2=1e-5, k3=-1e-6)
    assert [term.kind for term in terms] == ['square', 'cube']
    places = posterior.layout.nonlinear[:, [0, 2, 3, 5]]
    sd = np.sqrt(posterior.variance[places])
    error = posterior.state.nonlinear[:, [0, 2, 3, 5]] - np.array([1e-5, -1e-6, 1e-7, -1e-8])
    assert np.abs(error / sd).max() < 4.0
    assert np.abs(error[:, :2] / [1e-5, 1e-6]).max() < 0.02
    assert all(term.left_out_gain > 1.0 and term.log_evidence_change > 100.0 for term in terms)
    _, posterior, terms = chosen(np.random.default_rng(20161), kq=1e-5, share=0.0)
    assert [term.kind for term in terms] == ['odd_square']
    assert posterior.state.nonlinear[:, 1] == pytest.approx(1e-5, rel=0.02)
    assert not posterior.state.nonlinear[:, 4].any()


def test_absent_terms_are_pruned_without_effect_on_the_other_parameters(rng):
    truth, posterior, terms = chosen(rng)
    assert not terms
    assert not posterior.state.nonlinear.any()
    for name in ('kappa', 'bias'):
        error = getattr(posterior.state, name) - getattr(truth, name)
        sd = np.sqrt(posterior.variance[getattr(posterior.layout, name)])
        assert np.abs(error / sd).max() < 4


def test_the_radius_of_a_rotation_is_estimated(rng):
    truth, regression, state = table(rng, 1e-5, radius_sd=0.01, radius_error=0.004)
    prior = prior_of(truth, (), nonlinear_sd=prior_sd(regression.forces.kinds, OPTIONS))
    solution = regression.solve(state, prior, n_steps=15)
    sd = math.sqrt(solution.variance[solution.layout.radius[0]])
    assert sd < 1e-5
    assert abs(solution.state.radius[0] - 0.004) < 4.0 * sd


def test_a_table_of_sections_is_read_as_begin_end_force_and_sd():
    text = '# begin end |f| sd\n0 100 9.81\n120, 300, 49.05, 0.001  # spun up'
    known = KnownForce('bag', parse_sections(text))
    at = [known.of(a * 10**9, b * 10**9, 0, G) for a, b in ((10, 90), (150, 250), (310, 400))]
    assert at == [Magnitude(9.81), Magnitude(49.05, sd=0.001), Magnitude(G)]
    assert parse_sections('49.05') == (Section(0.0, math.inf, 49.05, 0.0),)
    for wrong, said in (
        *(('fast', 'expected numbers'), ('1 2', 'must be above its sd'), ('nan', 'finite')),
        *(('5 3 10', 'must end after its begin'), ('1 2 3 4 5', 'one number in m/s')),
    ):
        with pytest.raises(ValueError, match=said):
            parse_sections(wrong)


def test_a_force_given_by_the_user_overrides_the_force_in_the_bag(tmp_path):
    stamps = 10**18 + np.arange(0, 20 * 10**9, 10**8)
    rate = np.zeros((200, 3))
    rate[:, 2] = np.where(np.arange(200) < 100, 0.0, 5.0)
    by_rate = {ROTATION: 'table/rate', 'rotation_radius_m': '2', 'rotation_radius_sd_m': '0.01'}
    bags = {'a': {MAGNITUDE: '30'}, '02': by_rate, 'c': {ROTATION: 'table/rate'}}
    for name, metadata in bags.items():
        with BagWriter(tmp_path / f'{name}.mcap', metadata=metadata) as writer:
            writer.write_counts('accel/counts', stamps, rate)
            writer.write_counts('table/rate', stamps, rate)
    # WHY: a bag name that begins with a digit, as `record` writes, was taken for a number.
    (tmp_path / 'table.txt').write_text('a.mcap 0 5 20\n02.mcap 0 5 25\n')

    def read(name, asked=ForceOptions()):  # noqa: B008
        path = tmp_path / f'{name}.mcap'
        return known_force(path, inspect_recording(path), asked)

    whole = 10**18, 10**18 + 4 * 10**9, 10**18, 10.0
    assert read('a').of(*whole).still == 30.0
    assert read('a', ForceOptions('5g')).of(*whole).still == pytest.approx(5 * G)
    for name, size in (('a', 20.0), ('02', 25.0), ('c', None)):
        known = read(name, ForceOptions(str(tmp_path / 'table.txt'))) if size else None
        assert known is None or known.of(*whole).still == size
    turning = read('02')
    assert turning.of(*whole) == Magnitude(10.0, 0.0, 0.0)
    fast = turning.of(10**18 + 11 * 10**9, 10**18 + 19 * 10**9, 10**18, 10.0)
    assert fast.norm == pytest.approx(math.hypot(10.0, 50.0))
    assert turning.radius_part(fast) == pytest.approx(2500.0 / math.hypot(10, 50) * 0.005)
    (tmp_path / 'bad.txt').write_text('a.mcap 0 5\n')
    late = 10**18 + 30 * 10**9, 10**18 + 31 * 10**9, 10**18, 10.0
    for call, given, error, text in (
        (turning.of, late, FitError, 'a rest needs 3'),
        (read, ('c',), FitError, 'need a positive rotation_radius_m'),
        (read, ('a', ForceOptions(None, 'spin', 2.0)), FitError, '0 topics are called spin'),
        (ForceOptions, (None, 'spin'), ValueError, '`rotation` needs `radius`'),
        (ForceOptions, (None, None, 2.0), ValueError, 'without `rotation`'),
        (read, ('a', ForceOptions(f'{tmp_path}/bad.txt')), ThermoCompError,
         r'bad\.txt: a specific force must be'),
    ):  # fmt: skip
        with pytest.raises(error, match=text):
            call(*given)


def test_a_constant_rotation_counts_as_a_rest_and_a_changing_rotation_does_not(rng):
    time = np.arange(0.0, 240.0, 0.02)
    rate = np.interp(time, [0, 80, 100, 180, 190], [0.0, 0.0, 3.0, 3.0, 0.0])
    force = np.column_stack((0.0 * time, rate**2, 9.8 + 0.0 * time))
    accumulator = CellAccumulator(0.5, None)
    noise = 1e-3 * rng.standard_normal((2, len(time), 3))
    turning = np.column_stack((0.0 * time, 0.0 * time, rate))
    accumulator.add((time * 1e9).astype(np.int64), force + noise[0], turning + noise[1])
    summed = accumulator.cells()
    still = still_intervals(without_rotation(summed), 3.0)
    edges = [(summed.time[a], summed.time[b - 1]) for a, b in still]
    # The median over 10 s follows a new rate 5 s late; 0.5 s next to a motion are left out.
    assert len(edges) == 3
    for (a, b), (begun, ended) in zip(edges, ((0, 80), (100, 180), (190, 240)), strict=True):
        assert begun <= a < begun + 8.0
        assert ended - 3.0 < b <= ended


def test_simulated_forces_are_those_of_a_rotation():
    spin = Spin(*steps((10.0,), (2.0,), 20.0, 5.0), 1.5, np.array([1.0, 0.0, 0.0]))
    force = spin.forces(np.array([0.0, 0.0, G]), np.array([5.0, 20.0, 60.0]))
    np.testing.assert_allclose(force, [[0, 0, G], [6.0, 0, G], [0, 0, G]])
    assert spin.sections(G)[1] == (15.0, 35.0, math.hypot(G, 6.0))
    read = Bend((10.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.01).added(np.full((1, 3), 2 * G), np.ones(1))
    np.testing.assert_allclose(read / (1.01 * MICRO * G / GRAVITY), [[40.0, 8.0, 0.0]])


def source(run, spin, name):
    sections = tuple(Section(*section, 0.0) for section in spin.sections(G)) if spin else ()
    force = KnownForce(name, sections) if spin else None
    return source_of(*arrays_of(run), name=name, force=force)


@pytest.mark.slow
def test_runs_of_a_centrifuge_determine_nonlinear_terms_that_a_later_fit_keeps():
    # To save time the runs have one temperature, nine mountings, and forces of 1, 3 and 8 g.
    unit = replace(triad('plain', 3), bend=Bend((10.0, -10.0, 10.0), (1.0, 1.0, -1.0)))
    time, rate = steps((150.0,), tuple(np.sqrt([3.0 * G, 8.0 * G])), 150.0, 20.0)
    program = Cyclogram((0.0, 560.0), (20.0, 20.0))
    stations = []
    for inward in positions(9, 1):
        up = np.cross(inward, np.roll(inward, 1) + 0.1)
        stations.append(Position(program, up / np.linalg.norm(up), Spin(time, rate, 1.0, inward)))
    pairs = enumerate(zip(arrays(unit, stations, 3, rate_hz=2.0), stations, strict=True))
    sources = [source(run, station.spin, f'run{k}') for k, (run, station) in pairs]
    result = fit(sources, FitOptions(gravity=G, model='golovach'))
    terms = {term.name: term for term in nonlinear_coefficients(result.calibration)}
    for name, true in (('K2', unit.bend.square), ('K3', unit.bend.cube)):
        assert np.abs((terms[name].value - true) / terms[name].sd).max() < 4.0
        assert terms[name].value == pytest.approx(np.array(true), rel=0.02)
    judged = judge_bags(result.bags, result.calibration)
    assert [round(size / G, 1) for size in judged.by_force] == [1.0, 3.2, 8.1]
    *_, most = judged.by_force.values()
    # In means over 60 s noise is some ug, and uncorrected nonlinear terms are some 100 ug.
    assert most.rms < 10.0 * MICRO < 100.0 * MICRO < most.raw_rms
    narrow = replace(result.calibration.nonlinearity, force_range_m_s2=(9.0, 5.0 * G))
    outside = judge_bags(result.bags, replace(result.calibration, nonlinearity=narrow))
    assert outside.sections['outside'].n == most.n
    rows = results(evidence_of_fit(result), CertificateInfo(), ())
    assert {'K2 x', 'K3 z'} < {row.quantity for row in rows}
    still = [Position(program, position) for position in positions(6, 2)]
    later = arrays(unit, still, 9, rate_hz=2.0)
    tumble = [source(run, None, f'still{k}') for k, run in enumerate(later)]
    again = fit(tumble, FitOptions(gravity=G, prior=result.calibration)).calibration
    for coefficient in nonlinear_coefficients(again):
        before = terms[coefficient.name]
        assert np.abs(coefficient.value - before.value).max() < 3.0 * before.sd.max()
    units = [replace(again.unit, serial=f'{k}') for k in range(3)]
    siblings = [replace(again, unit=unit, gyroscope=None) for unit in units]
    assert population(siblings).nonlinearity is None
    alone = fit(tumble, FitOptions(gravity=G, model='golovach', k2_sd=5e-5))
    assert [finding.name for finding in alone.findings].count('nonlinearity') == 1
    (square, *_) = nonlinear_coefficients(alone.calibration)
    assert square.sd == pytest.approx(50.0, rel=0.2)


def test_the_claimed_covariance_includes_nonlinear_terms_and_radius(rng):
    truth, regression, state = table(rng, 1e-5, k3=1e-6, radius_sd=0.01)
    prior = prior_of(truth, (), nonlinear_sd=starting_sd(regression.forces, OPTIONS))
    posterior = regression.solve(state, prior, n_steps=12)
    typical = np.outer([1.0, 0.1], regression.windows.kelvins)
    chosen = Selected(posterior, score_of(regression, posterior), ())
    claim = claim_of(Fit(regression.windows, regression, chosen, typical))
    for name in ('nonlinear', 'radius', 'misalignment'):
        before, after = (getattr(layout, name) for layout in (posterior.layout, claim.layout))
        used = before >= 0
        claimed = np.diag(claim.covariance)[after[used]]
        np.testing.assert_allclose(claimed, posterior.variance[before[used]], rtol=1e-6)
