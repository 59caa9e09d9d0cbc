# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the measurement equation of the windows, and its linearisation.

Equation [m/s^2] of the mean sample N of window w, position p, axis i; K0: nominal scale::

    N / K0 = kappa a (1 + S s) + b + B beta + o_p + o_b + kappa (A l_p)_i g + noise,
    a = (A u_p)_i g,  A = M^-1,  M: misalignment,  kappa: scale factor / K0,  b: bias,
    u_p: attitude,  l_p, perpendicular to u_p: tilt of the support,
    o_p, o_b: bias offsets of the position and of the turn-on (bag)

B and S are columns of the table in `unit.columns`, each divided by its RMS, with the weights beta
and s. For an angular rate g is 0, which leaves bias b, columns B beta and offsets o_p. If |f|
differs between positions, |f| replaces g, and the terms ``kappa sum_j (k_j + k'_j t) n_j(a)`` of
`nonlinear` are added, t: T_board - T_reference. All terms of this equation are linear combinations
of the base series (`series`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..typing import Bools, Floats, Ints
from ..unit.metrics import means_by
from .layout import Layout, Tangent, lay_out
from .series import Base, Series
from .unknowns import Prior, State, Windows


class Equations(Series):
    """
    The measurement equations of a fit.

    windows: the data of the fit
    gravity: local gravity [m/s^2]; 0 for an angular rate
    nominal_scale: nominal scale factors K0 [input units per m/s^2], shape (3,)
    """

    def __init__(self, windows: Windows, gravity: float, nominal_scale: Floats) -> None:
        self.gravity = gravity
        self.forces = windows.forces if gravity else None
        self.n_coefficients = 2 * len(self.forces.kinds) if self.forces else 0
        self.has_turn_ons = windows.has_turn_ons and gravity != 0.0
        t = np.zeros((len(windows.time), 0)) if self.forces is None else self.forces.t[:, None]
        super().__init__(windows, nominal_scale, t)
        self._layouts: dict[bytes, Layout] = {}

    def initial_state(self, bias: Floats, misalignment: Floats, up: Floats) -> State:
        """Return a state with nominal scale factors and no effect of temperature."""
        poses = [up[self.windows.pose == k].mean(axis=0) for k in range(self.windows.n_poses)]
        return State(
            kappa=np.ones(3),
            bias=bias,
            weights=np.zeros((2, 3, len(self.windows.groups))),
            misalignment=misalignment,
            up=up,
            offset=np.zeros((len(up), 3)),
            tilt=np.zeros((len(up), self.windows.tilt.shape[1], 2)),
            start=np.zeros((self.n_bags, self.start_root.shape[1])),
            turn_on=np.zeros((self.n_bags, 3 * self.has_turn_ons)),
            nonlinear=np.zeros((3, self.n_coefficients)),
            radius=np.zeros(1),
            stretch=np.zeros((len(up), 1)),
            pose=_unit_vector(np.reshape(poses, (-1, 3))),
            pose_of=np.zeros(0, np.int64) if self.windows.pose is None else self.windows.pose,
        )

    def norms(self, state: State) -> Floats:
        """Return |f| of each position, without its relative error `State.stretch`, shape (n,)."""
        if self.forces is None:
            return np.full(self.windows.n_positions, self.gravity)
        return self.forces.norms(state.radius, np.zeros_like(state.stretch))

    def _norm(self, state: State) -> float | Floats:
        if self.forces is None:
            return self.gravity
        return np.asarray(self.forces.norms(state.radius, state.stretch)[:, None])

    def layout(self, used: Bools, nonlinear: Bools | None = None) -> Layout:
        """Return the indices of the unknowns; `nonlinear`: active coefficients, None for all."""
        if nonlinear is None:
            nonlinear = np.ones(self.n_coefficients, dtype=bool)
        key = used.tobytes() + nonlinear.tobytes()
        if key not in self._layouts:
            has_lags = bool((self.windows.lag[used.any(axis=0)] >= 0).any())
            n_tilts, n_starts = self.windows.tilt.shape[1], self.start_root.shape[1] * has_lags
            self._layouts[key] = lay_out(
                *(used, nonlinear, self.bag_of_position, self.windows.pose),
                *(n_tilts, n_starts, self.has_turn_ons, self.forces),
            )
        return self._layouts[key]

    def along(self, state: State) -> Floats:
        """Return the specific force along each axis in each position, shape (n_positions, 3)."""
        return np.asarray(self._norm(state) * state.up @ state.inverse.T)

    def _effects(self, state: State) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """
        Return, at the reference temperature, the force `along` the axes; derivatives of samples
        w.r.t. rotations of the attitude, (n_positions, 3, 2); samples without the bias,
        (n_positions, 3); the sum of the nonlinear terms and the sum of their changes per kelvin,
        (2, n_positions, 3); and the derivatives of these two sums w.r.t. the force.
        """
        force = self.along(state)
        along_axes = np.einsum('ij,pjt->pit', state.inverse, state.tangents)
        sizes = np.reshape(self._norm(state), (-1, 1, 1))
        by_rotation = sizes * (state.kappa[:, None] * along_axes)
        if self.forces is None:
            terms, slopes = np.zeros((2, 2, *force.shape))
        else:
            each = np.stack(self.forces.terms(force))
            terms, slopes = np.einsum('vpik,ijk->vjpi', each, state.nonlinear.reshape(3, 2, -1))
        return force, by_rotation, state.kappa * (force + terms[0]), terms, slopes

    def tangent(self, state: State, layout: Layout, base: Base) -> Tangent:
        """Linearise the measurement equations about a state."""
        force, by_rotation, without_bias, _, _ = self._effects(state)
        along = (state.kappa * force)[..., None]
        n_starts, n_stretches = layout.start.shape[1], layout.stretch.shape[1]
        scaled, by_kappa, by_force = (base.size + k for k in range(3))
        starts = base.size + 3 + np.arange(n_starts)
        in_bias, in_scale = (1 + np.flatnonzero(mask[base.columns]) for mask in layout.used)
        # A rotation of a pose rotates the attitude of each position that is in this pose.
        is_in_pose = layout.pose_of[:, None] == np.arange(len(layout.pose))
        by_poses = by_rotation[:, :, None] * is_in_pose[:, None, :, None]
        by_radius: Floats | float = 1.0
        if self.forces is not None:
            by_radius = self.forces.by_radius(state.radius)[:, None, None] * along
        unknowns: list[tuple[Ints | list[int], Floats | float]] = [
            ([by_force] * 2, by_rotation),
            ([by_force] * n_stretches, along),
            ([0], 1.0),
            (np.repeat(base.tilts, 2), np.tile(by_rotation, len(base.tilts))),
            (starts, 1.0),
            ([0] * self.has_turn_ons, 1.0),
            ([by_kappa, 0], 1.0),
            (in_bias, 1.0),
            (in_scale, without_bias[..., None]),
            self._by_coefficients(state, layout, base, scaled),
            ([by_force] * layout.radius.size, by_radius),
            ([by_force] * 3, self._by_misalignment(state)),
            ([by_force] * layout.pose.size, by_poses.reshape(*force.shape, -1)),
            ([base.size + 3 + n_starts], 1.0),
        ]
        place = np.array([k for at, _ in unknowns for k in at], dtype=np.int64)
        factor, first = np.empty((*force.shape, len(place))), 0
        for at, value in unknowns:
            factor[..., first : first + len(at)] = value
            first += len(at)
        combined = self._combined(state, base, n_starts)
        n_bias, n_scale = 1 + len(in_bias), len(in_scale)
        return Tangent(combined, place, factor, layout.n_local, n_bias, n_scale, without_bias)

    def _combined(self, state: State, base: Base, n_starts: int) -> Floats:
        """
        Return, as combinations of base series (see `Tangent`): 1 + S s of the scale; derivatives
        of samples w.r.t. kappa, force along the axis and initial lag states; the residual.
        """
        force, _, without_bias, (terms, terms_by_t), (slope, slope_by_t) = self._effects(state)
        on_bias, on_scale = state.weights[:, :, base.columns]
        result = np.zeros((*force.shape, base.size, 4 + n_starts))
        result[:, :, 0, :3] = 1.0
        result[:, :, 1 : 1 + len(base.columns), :3] = on_scale[..., None]
        result[..., 1] *= (force + terms)[..., None]
        result[..., 2] *= (1.0 + slope)[..., None]
        result[:, :, base.t, 1] = terms_by_t[..., None]
        result[:, :, base.t, 2] = slope_by_t[..., None]
        if n_starts:
            weight = (on_bias + without_bias[..., None] * on_scale)[..., base.lagged, None]
            result[:, :, base.at_start, 3:-1] = weight * self.start_root[base.lag]
        result[..., -1] = self.misfit(state, base)
        return result

    def _by_coefficients(
        self, state: State, layout: Layout, base: Base, scaled: int
    ) -> tuple[Ints, Floats | float]:
        """
        Return `place` and `factor` of the `Tangent` for each active nonlinear coefficient.

        The factor 1 + S s of the scale multiplies the nonlinear terms at the reference
        temperature. The changes per kelvin of these terms lack this factor, whose effect on them
        is negligible.
        """
        active = np.flatnonzero(layout.nonlinear[0] >= 0)
        if self.forces is None or not len(active):
            return active, 1.0
        k = len(self.forces.kinds)
        value, _ = self.forces.terms(self.along(state))
        place = np.where(active < k, scaled, base.t[0])
        return place, state.kappa[:, None] * value[..., active % k]

    def _by_misalignment(self, state: State) -> Floats:
        """Return derivatives of kappa times the force w.r.t. the elements of M^-1, (n, 3, 3)."""
        result = np.zeros((len(state.up), 3, 3))
        # Rows and columns of the three elements below the diagonal of the inverse of M.
        rows, columns = [1, 2, 2], [0, 0, 1]
        components = (self._norm(state) * state.up)[:, columns]
        result[:, rows, [0, 1, 2]] = state.kappa[rows] * components
        return result

    def misfit(self, state: State, base: Base) -> Floats:
        """Return the residual as combinations of the base series, (n_positions, 3, n_base)."""
        force, by_rotation, without_bias, (_, terms_by_t), _ = self._effects(state)
        on_bias, on_scale = state.weights[:, :, base.columns]
        result = np.zeros((*force.shape, base.size))
        result[:, :, 0] = self.level - (without_bias + state.bias + state.offset)
        if self.has_turn_ons:
            result[:, :, 0] -= state.turn_on[self.bag_of_position]
        result[:, :, 1 : 1 + len(base.columns)] = -(on_bias + without_bias[..., None] * on_scale)
        result[:, :, base.t] = -(state.kappa * terms_by_t)[..., None]
        result[:, :, base.tilts] = -np.einsum('pkt,pit->pik', state.tilt, by_rotation)
        result[:, [0, 1, 2], base.measured] = 1.0
        return result

    def residual(self, state: State, layout: Layout) -> Floats:
        """Measured minus predicted mean samples of all windows, shape (n, 3) [m/s^2]."""
        base, position = self.products(layout.used).base, self.windows.position
        series = self.of(base)
        series[:, 1 + base.lagged] += self.starts(state, base)[position] * series[:, base.at_start]
        return np.asarray(np.einsum('nb,nib->ni', series, self.misfit(state, base)[position]))

    def force(self, state: State, rows: slice = slice(None)) -> Floats:
        """Return the specific force of windows as the compensator corrects it, (n, 3) [m/s^2]."""
        active = np.flatnonzero(state.weights.any(axis=(0, 1)))
        columns, (on_bias, on_scale) = self.columns[rows, active], state.weights[:, :, active]
        along = self.measured[rows] - state.bias - columns @ on_bias.T
        along /= state.kappa * (1.0 + columns @ on_scale.T)
        if self.forces is not None:
            along = self.forces.linearise(along, state.nonlinear, rows)
        return np.asarray(along @ np.linalg.inv(state.inverse).T)

    def norm_errors(self, state: State) -> Floats:
        """Return the error of |f| of each position's mean [m/s^2], shape (n_positions,)."""
        means = means_by(self.windows.position, self.force(state))
        return np.asarray(np.linalg.norm(means, axis=1) - self.norms(state))

    def weight_sd(self, prior: Prior) -> Floats:
        """Return prior sds of the m columns' weights in bias and scale of each axis, (2, 3, m)."""
        return np.asarray(prior.column_sd[:, None] * self.windows.share)

    def precision(self, prior: Prior, layout: Layout) -> Floats:
        """Return inverse prior variances, (n,); 0 for unknowns with an informative prior."""
        result = np.zeros(layout.n)
        result[layout.kappa] = prior.scale_sd**-2
        result[layout.bias] = prior.bias_sd**-2.0
        active = prior.column_sd > 0.0
        columns = self.weight_sd(prior).transpose(1, 0, 2)[:, active]
        result[layout.axis[:, 2 : 2 + columns.shape[1]]] = columns**-2.0
        if self.forces is not None:
            nonlinear = prior.nonlinear_sd[prior.nonlinear_sd > 0.0]
            result[layout.axis[:, 2 + columns.shape[1] :]] = nonlinear**-2.0
            result[layout.stretch] = self.forces.stretch_sd[:, None] ** -2.0
            if layout.radius.size:
                result[layout.radius] = self.forces.radius_sd**-2.0
        result[layout.misalignment] = prior.misalignment_sd**-2
        if prior.informative is not None:
            result[: layout.n_unit] = 0.0
        result[layout.offset] = prior.offset_sd**-2
        result[layout.tilt] = prior.tilt_sd**-2
        result[layout.start] = 1.0 / prior.start_variance_ratio
        result[layout.turn_on] = prior.turn_on_sd**-2
        # The prior of attitudes is flat: its precision is 0. Angular rates do not depend on the
        # attitudes, so a fit of rates needs a precision of 1 to avoid singular equations.
        result[layout.up] = 0.0 if self.gravity else 1.0
        result[layout.posed] = prior.pose_sd**-2
        # The prior of a pose is almost flat: its sd is 1 rad.
        result[layout.pose] = 1.0
        return result

    def deviation(self, state: State, prior: Prior, layout: Layout) -> Floats:
        """Return unknowns less prior means, (n,); for attitudes in poses, rotations from poses."""
        result = as_vector(state, layout)
        if prior.informative is not None:
            result[: layout.n_unit] -= prior.informative.mean
        else:
            result[layout.kappa] -= prior.scale_mean
        if layout.pose.size:
            result[layout.posed] = state.from_pose
        return result


def _added(layout: Layout) -> list[str]:
    """Return the names of the unknowns to which a step is added; attitudes are rotated instead."""
    names = 'kappa bias weights misalignment offset tilt start turn_on nonlinear radius stretch'
    return [name for name in names.split() if getattr(layout, name).size]


def as_vector(state: State, layout: Layout) -> Floats:
    """Return the unknowns as a vector; its elements for rotations of attitudes are 0."""
    result = np.zeros(layout.n + 1)
    for name in _added(layout):
        result[getattr(layout, name)] = getattr(state, name)
    return result[:-1]


def without_inactive(state: State, layout: Layout) -> State:
    """Set inactive weights and coefficients to 0; return `state` itself if all are already 0."""
    kept = {name: getattr(layout, name) >= 0 for name in ('weights', 'nonlinear')}
    if not any(getattr(state, name)[~active].any() for name, active in kept.items()):
        return state
    zeroed = {name: np.where(at, getattr(state, name), 0.0) for name, at in kept.items()}
    return replace(state, **zeroed)


def with_step(state: State, step: Floats, layout: Layout) -> State:
    """Add a step of the unknowns to a state; set inactive weights and coefficients to 0."""
    padded = np.append(step, 0.0)
    turn, pose = padded[layout.up], state.pose
    if layout.pose.size:
        is_posed = layout.pose_of >= 0
        turn[is_posed] += step[layout.pose[layout.pose_of[is_posed]]]
        rotation = np.einsum('kij,kj->ki', state.pose_tangents, step[layout.pose])
        pose = _unit_vector(pose + rotation)
    up = _unit_vector(state.up + np.einsum('pij,pj->pi', state.tangents, turn))
    added = {name: getattr(state, name) + padded[getattr(layout, name)] for name in _added(layout)}
    return without_inactive(replace(state, up=up, pose=pose, **added), layout)


def _unit_vector(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))
