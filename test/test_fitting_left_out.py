# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Models are compared by their errors for data that were left out of the fit."""

from types import SimpleNamespace

import numpy as np

from thermo_comp.fitting.left_out import Folds, Score, is_better, is_undecided
from thermo_comp.fitting.selection import Trial, better_start

MICRO = 9.80665e-6  # a micro-g [m/s^2]


def score(drift, norms=(), by_thermometer=0.0):
    """Return a score with left-out drifts of equal size and the given errors of |f| [ug]."""
    drifts = Folds(np.full(18, (drift * MICRO) ** 2), np.full(18, 20.0))
    of_norms = Folds((np.array(norms) * MICRO) ** 2, np.full(len(norms), 20.0))
    none = np.zeros((0, 3))
    return Score(
        drifts, drifts, of_norms, none, none, drifts, by_thermometer=by_thermometer * MICRO
    )


def test_few_norms_that_both_models_predict_do_not_select_the_model():
    # WHY: a MEMS was recorded in six faces at three temperatures. Only four left-out values of |f|
    # could be predicted both with and without a curve over temperature. The curve reduced their
    # errors by less than two standard errors, so the fit left it out: the force error was 7 mg.
    constants = score(20.0, [22.4, 457.7, 54.6, 26.1])
    curve = score(20.0, [16.8, 21.0, 22.5, 25.2])
    assert not is_better(constants, curve)
    assert is_undecided(constants, curve)
    assert not is_undecided(curve, constants)
    assert is_better(constants, score(20.0, [2.0, 40.0, 5.0, 2.0]))


def test_a_larger_model_must_not_explain_the_errors_of_a_coarse_thermometer():
    # WHY: readings in steps of 1 K have equal errors in all bags of one temperature program. Knees
    # in the curve halved the left-out drift, but doubled the error in another program.
    by_thermometer = 49.0
    curve, parts, bends = (score(drift, (), by_thermometer) for drift in (120.0, 46.0, 20.0))
    assert is_better(curve, parts)
    assert not is_better(parts, bends)
    # Errors of |f| that are larger than the error of the thermometer decide for the curve.
    flat, curved = (score(46.0, size * np.ones(9), by_thermometer) for size in (3000.0, 60.0))
    assert is_better(flat, curved)
    assert not is_better(curved, score(20.0, 30.0 * np.ones(9), by_thermometer))
    # With a thermometer error of 5 ug a reduction of the left-out drift from 46 to 20 ug counts.
    assert is_better(score(46.0, (), 5.0), score(20.0, (), 5.0))


def test_a_fit_with_large_mounting_offsets_must_not_increase_left_out_norms():
    # WHY: a fit with mounting offsets of 5 mg attributed a random walk of the bias (20 ug in an
    # hour) to scale factors: the evidence of this fit was larger, but its force error was 5 mg.
    def trial(norm, log_evidence):
        posterior = SimpleNamespace(
            prior=SimpleNamespace(offset_scale=0.0, informative=None),
            layout=SimpleNamespace(pose=np.zeros(0)),
            log_evidence=log_evidence,
        )
        norms = norm * np.linspace(0.5, 1.5, 12)
        return Trial((), score(17.0, norms), posterior, np.zeros(0))

    small, spoilt, likelier = trial(67.0, 54462.0), trial(33564.0, 55002.0), trial(67.0, 55002.0)
    assert better_start([small, spoilt]) is small
    assert better_start([small, likelier]) is likelier
