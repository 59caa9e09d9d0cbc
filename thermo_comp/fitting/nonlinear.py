# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the choice of the nonlinear terms of a fit by log evidence and by left-out norms.

A term that the data determine is removed if it lowers the log evidence, or if it does not improve
the left-out norms. A term that the data do not determine stays near its prior, with the prior sd.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from ..errors import FitError
from ..typing import Floats
from ..unit.calibration import Calibration, parameter_layout
from ..unit.nonlinearity import POWERS, Kind, Nonlinearity, NonlinearTerm
from ..unit.posterior import Posterior as FilePosterior
from .data_checks import Finding
from .forces import Forces
from .growth import LEAST_GAIN, TRIAL_GAIN
from .left_out import Score, score_of
from .options import FitOptions
from .reduction import ReducedBag
from .regression import Posterior, Regression
from .selection import Selected
from .unknowns import Prior, State
from .windows import ThermalWindows

# Prior sd of a coefficient's change per kelvin over that of the coefficient [1/K].
_SLOPE_RATIO = 0.02
# Effective parameters per coefficient from which the data determine it: 0.99 means that the
# posterior sd is a tenth of the prior sd.
_DETERMINED = 0.99
_ZERO = (0.0, 0.0, 0.0)

_Active = frozenset[int]  # places of the coefficients in use


def with_forces(
    windows: ThermalWindows, bags: Sequence[ReducedBag], options: FitOptions
) -> ThermalWindows:
    """
    Add |f| of the positions and the nonlinear terms to the windows.

    They stay unchanged if |f| is within 1e-3 of gravity in all positions, and neither the options
    nor the prior have nonlinear terms.
    """
    still, spin, sd = np.full((3, windows.data.n_positions), 0.0)
    still[:] = options.gravity
    for p, (bag, rest) in enumerate(windows.rests):
        if (known := bag.source.force) is not None:
            first_ns = bag.start_ns - round(bag.since_s * 1e9)
            size, spin[p], sd[p] = known.of(rest.start_ns, rest.end_ns, first_ns)
            still[p] = options.gravity if size is None else size
    prior = options.prior.nonlinearity if options.prior else None
    is_usual = np.ptp([*np.hypot(still, spin), options.gravity]) < 1e-3 * options.gravity
    if is_usual and prior is None and options.k2_sd is None and options.k3_sd is None:
        return windows
    rotating = [bag.source.force for bag in bags if bag.source.force and bag.source.force.radius]
    radii = {(one.radius, one.radius_sd) for one in rotating}
    if len(radii) > 1:
        raise FitError(f'the bags state different radii: {sorted(radii)}')
    radius, radius_sd = next(iter(radii), (1.0, 0.0))
    if radius_sd and options.prior is not None:
        raise FitError('a fit with a prior takes the radius as given: leave out --radius-sd')
    kinds = tuple(POWERS) if prior is None else tuple(term.kind for term in prior.terms)
    t = windows.temperature - windows.model.reference_temperature
    forces = Forces(kinds, t, still, spin, sd, radius_sd / radius)
    return replace(windows, data=replace(windows.data, forces=forces))


def is_beyond(windows: ThermalWindows) -> bool:
    """Whether |f| differs between the positions."""
    forces = windows.data.forces
    return forces is not None and float(np.ptp(forces.sizes)) > 0.0


def prior_sd(forces: Forces, options: FitOptions) -> Floats:
    """Return the prior sd of the coefficients at the reference, then per kelvin, (2 k,)."""
    sd = np.array([options.nonlinear_sd(kind) for kind in forces.kinds])
    return np.concatenate((sd, _SLOPE_RATIO * sd))


def starting_sd(forces: Forces, options: FitOptions) -> Floats:
    """Return the prior sd of the initial terms, square and cube; 0 for the other."""
    begins = np.array([kind != 'odd_square' for kind in forces.kinds])
    return np.asarray(prior_sd(forces, options) * np.tile(begins, 2))


def choose(
    regression: Regression, selected: Selected, options: FitOptions
) -> tuple[Selected, tuple[NonlinearTerm, ...]]:
    """Choose the nonlinear terms, and of each whether it changes with temperature."""
    forces = regression.forces
    if forces is None:
        return selected, ()
    k, wide = len(forces.kinds), prior_sd(forces, options)

    @cache
    def fitted(used: _Active) -> tuple[Posterior, Prior]:
        prior = replace(selected.prior, nonlinear_sd=wide * np.isin(np.arange(2 * k), list(used)))
        return regression.solve(selected.posterior.state, prior), prior

    @cache
    def score(used: _Active) -> Score:
        return score_of(regression, *fitted(used))

    def loss(used: _Active, without: _Active) -> float:
        return fitted(used)[0].log_evidence - fitted(without)[0].log_evidence

    def left_out_gain(used: _Active, without: _Active) -> tuple[float, float]:
        return score(without).norms.gain_of(score(used).norms) or (0.0, 0.0)

    def is_determined(used: _Active, at: int) -> bool:
        posterior = fitted(used)[0]
        share = posterior.determined[posterior.layout.nonlinear[:, at]]
        return bool(share.mean() > _DETERMINED)

    def thinned(used: _Active) -> _Active:
        asked = [at for at in range(k) if at in used and is_determined(used, at)]
        losses = {at: loss(used, used - {at, k + at}) for at in asked}
        worst = min(losses, key=losses.__getitem__, default=None)
        if worst is None or losses[worst] > -LEAST_GAIN:
            return used
        return thinned(used - {worst, k + worst})

    odd = forces.kinds.index('odd_square')
    used = thinned(frozenset(range(2 * k)) - {odd, k + odd})
    joined = used | {odd, k + odd}
    if loss(joined, used) > TRIAL_GAIN:
        gain, error = left_out_gain(joined, used)
        used = thinned(joined) if gain > error else used
    found: dict[int, tuple[float, float]] = {}
    for at in sorted(at for at in used if at < k):
        without = used - {at, k + at}
        gain, error = left_out_gain(used, without)
        if gain <= error and is_determined(used, at):
            used = without
        else:
            found[at] = loss(used, without), gain
    for at in found:
        if is_determined(used, k + at) and loss(used, used - {k + at}) < -LEAST_GAIN:
            used = used - {k + at}
    posterior, prior = fitted(used)
    fit: dict[str, Any] = {'score': score(used), 'posterior': posterior, 'prior': prior}
    trials = tuple(
        replace(trial, **fit) if trial.is_chosen else trial for trial in selected.trials
    )
    terms = []
    for at, evidence in found.items():
        places = posterior.layout.nonlinear[:, [at, k + at]]
        determined = max(float(posterior.determined[places[places >= 0]].sum()), 0.0)
        terms.append(blank_term(forces.kinds[at], float(wide[at]), determined, *evidence))
    return replace(selected, **fit, trials=trials), tuple(terms)


def blank_term(kind: Kind, sd: float, *evidence: float) -> NonlinearTerm:
    """Return a term with all coefficients 0."""
    return NonlinearTerm(kind, _ZERO, _ZERO, sd, *evidence)


def of_file(
    regression: Regression, terms: Sequence[NonlinearTerm], options: FitOptions
) -> Nonlinearity | None:
    """Return the nonlinearity for a file, with all coefficients 0."""
    forces = regression.forces
    if forces is None:
        return None
    known = options.prior.nonlinearity if options.prior else None
    sizes = forces.sizes
    # The file's range of |f| is 1 % wider than that of the positions at either end.
    low, high = 0.99 * float(sizes.min()), 1.01 * float(sizes.max())
    if known:
        low, high = min(low, known.force_range_m_s2[0]), max(high, known.force_range_m_s2[1])
    sd = known.beyond_sd_g_g2 if known else options.nonlinear_sd('square')
    kept = known.terms if known else terms
    blank = (replace(term, coefficient=_ZERO, per_kelvin=_ZERO) for term in kept)
    return Nonlinearity((low, high), sd, tuple(blank))


def with_terms(state: State, calibration: Calibration) -> State:
    """Set the nonlinear coefficients of a state to those of a calibration."""
    if calibration.nonlinearity is None:
        return state
    terms = calibration.nonlinearity.terms
    each = [term.coefficient for term in terms] + [term.per_kelvin for term in terms]
    return replace(state, nonlinear=np.reshape(each, (-1, 3)).T.copy())


def with_blank(calibration: Calibration, options: FitOptions) -> Calibration:
    """Add square and cube with their prior sd to a prior that has no nonlinearity."""
    posterior, at = calibration.posterior, parameter_layout(calibration).misalignment
    if calibration.nonlinearity is not None or posterior is None:
        return calibration
    sd = [options.nonlinear_sd('square'), options.nonlinear_sd('cube')]
    each = np.tile([*sd, *(_SLOPE_RATIO * value for value in sd)], 3)
    factor = np.insert(posterior.matrix, [at] * len(each), 0.0, axis=0)
    rest = np.insert(posterior.variances, [at] * len(each), each**2)
    terms = (blank_term('square', sd[0]), blank_term('cube', sd[1]))
    gravity = calibration.gravity_m_s2
    return replace(
        calibration,
        nonlinearity=Nonlinearity((0.99 * gravity, 1.01 * gravity), sd[0], terms),
        posterior=FilePosterior.of(factor, rest),
    )


def without_terms(calibration: Calibration) -> Calibration:
    """Remove the nonlinear terms of a calibration, and their rows of its covariance."""
    layout, posterior = parameter_layout(calibration), calibration.posterior
    if posterior is not None:
        gone = np.arange(layout.nonlinear, layout.misalignment)
        kept = np.delete(posterior.matrix, gone, axis=0), np.delete(posterior.variances, gone)
        posterior = FilePosterior.of(*kept)
    return replace(calibration, nonlinearity=None, posterior=posterior)


def judge_terms(calibration: Calibration) -> list[Finding]:
    """Advise more positions if the data do not determine some nonlinear terms."""
    nonlinearity = calibration.nonlinearity
    if nonlinearity is None:
        return []
    open_ones = [
        f'{one.kind} (effective parameters {one.effective_parameters:.1f} of 6)'
        for one in nonlinearity.terms
        if one.effective_parameters < 3.0 * _DETERMINED
    ]
    if not open_ones:
        return []
    text = (
        f'the positions do not determine the nonlinearity: {", ".join(open_ones)} stays near its '
        'prior; positions at several |f| above 1 g determine it'
    )
    return [Finding('nonlinearity', 'advice', text)]
