# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the conversion of a fit's posterior into the calibration that the node applies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import datetime, timezone

import numpy as np

from .. import __version__
from ..typing import Bools, Floats
from ..unit.calibration import (
    FORMAT_VERSION,
    Axes,
    AxisReference,
    AxisSet,
    Calibration,
    LackOfFit,
    RegimeSet,
    ResponseTerm,
    Unit,
    parameter_layout,
)
from ..unit.columns import Column
from ..unit.nonlinearity import Kind, Nonlinearity
from ..unit.posterior import posterior_of
from ..unit.provenance import Provenance, ResidualSummary
from . import thermal_ranges as ranges
from .claim import Claim
from .equations import as_vector
from .evidence import ResidualRow, group_evidence, lack_of_fit
from .initial_triad import white_noise_of
from .layout import Layout
from .reduction import ReducedBag
from .regression import Regression
from .selection import Fit
from .unknowns import State
from .windows import PART, Model, ThermalWindows


def build_calibration(
    fit: Fit,
    claim: Claim,
    bags: Sequence[ReducedBag],
    unit: Unit,
    residuals: Sequence[ResidualRow] = (),
    earlier: Calibration | None = None,
    nonlinearity: Nonlinearity | None = None,
) -> Calibration:
    """Return a fit's calibration; its valid ranges include the ranges of `earlier`, the prior."""
    (windows, regression, *_), posterior = fit, fit.posterior
    model, prior, state, layout = windows.model, posterior.prior, posterior.state, claim.layout
    # Columns of the response whose weights are in the covariance, also if the weight is 0.
    used = _of_columns(windows, np.any(layout.weights[:, 0] >= 0, axis=0))
    kinds = tuple(term.kind for term in nonlinearity.terms) if nonlinearity else ()
    to_file = file_jacobian(regression, layout, state, model, used, kinds)
    values = to_file @ as_vector(state, layout)[: layout.n_unit]
    values[-3:] = np.linalg.inv(state.inverse)[[1, 2, 2], [0, 0, 1]]
    static, dynamic = _regime_sets(fit, claim, earlier)
    columns = _valid_columns(windows, state, used, earlier)
    lag_s = earlier.board_lag_s if earlier else ranges.usable_board_lag(windows)
    sensors = {*model.sensors[:1], *(column.sensor for column in columns)}
    window_s = windows.typical_count * float(np.median([bag.cycle_s for bag in bags]))
    # Slow noise fitted to a drift that no column describes may absorb most of the white noise. The
    # white noise is then estimated from differences of windows, in which a drift cancels.
    sigma, white = prior.sigma, white_noise_of(regression.windows, regression.nominal_scale)
    sigma = np.where(sigma < 0.7 * white, white, sigma)
    blank = Calibration(
        format_version=FORMAT_VERSION,
        unit=unit,
        reference_temperature_c=model.reference_temperature,
        gravity_m_s2=regression.gravity,
        axes=Axes(*(AxisReference(float(K), 0.0) for K in regression.nominal_scale)),
        static=static,
        dynamic=dynamic,
        noise_density_m_s2_sqrt_hz=_triple(np.maximum(sigma * np.sqrt(window_s), 1e-9)),
        slow_noise_m_s2_sqrt_h=_triple(prior.sigma * prior.noise.rate * np.sqrt(3600.0)),
        sensors=tuple(name for name in model.sensors if name in sensors),
        response=blank_terms(columns),
        board_lag_s=lag_s,
        rest_gradient_range_k=ranges.rest_gradient_range(windows, lag_s, earlier),
        soak_gradient_k=ranges.soak_gradient(windows, earlier),
        detector=model.detector,
        provenance=_provenance(fit, bags, residuals),
        evidence=group_evidence(regression, posterior) if windows.was_measured else (),
        nonlinearity=nonlinearity,
    )
    if earlier is not None and not (earlier.needs_temperature or windows.has_temperature):
        # Without a thermometer, the fitted effect of temperature is a rounding error: set it to 0.
        places = parameter_layout(blank)
        for block in (*places.bias, *places.scale):
            level = values[block.static]
            values[block.rows] = 0.0
            values[[block.static, block.dynamic]] = level
    covariance = to_file @ claim.covariance @ to_file.T
    return with_parameters(blank, state.kappa * regression.nominal_scale, values, covariance)


def _regime_sets(fit: Fit, claim: Claim, earlier: Calibration | None) -> list[RegimeSet]:
    """Return the static and the dynamic set with valid ranges, and all free coefficients 0."""
    windows, prior = fit.windows, fit.posterior.prior
    temperatures = ranges.temperature_range(windows)
    rates = ranges.valid_range(windows.rate * 60.0, 0.01 if windows.was_measured else 3.0, order=1)
    # Sd of the sum of mounting offset and slow noise, for each axis [m/s^2].
    slow = np.sqrt(claim.offset_sd**2 + prior.sigma**2 * prior.noise.variance).tolist()
    lacks: Sequence[tuple[LackOfFit, ...]] = ((), ())
    if fit.regression.gravity:
        lacks = ranges.with_unseen_axes(fit, lack_of_fit(fit, claim), earlier)
    result = []
    for k, (family, lack) in enumerate(zip(windows.model.sets.families, lacks, strict=True)):
        zero = (0.0,) * family.n_free
        bias, scale = (family.with_free(zero, reference) for reference in (0.0, 1.0))
        x, y, z = (AxisSet(bias, scale, residual_sd_m_s2=sd) for sd in slow)
        prior_sets = [earlier.regime_sets()[k]] if earlier else []
        valid = (
            ranges.union((temperatures, *(regime.temperature_range_c for regime in prior_sets))),
            ranges.union((rates, *(regime.rate_range_k_min for regime in prior_sets))),
        )
        result.append(RegimeSet(*valid, x, y, z, lack_of_fit=lack))
    return result


def _valid_columns(
    windows: ThermalWindows, state: State, used: Sequence[int], earlier: Calibration | None
) -> list[Column]:
    """Return the response columns in use with their valid ranges."""
    lower, upper = ranges.temperature_range(windows)
    is_weighed = np.any(state.weights != 0.0, axis=(0, 1))
    n_alone = windows.model.part_sums.shape[1]
    alone = is_weighed[len(windows.model.sets.groups) :]
    weighed = _of_columns(windows, is_weighed)
    of_parts = _of_columns(windows, is_weighed & (np.arange(len(is_weighed)) >= n_alone))
    result = []
    for k in used:
        column = windows.model.columns[k]
        valid = column.range
        if column.term.bounds is None:
            values, order = windows.raw[:, k], column.term.order
            if column.term.is_temperature:
                # The ranges of all bends of a part end at the same temperatures of the part: with
                # different ends, the sum of the bends would change its slope at each end.
                coldest = windows.temperature.min() - windows.model.reference_temperature
                values, order = np.append(values, coldest - column.knee_k), 0
            valid = ranges.valid_range(values, 0.01, order)
            if k not in weighed:
                # A column with zero weight contributes only to the covariance. The range of such a
                # column therefore includes every value that the column can have within the
                # temperature range.
                largest = (upper - lower) ** column.term.order
                valid = ranges.union((valid, (-largest, largest)))
        if k in of_parts and column.term.order % 2:
            # The lag of a part has opposite signs in heating and in cooling: the range of an odd
            # power of the lag is extended to the same values of opposite sign.
            valid = ranges.union((valid, (-valid[1], -valid[0])))
        # A column that has a weight only in curves over temperatures of parts gets group `part`.
        group = PART if k in weighed and not alone[k] else column.group
        valid = valid if earlier is None else ranges.union((valid, column.range))
        result.append(replace(column, group=group, range=valid))
    return result


def _of_columns(windows: ThermalWindows, mask: Bools) -> list[int]:
    """Return the response columns in a mask, also as summands of curves over parts."""
    sums, n_curves = windows.model.part_sums, len(windows.model.sets.groups)
    contained = mask[: sums.shape[1]] | (sums != 0.0)[mask[sums.shape[1] :]].any(axis=0)
    return [int(k) for k in np.flatnonzero(contained[n_curves:])]


def _provenance(
    fit: Fit, bags: Sequence[ReducedBag], residuals: Sequence[ResidualRow]
) -> Provenance:
    # State the left-out RMS of ``|f| - g`` only if left-out |f| is scored in all positions.
    is_norm = bool(np.isfinite(fit.selected.score.norms.square).all())
    now = datetime.now(timezone.utc)
    end_s = 1e-9 * max(bag.end_ns for bag in bags)
    # Stamps may count from the start of a computer, or come from a wrong clock: only stamps from
    # the year 2000 (946684800 s after the start of 1970) to now are taken for dates.
    is_date = 946684800.0 <= end_s <= now.timestamp()
    tested = datetime.fromtimestamp(end_s if is_date else 0.0, timezone.utc)
    date_format = '%Y-%m-%dT%H:%M:%SZ'
    return Provenance(
        created=now.strftime(date_format),
        tested=tested.strftime(date_format) if is_date else '',
        tool_version=__version__,
        model=fit.windows.model.name,
        sources=tuple(source for bag in bags for source in bag.sources),
        residuals=tuple(
            ResidualSummary(
                section=row.section,
                n_windows=row.fitted.n,
                raw_rms_m_s2=row.raw.rms,
                rms_m_s2=row.fitted.rms,
                max_m_s2=row.fitted.peak,
                left_out_rms_m_s2=row.left_out.rms if is_norm and row.left_out.n else None,
                left_out_drift_m_s2=row.left_out_drift.rms if row.left_out_drift.n else None,
            )
            for row in residuals
            if row.fitted.n
        ),
    )


def blank_terms(columns: Iterable[Column]) -> tuple[ResponseTerm, ...]:
    """Return the response terms of the columns, with all weights 0."""
    zero = (0.0, 0.0, 0.0)
    return tuple(ResponseTerm(**vars(column), bias=zero, scale=zero) for column in columns)


def parameters_of(calibration: Calibration) -> Floats:
    """Return the parameters in the posterior's order; errors of scale factors are set to 0."""
    values: list[float] = []
    pairs = zip(calibration.static.axes(), calibration.dynamic.axes(), strict=True)
    for axis, (reference, sets) in enumerate(zip(calibration.axes, pairs, strict=True)):
        for curves in sets:
            values += [reference.bias + curves.delta, *curves.bias_function.free_coefficients]
        values += [term.bias[axis] for term in calibration.response]
        for curves in sets:
            values += [0.0, *curves.scale_function.free_coefficients]
        values += [term.scale[axis] for term in calibration.response]
    terms = calibration.nonlinearity.terms if calibration.nonlinearity else ()
    for axis in range(3):
        values += [term.coefficient[axis] for term in terms]
        values += [term.per_kelvin[axis] for term in terms]
    M = calibration.misalignment
    return np.array([*values, M[1][0], M[2][0], M[2][1]])


def with_parameters(
    calibration: Calibration, scale_factor: Floats, values: Floats, covariance: Floats
) -> Calibration:
    """
    Replace the scale factors and the parameters of a calibration.

    `values`: parameters in the posterior's order; the errors of scale factors in it are not used
    """
    layout = parameter_layout(calibration)
    levels = values[[bias.static for bias in layout.bias]]
    regimes = []
    for k, regime in enumerate(calibration.regime_sets()):
        axes = []
        for axis, bias, scale in zip(regime.axes(), layout.bias, layout.scale, strict=True):
            of_bias, of_scale = (_numbers(values[at[k] : at[k + 1]]) for at in (bias, scale))
            Fs = axis.bias_function.with_free(of_bias[1:], 0.0)
            Fc = axis.scale_function.with_free(of_scale[1:], 1.0)
            delta = float(values[bias[k]] - values[bias.static])
            axes.append(AxisSet(Fs, Fc, delta, axis.residual_sd_m_s2))
        x, y, z = axes
        regimes.append(replace(regime, x=x, y=y, z=z))
    a, b, c = _triple(values[-3:])
    biases, scales = (np.array([block.response for block in part]) for part in layout[:2])
    nonlinearity = calibration.nonlinearity
    if nonlinearity is not None:
        each = values[layout.nonlinear : layout.misalignment].reshape(3, 2, -1).transpose(2, 1, 0)
        terms = (
            replace(term, coefficient=_triple(at_reference), per_kelvin=_triple(per_kelvin))
            for term, (at_reference, per_kelvin) in zip(nonlinearity.terms, each, strict=True)
        )
        nonlinearity = replace(nonlinearity, terms=tuple(terms))
    return replace(
        calibration,
        nonlinearity=nonlinearity,
        axes=Axes(*map(AxisReference, scale_factor.tolist(), levels.tolist())),
        static=regimes[0],
        dynamic=regimes[1],
        misalignment=((1.0, 0.0, 0.0), (a, 1.0, 0.0), (b, c, 1.0)),
        misalignment_sd=_triple(np.sqrt(np.diag(covariance)[-3:])),
        response=tuple(
            replace(term, bias=_triple(values[biases + k]), scale=_triple(values[scales + k]))
            for k, term in enumerate(calibration.response)
        ),
        posterior=posterior_of(covariance),
    )


def file_jacobian(
    regression: Regression,
    layout: Layout,
    state: State,
    model: Model,
    used: Sequence[int],
    kinds: Sequence[Kind],
) -> Floats:
    """
    Return the derivatives of the file's parameters w.r.t. the regression's parameters.

    `used`: response columns in the file; `kinds`: nonlinear terms in the file
    """
    sets, sums = model.sets, model.part_sums
    n, m = sets.static.n_free, sets.dynamic.n_free
    # The last row of `unknown` is 0: index -1, of a parameter that is not estimated, selects it.
    unknown = np.eye(layout.n_unit + 1, layout.n_unit)
    rows: list[Floats] = []
    for axis, K in enumerate(regression.nominal_scale):
        is_absent = regression.windows.share[axis] < 1.0
        of_bias, of_scale = np.where(is_absent, -1, layout.weights[:, axis])
        for places, unit, level in (
            (of_bias, K, K * unknown[layout.bias[axis]]),
            (of_scale, 1.0, unknown[layout.kappa[axis]] / state.kappa[axis]),
        ):
            each = unknown[places] * (unit / regression.rms)[:, None]
            # The curves over the temperatures of parts are sums of columns.
            each, of_parts = np.split(each, [sums.shape[1]])
            each = each + sums.T @ of_parts
            static, (delta,), dynamic, response = np.split(each, [n, n + 1, n + 1 + m])
            if sets.is_shared:
                both = np.zeros((max(n, m), layout.n_unit))
                both[:n] += static
                both[:m] += dynamic
                dynamic = both
            rows += [level, *static, level + delta, *dynamic, *response[used]]
    if regression.forces is not None:
        all_kinds = regression.forces.kinds
        at = [all_kinds.index(kind) for kind in kinds]
        for places in layout.nonlinear:
            rows += [*unknown[places[at]], *unknown[places[[len(all_kinds) + k for k in at]]]]
    a, _, c = state.misalignment
    # a, b, c below the diagonal of M^-1 give M[1][0] = -a, M[2][0] = a c - b, M[2][1] = -c.
    of_a, of_b, of_c = unknown[layout.misalignment]
    return np.array([*rows, -of_a, c * of_a - of_b + a * of_c, -of_c])


def _numbers(values: Floats) -> tuple[float, ...]:
    return tuple(float(v) + 0.0 for v in values)  # no -0.0


def _triple(values: Floats) -> tuple[float, float, float]:
    a, b, c = _numbers(values)
    return a, b, c
