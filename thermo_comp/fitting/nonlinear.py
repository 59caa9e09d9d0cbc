# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the known |f| of positions that are not at 1 g, and the choice of the nonlinear terms.

A nonlinear term that the data determine is removed if the term lowers the log evidence by 1 or
more, or does not decrease the error of left-out |f| by more than a standard error. A term that the
data do not determine remains, and keeps approximately its prior mean and sd.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ..errors import FitError
from ..typing import Floats
from ..unit.calibration import Calibration, parameter_layout
from ..unit.nonlinearity import POWERS, Kind, Nonlinearity, NonlinearTerm, linearised, unit_of
from ..unit.posterior import Posterior
from .data_checks import Finding, advice
from .hyperparameters import CLEAR_GAIN, LEAST_GAIN
from .left_out import Score, score_of
from .options import FitOptions
from .regression import PosteriorMode, Regression
from .selection import Selected
from .thermal_ranges import union
from .unknowns import State
from .windows import ThermalWindows

# The data determine a coefficient if its posterior sd is less than a tenth of its prior sd, that
# is, if its effective number of parameters, 1 - (posterior sd / prior sd)^2, exceeds this value.
_DETERMINED_SHARE = 0.99

_Active = frozenset[int]  # indices of the nonlinear coefficients in use


@dataclass(frozen=True)
class Forces:
    """
    The known |f| of each position, ``|f|^2 = still^2 + spin^2``, shape (n_positions,) [m/s^2].

    kinds: the k nonlinear terms of the model, in the order of a calibration file; the coefficients
        at the reference temperature of all kinds precede the changes per kelvin of all kinds
    t: board temperature of each window less the reference, shape (n,) [K]
    still: stated |f| of a unit that does not rotate, or gravity
    spin: centripetal acceleration w^2 r at the stated radius; 0 without rotation
    sd: sd of |f|, without the part due to the error of the radius
    radius_sd: relative standard deviation of the radius; 0 if the radius is not estimated
    """

    kinds: tuple[Kind, ...]
    t: Floats
    still: Floats
    spin: Floats
    sd: Floats
    radius_sd: float = 0.0

    def norms(self, radius: Floats, stretch: Floats) -> Floats:
        """Return |f| of each position, given the relative errors of the radius and of |f|."""
        spin = self.spin * (1.0 + radius.sum())
        return np.asarray(np.hypot(self.still, spin) * (1.0 + stretch.sum(axis=1)))

    def by_radius(self, radius: Floats) -> Floats:
        """Differentiate the logarithm of |f| w.r.t. the relative error of the radius."""
        spin = self.spin * (1.0 + radius.sum())
        return np.asarray(self.spin * spin / (self.still**2 + spin**2))

    @property
    def sizes(self) -> Floats:
        """The stated |f| of each position, without corrections by the fit."""
        return np.hypot(self.still, self.spin)

    @property
    def stretch_sd(self) -> Floats:
        """Relative standard deviation of |f| of each position, above 0."""
        return np.maximum(self.sd / self.sizes, 1e-12)

    def terms(self, force: Floats) -> tuple[Floats, Floats]:
        """Return nonlinear terms of coefficient 1, and slopes over force, (*force.shape, k)."""
        each = {
            'square': (force**2, 2.0 * force),
            'odd_square': (np.abs(force) * force, 2.0 * np.abs(force)),
            'cube': (force**3, 3.0 * force**2),
        }
        pairs = [np.array(each[kind]) / unit_of(kind) for kind in self.kinds]
        value, slope = np.stack(pairs, axis=-1) if pairs else np.zeros((2, *force.shape, 0))
        return value, slope

    def linearise(self, x: Floats, nonlinear: Floats, rows: slice) -> Floats:
        """Return the force of windows, (n, 3), from `x`, the force plus the nonlinear terms."""
        k = len(self.kinds)
        at = nonlinear[:, :k] + self.t[rows, np.newaxis, np.newaxis] * nonlinear[:, k:]
        k2, kq, k3 = (
            at[..., self.kinds.index(kind)] / unit_of(kind)
            if kind in self.kinds
            else np.zeros_like(x)
            for kind in POWERS
        )
        return linearised(x, k2, kq, k3)


def with_forces(windows: ThermalWindows, options: FitOptions) -> ThermalWindows:
    """
    Add the stated |f| of the positions, and the nonlinear terms to be fitted, to the windows.

    The windows stay unchanged if all |f| are within 1e-3 of gravity, and neither the options nor
    the prior have nonlinear terms.
    """
    still, spin, sd, radii = _stated(windows, options)
    prior = options.prior.nonlinearity if options.prior else None
    is_usual = np.ptp([*np.hypot(still, spin), options.gravity]) < 1e-3 * options.gravity
    if is_usual and prior is None and options.k2_sd is None and options.k3_sd is None:
        return windows
    if len(radii) > 1:
        stated = ', '.join(f'{radius:g} +- {sd:g} m' for radius, sd in sorted(radii))
        raise FitError(f'the bags state different distances from the axis of rotation: {stated}')
    radius, radius_sd = next(iter(radii), (1.0, 0.0))
    if radius_sd and options.prior is not None:
        raise FitError(
            'a fit with --prior does not estimate the radius: leave out --radius-sd, or set the '
            'rotation_radius_sd_m in the metadata of the bags to 0'
        )
    kinds = tuple(POWERS) if prior is None else tuple(term.kind for term in prior.terms)
    t = windows.temperature - windows.model.reference_temperature
    forces = Forces(kinds, t, still, spin, sd, radius_sd / radius)
    return replace(windows, data=replace(windows.data, forces=forces))


def _stated(
    windows: ThermalWindows, options: FitOptions
) -> tuple[Floats, Floats, Floats, set[tuple[float, float]]]:
    """
    Return for each position the stated |f| at rest, the centripetal acceleration and the sd of
    |f| [m/s^2], shape (n_positions,); and the distances from the axis of rotation with their sd.
    """
    still, spin, sd = np.outer((options.gravity, 0.0, 0.0), np.ones(windows.data.n_positions))
    radii = set()
    for p, (bag, rest) in enumerate(windows.rests):
        if (known := bag.source.force) is not None:
            first_ns = bag.start_ns - round(bag.since_s * 1e9)
            size = known.of(rest.start_ns, rest.end_ns, first_ns, options.gravity)
            still[p], spin[p], sd[p] = size
            if known.radius:
                radii.add((known.radius, known.radius_sd))
    return still, spin, sd, radii


def judge_forces(windows: ThermalWindows, options: FitOptions) -> Iterator[Finding]:
    """Report stated |f| that differ so little from gravity that the fit does not use them."""
    still, spin, *_ = _stated(windows, options)
    sizes = np.hypot(still, spin)
    error = float(np.abs(sizes - options.gravity).max())
    if windows.data.forces is None and error > 1e-6 * options.gravity:
        text = (
            f'the bags state |f| of {sizes.min():.7g} to {sizes.max():.7g} m/s^2, within 1e-3 of '
            f'gravity, {options.gravity:.7g} m/s^2 (--gravity): the fit uses gravity. The scale '
            f'factors have an error of {1e6 * error / options.gravity:.0f} ppm if gravity is wrong'
        )
        yield advice('gravity', text)


def is_beyond(windows: ThermalWindows) -> bool:
    """Whether the stated |f| differs between positions."""
    forces = windows.data.forces
    return forces is not None and float(np.ptp(forces.sizes)) > 0.0


def prior_sd(kinds: Sequence[Kind], options: FitOptions) -> Floats:
    """Return prior sds of k nonlinear coefficients, then of their changes per kelvin, (2 k,)."""
    sd = np.array([options.nonlinear_sd(kind) for kind in kinds])
    return np.concatenate((sd, 0.02 * sd))


def starting_sd(forces: Forces, options: FitOptions) -> Floats:
    """Return the prior sds of the first fit, 0 for the term a |a| (`odd_square`), shape (2 k,)."""
    is_initial = np.array([kind != 'odd_square' for kind in forces.kinds] * 2)
    return np.asarray(prior_sd(forces.kinds, options) * is_initial)


class _TermFits:
    """Fits with different sets of nonlinear coefficients, and comparisons of these fits."""

    def __init__(self, regression: Regression, selected: Selected, sd: Floats) -> None:
        self._regression, self._begin, self._sd = regression, selected.posterior, sd
        self._n_kinds = len(sd) // 2
        self.posterior, self.score = cache(self._posterior), cache(self._score)

    def _posterior(self, used: _Active) -> PosteriorMode:
        is_used = np.isin(np.arange(len(self._sd)), list(used))
        prior = replace(self._begin.prior, nonlinear_sd=self._sd * is_used)
        return self._regression.solve(self._begin.state, prior)

    def _score(self, used: _Active) -> Score:
        return score_of(self._regression, self.posterior(used))

    def term(self, kind: int) -> _Active:
        """Return the indices of a term's coefficient, and of its change per kelvin."""
        return frozenset((kind, self._n_kinds + kind))

    def loss(self, used: _Active, dropped: _Active) -> float:
        """Return the decrease of the log evidence if the coefficients `dropped` are removed."""
        return self.posterior(used).log_evidence - self.posterior(used - dropped).log_evidence

    def left_out_gain(self, used: _Active, dropped: _Active) -> tuple[float, float]:
        """Return the log of (mean square error of |f| without / with `dropped`), and its sd."""
        return self.score(used - dropped).norms.gain_of(self.score(used).norms) or (0.0, 0.0)

    def is_determined(self, used: _Active, at: int) -> bool:
        """Whether the data determine a nonlinear coefficient, on average over the three axes."""
        posterior = self.posterior(used)
        share = posterior.determined[posterior.layout.nonlinear[:, at]]
        return bool(share.mean() > _DETERMINED_SHARE)

    def thinned(self, used: _Active) -> _Active:
        """Remove the determined terms that lower the log evidence by `LEAST_GAIN` or more."""
        kinds = [at for at in sorted(used) if at < self._n_kinds and self.is_determined(used, at)]
        losses = {at: self.loss(used, self.term(at)) for at in kinds}
        worst = min(losses, key=losses.__getitem__, default=None)
        if worst is None or losses[worst] > -LEAST_GAIN:
            return used
        return self.thinned(used - self.term(worst))


def choose(
    regression: Regression, selected: Selected, options: FitOptions
) -> tuple[Selected, tuple[NonlinearTerm, ...]]:
    """Choose nonlinear terms, and their changes per kelvin; a prior's terms are all kept."""
    forces = regression.forces
    if forces is None or options.prior is not None:
        return selected, ()
    k, sd = len(forces.kinds), prior_sd(forces.kinds, options)
    fits = _TermFits(regression, selected, sd)
    odd = fits.term(forces.kinds.index('odd_square'))
    used = fits.thinned(frozenset(range(2 * k)) - odd)
    if fits.loss(used | odd, odd) > CLEAR_GAIN:
        gain, error = fits.left_out_gain(used | odd, odd)
        used = fits.thinned(used | odd) if gain > error else used
    for at in sorted(at for at in used if at < k):
        gain, error = fits.left_out_gain(used, fits.term(at))
        if gain <= error and fits.is_determined(used, at):
            used -= fits.term(at)
    kept = sorted(at for at in used if at < k)
    for at in kept:
        per_kelvin = frozenset((k + at,))
        if fits.is_determined(used, k + at) and fits.loss(used, per_kelvin) < -LEAST_GAIN:
            used -= per_kelvin
    posterior, score = fits.posterior(used), fits.score(used)
    trials = tuple(
        replace(trial, posterior=posterior, score=score) if trial.is_chosen else trial
        for trial in selected.trials
    )
    terms = []
    for at in kept:
        of_term = fits.loss(used, fits.term(at)), fits.left_out_gain(used, fits.term(at))[0]
        places = posterior.layout.nonlinear[:, [at, k + at]]
        determined = max(float(posterior.determined[places[places >= 0]].sum()), 0.0)
        terms.append(_blank_term(forces.kinds[at], float(sd[at]), determined, *of_term))
    return Selected(posterior, score, trials), tuple(terms)


def _blank_term(kind: Kind, sd: float, *evidence: float) -> NonlinearTerm:
    return NonlinearTerm(kind, (0.0,) * 3, (0.0,) * 3, sd, *evidence)


def of_file(
    regression: Regression, terms: Sequence[NonlinearTerm], options: FitOptions
) -> Nonlinearity | None:
    """Return the nonlinearity for a calibration file, with all coefficients 0."""
    forces = regression.forces
    if forces is None:
        return None
    prior = options.prior.nonlinearity if options.prior else None
    # The calibrated range of |f| extends 1 % beyond the least and largest |f| of the positions.
    valid = 0.99 * float(forces.sizes.min()), 1.01 * float(forces.sizes.max())
    if prior is None:
        return Nonlinearity(valid, options.nonlinear_sd('square'), tuple(terms))
    blank = (replace(term, coefficient=(0.0,) * 3, per_kelvin=(0.0,) * 3) for term in prior.terms)
    valid = union((valid, prior.force_range_m_s2))
    return Nonlinearity(valid, prior.beyond_sd_g_g2, tuple(blank))


def with_terms(state: State, calibration: Calibration) -> State:
    """Set the nonlinear coefficients of a state to the values in a calibration."""
    if calibration.nonlinearity is None:
        return state
    terms = calibration.nonlinearity.terms
    each = [term.coefficient for term in terms] + [term.per_kelvin for term in terms]
    return replace(state, nonlinear=np.reshape(each, (-1, 3)).T.copy())


def with_blank(calibration: Calibration, options: FitOptions) -> Calibration:
    """Add the terms square and cube, with prior sd, to a calibration without nonlinearity."""
    posterior, at = calibration.posterior, parameter_layout(calibration).misalignment
    if posterior is None:
        return calibration
    kinds: tuple[Kind, ...] = ('square', 'cube')
    sd = np.tile(prior_sd(kinds, options), 3)
    factor = np.insert(posterior.matrix, [at] * len(sd), 0.0, axis=0)
    variances = np.insert(posterior.variances, [at] * len(sd), sd**2)
    terms = tuple(_blank_term(kind, options.nonlinear_sd(kind)) for kind in kinds)
    valid = 0.99 * calibration.gravity_m_s2, 1.01 * calibration.gravity_m_s2
    return replace(
        calibration,
        nonlinearity=Nonlinearity(valid, options.nonlinear_sd('square'), terms),
        posterior=Posterior.of(factor, variances),
    )


def without_terms(calibration: Calibration) -> Calibration:
    """Remove the nonlinear terms of a calibration, and their rows of its covariance."""
    layout, posterior = parameter_layout(calibration), calibration.posterior
    if posterior is not None:
        rows = np.arange(layout.nonlinear, layout.misalignment)
        kept = np.delete(posterior.matrix, rows, axis=0), np.delete(posterior.variances, rows)
        posterior = Posterior.of(*kept)
    return replace(calibration, nonlinearity=None, posterior=posterior)


def judge_terms(calibration: Calibration) -> Iterator[Finding]:
    """Advise more positions if the data do not determine some nonlinear terms."""
    terms = calibration.nonlinearity.terms if calibration.nonlinearity else ()
    undetermined = ', '.join(
        f'{term.kind} (effective parameters {term.effective_parameters:.1f} of 6)'
        for term in terms
        if term.effective_parameters < 3.0 * _DETERMINED_SHARE
    )
    if undetermined:
        yield advice(
            'nonlinearity',
            'the positions do not determine these terms of the nonlinearity, which stay near '
            f'their prior: {undetermined}; positions at several |f| above 1 g determine them',
        )
