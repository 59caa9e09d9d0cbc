# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the choice of the nonlinear terms of a fit: by evidence, and by left-out norms.

A term that the data determine leaves if it lowers the log evidence, or if left-out norms are no
better with it. A term that they do not determine stays near its prior, with its uncertainty.
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
from .left_out import Score, score_of
from .options import FitOptions
from .reduction import ReducedBag
from .regression import Posterior, Regression
from .selection import Selected
from .unknowns import Prior, State
from .windows import ThermalWindows

# |f| differs from gravity if it is off by this part.
_DIFFERS = 1e-3
# A coefficient changes by this part of its prior sd per kelvin, 1 sd.
_SLOPE_SHARE = 0.02
# A change of the log evidence that counts (a bare mention: Kass and Raftery, 1995), and the one
# for which |f| f, which square and cube nearly imitate, joins.
_COUNTS, _JOINS = 1.0, 4.0
# Effective parameters per coefficient from which the data, not the prior, determine it: its sd is
# then a tenth of the prior's.
_DETERMINED = 0.99
# The range of |f| in a file is wider than that of the positions by this part.
_MARGIN = 0.01
_NIL = (0.0, 0.0, 0.0)

_Used = frozenset[int]  # places of coefficients that take part


def with_forces(
    windows: ThermalWindows, bags: Sequence[ReducedBag], options: FitOptions
) -> ThermalWindows:
    """Add |f| of the positions, where it is not gravity or nonlinear terms are asked for."""
    still, spin, sd = np.full((3, windows.data.n_positions), 0.0)
    still[:] = options.gravity
    for p, (bag, rest) in enumerate(windows.rests):
        if (known := bag.source.force) is not None:
            first_ns = bag.start_ns - round(bag.since_s * 1e9)
            size, spin[p], sd[p] = known.of(rest.start_ns, rest.end_ns, first_ns)
            still[p] = options.gravity if size is None else size
    prior = options.prior.nonlinearity if options.prior else None
    is_usual = np.ptp([*np.hypot(still, spin), options.gravity]) < _DIFFERS * options.gravity
    if is_usual and prior is None and options.k2_sd is None and options.k3_sd is None:
        return windows
    rotating = [one.source.force for one in bags if one.source.force and one.source.force.radius]
    radii = {(one.radius, one.radius_sd) for one in rotating}
    if len(radii) > 1:
        raise FitError(f'the bags state different radii: {sorted(radii)}')
    radius, radius_sd = next(iter(radii), (1.0, 0.0))
    if radius_sd and options.prior is not None:
        raise FitError('a fit with a prior takes the radius as given: leave out --radius-sd')
    kinds = tuple(POWERS) if prior is None else tuple(one.kind for one in prior.terms)
    t = windows.temperature - windows.model.reference_temperature
    forces = Forces(kinds, t, still, spin, sd, radius_sd / radius)
    return replace(windows, data=replace(windows.data, forces=forces))


def is_beyond(windows: ThermalWindows) -> bool:
    """Whether |f| differs between the positions: the unit rotated in some of them."""
    forces = windows.data.forces
    return forces is not None and float(np.ptp(forces.sizes)) > 0.0


def prior_sd(forces: Forces, options: FitOptions) -> Floats:
    """Prior sd of the coefficients at the reference, then per kelvin, shape (2 k,)."""
    sd = np.array([options.nonlinear_sd(kind) for kind in forces.kinds])
    return np.concatenate((sd, _SLOPE_SHARE * sd))


def starting_sd(forces: Forces, options: FitOptions) -> Floats:
    """Return the same for the terms that a fit begins with: square and cube."""
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
    def fitted(used: _Used) -> tuple[Posterior, Prior]:
        prior = replace(selected.prior, nonlinear_sd=wide * np.isin(np.arange(2 * k), list(used)))
        return regression.solve(selected.posterior.state, prior), prior

    @cache
    def score(used: _Used) -> Score:
        return score_of(regression, *fitted(used))

    def loss(used: _Used, without: _Used) -> float:
        return fitted(used)[0].log_evidence - fitted(without)[0].log_evidence

    def left_out_gain(used: _Used, without: _Used) -> tuple[float, float]:
        return score(without).norms.gain_of(score(used).norms) or (0.0, 0.0)

    def is_determined(used: _Used, at: int) -> bool:
        posterior = fitted(used)[0]
        share = posterior.determined[posterior.layout.nonlinear[:, at]]
        return bool(share.mean() > _DETERMINED)

    def thinned(used: _Used) -> _Used:
        asked = [at for at in range(k) if at in used and is_determined(used, at)]
        losses = {at: loss(used, used - {at, k + at}) for at in asked}
        worst = min(losses, key=losses.__getitem__, default=None)
        if worst is None or losses[worst] > -_COUNTS:
            return used
        return thinned(used - {worst, k + worst})

    odd = forces.kinds.index('odd_square')
    used = thinned(frozenset(range(2 * k)) - {odd, k + odd})
    joined = used | {odd, k + odd}
    if loss(joined, used) > _JOINS:
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
        if is_determined(used, k + at) and loss(used, used - {k + at}) < -_COUNTS:
            used = used - {k + at}
    posterior, prior = fitted(used)
    fit: dict[str, Any] = {'score': score(used), 'posterior': posterior, 'prior': prior}
    trials = tuple(replace(one, **fit) if one.is_chosen else one for one in selected.trials)
    terms = []
    for at, evidence in found.items():
        places = posterior.layout.nonlinear[:, [at, k + at]]
        determined = max(float(posterior.determined[places[places >= 0]].sum()), 0.0)
        terms.append(blank_term(forces.kinds[at], float(wide[at]), determined, *evidence))
    return replace(selected, **fit, trials=trials), tuple(terms)


def blank_term(kind: Kind, sd: float, *evidence: float) -> NonlinearTerm:
    """Make a term without coefficients."""
    return NonlinearTerm(kind, _NIL, _NIL, sd, *evidence)


def of_file(
    regression: Regression, terms: Sequence[NonlinearTerm], options: FitOptions
) -> Nonlinearity | None:
    """Make the nonlinearity of a file, its coefficients still 0."""
    forces = regression.forces
    if forces is None:
        return None
    known = options.prior.nonlinearity if options.prior else None
    sizes = forces.sizes
    low, high = (1.0 - _MARGIN) * float(sizes.min()), (1.0 + _MARGIN) * float(sizes.max())
    if known:
        low, high = min(low, known.force_range_m_s2[0]), max(high, known.force_range_m_s2[1])
    sd = known.beyond_sd_g_g2 if known else options.nonlinear_sd('square')
    kept = known.terms if known else terms
    blank = (replace(one, coefficient=_NIL, per_kelvin=_NIL) for one in kept)
    return Nonlinearity((low, high), sd, tuple(blank))


def with_terms(state: State, calibration: Calibration) -> State:
    """Give a state the nonlinear coefficients of a prior calibration."""
    if calibration.nonlinearity is None:
        return state
    terms = calibration.nonlinearity.terms
    each = [one.coefficient for one in terms] + [one.per_kelvin for one in terms]
    return replace(state, nonlinear=np.reshape(each, (-1, 3)).T.copy())


def with_blank(calibration: Calibration, options: FitOptions) -> Calibration:
    """Give a prior without a nonlinearity square and cube, unknown but for their prior sd."""
    posterior, at = calibration.posterior, parameter_layout(calibration).misalignment
    if calibration.nonlinearity is not None or posterior is None:
        return calibration
    sd = [options.nonlinear_sd('square'), options.nonlinear_sd('cube')]
    each = np.tile([*sd, *(_SLOPE_SHARE * one for one in sd)], 3)
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
    """Leave out the nonlinearity: what remains is the same at 1 g, and its covariance wider."""
    layout, posterior = parameter_layout(calibration), calibration.posterior
    if posterior is not None:
        gone = np.arange(layout.nonlinear, layout.misalignment)
        kept = np.delete(posterior.matrix, gone, axis=0), np.delete(posterior.variances, gone)
        posterior = FilePosterior.of(*kept)
    return replace(calibration, nonlinearity=None, posterior=posterior)


def judge_terms(calibration: Calibration) -> list[Finding]:
    """Say which coefficients the data have not determined."""
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
