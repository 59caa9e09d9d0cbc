# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from a posterior to the Calibration that the compensator applies, and its covariance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime, timezone

import numpy as np

from .. import __version__
from ..thermal.settings import DetectorSettings
from ..typing import Floats
from ..unit.calibration import (
    FORMAT_VERSION,
    Axes,
    AxisReference,
    AxisSet,
    Calibration,
    Provenance,
    RegimeSet,
    ResidualSummary,
    ResponseTerm,
    Source,
    Unit,
)
from ..unit.columns import Column
from ..unit.functions import CubicSpline, Polynomial, TemperatureFunction
from ..unit.posterior import posterior_of
from .evidence import ResidualRow
from .learning import Learnt
from .posterior import Regression
from .reduction import ReducedBag
from .unknowns import Layout, State
from .verdict import Finding
from .windows import Sets, ThermalWindows

# Edges are widened by this part of the span, so that the run that was fitted is inside them.
_EDGE_MARGIN = 0.02
# The response of a unit to heat flowing through it is linear: a ramp twice as fast as the
# chamber's has twice the terms. A curve over temperature has no such law: it ends where the data
# end.
_LINEAR_REACH = 2.0
# A test at one temperature holds about it [K], within such rates [K/min].
_MARGIN_C, _RATE_MARGIN = 0.5, 0.01
# Without any thermometer the curve is flat, and what it leaves open grows from the reference on.
_UNSEEN_MARGIN_C, _UNSEEN_RATE = 50.0, 3.0


@dataclass(frozen=True)
class UnitFacts:
    """
    What the calibration says of the unit besides the fit.

    unit: serial, input, full scale, cycle
    detector: settings under which the regimes were told apart
    board_lag: time constant of the board behind the case [s]
    reference_temperature: T_ref [degC]
    model: name of the model, for the provenance
    sensors: thermometers beside the board; the first leads, the others stay where they are of use
    """

    unit: Unit
    detector: DetectorSettings
    board_lag: float
    reference_temperature: float
    model: str
    sensors: tuple[str, ...] = ('case',)


def build_calibration(
    windows: ThermalWindows,
    regression: Regression,
    learnt: Learnt,
    columns: Sequence[Column],
    sets: Sets,
    nominal: Floats,
    bags: Sequence[ReducedBag],
    facts: UnitFacts,
    residuals: Sequence[ResidualRow] = (),
    findings: Sequence[Finding] = (),
) -> Calibration:
    """
    Write a posterior as a calibration.

    `nominal`: K0 [input units per m/s^2], shape (3,).
    """
    state, prior, layout = learnt.posterior.state, learnt.prior, learnt.claim.layout
    # Of bias in input units, of scale relative, per unit of the column.
    weights = state.weights / regression.rms
    weights[0] *= nominal[:, None]
    n_sets = len(sets.levels())
    used = [k for k in range(len(columns)) if (layout.weights[:, 0, n_sets + k] >= 0).any()]
    terms = tuple(
        ResponseTerm(
            **{field.name: getattr(columns[k], field.name) for field in fields(Column)}
            | {'range': _column_range(columns[k], windows.raw[:, k])},
            bias=_triple(weights[0, :, n_sets + k]),
            scale=_triple(weights[1, :, n_sets + k]),
        )
        for k in used
    )
    slow = _slow_error(windows, learnt)
    is_seen = windows.was_measured
    regimes = {
        name: RegimeSet(
            _range(windows.temperature, _MARGIN_C if is_seen else _UNSEEN_MARGIN_C),
            _widened(
                windows.rate * 60.0, _LINEAR_REACH, _RATE_MARGIN if is_seen else _UNSEEN_RATE
            ),
            *(
                _axis_set(sets, weights[:, axis], is_dynamic, float(slow[axis]))
                for axis in range(3)
            ),
        )
        for name, is_dynamic in (('static', False), ('dynamic', True))
    }
    matrix = np.linalg.inv(state.inverse)
    K = state.kappa * nominal
    to_file = file_parameters(regression, layout, state, sets, nominal, used)
    covariance = to_file @ learnt.claim.covariance @ to_file.T
    window_s = windows.typical_count * float(np.median([bag.cycle_s for bag in bags]))
    walk = prior.sigma * np.sqrt(prior.rho * 3600.0)
    return Calibration(
        format_version=FORMAT_VERSION,
        unit=facts.unit,
        reference_temperature_c=facts.reference_temperature,
        gravity_m_s2=regression.gravity,
        axes=Axes(
            *(
                AxisReference(float(K[axis]), float(state.bias[axis] * nominal[axis]))
                for axis in range(3)
            )
        ),
        static=regimes['static'],
        dynamic=regimes['dynamic'],
        noise_density_m_s2_sqrt_hz=_triple(np.maximum(prior.sigma * np.sqrt(window_s), 1e-9)),
        slow_noise_m_s2_sqrt_h=_triple(walk),
        misalignment=(_triple(matrix[0]), _triple(matrix[1]), _triple(matrix[2])),
        misalignment_sd=_triple(np.sqrt(np.diag(covariance)[-3:])),
        sensors=tuple(
            name
            for k, name in enumerate(facts.sensors)
            if not k or any(name == column.sensor for column in terms)
        ),
        response=terms,
        board_lag_s=facts.board_lag,
        detector=facts.detector,
        provenance=Provenance(
            created=datetime.now(timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ'),
            tool_version=__version__,
            model=facts.model,
            sources=tuple(
                Source(bag.source.name, bag.source.sha256 or '', bag.n_samples) for bag in bags
            ),
            residuals=tuple(
                ResidualSummary(
                    section=row.section,
                    n_windows=row.fitted.n,
                    raw_rms_m_s2=row.raw.rms,
                    rms_m_s2=row.fitted.rms,
                    max_m_s2=row.fitted.peak,
                    left_out_rms_m_s2=row.left_out.rms if row.left_out.n else None,
                )
                for row in residuals
                if row.fitted.n
            ),
            notes=tuple(
                f'{finding.name}: {finding.message}'
                for finding in findings
                if finding.level != 'good'
            ),
        ),
        evidence=learnt.worth if is_seen else (),
        posterior=posterior_of(covariance),
    )


def _axis_set(sets: Sets, weights: Floats, is_dynamic: bool, slow: float) -> AxisSet:
    """Make the curves of one axis in one regime."""
    n = sets.static.n_free
    bias, scale = weights
    family = sets.dynamic if is_dynamic else sets.static
    delta = 0.0
    of_bias, of_scale = bias[:n], scale[:n]
    if is_dynamic:
        delta = float(bias[n])
        m = sets.dynamic.n_free
        of_bias, of_scale = bias[n + 1 : n + 1 + m], scale[n + 1 : n + 1 + m]
        if sets.is_shared:
            # A difference is of lower order: what it lacks is the static curve's own.
            family = sets.static
            of_bias = bias[:n] + np.pad(of_bias, (0, n - m))
            of_scale = scale[:n] + np.pad(of_scale, (0, n - m))
    return AxisSet(
        bias_function=_shaped(family, 0.0, _numbers(of_bias)),
        scale_function=_shaped(family, 1.0, _numbers(of_scale)),
        delta=delta,
        residual_sd_m_s2=slow,
    )


def _shaped(
    family: TemperatureFunction, reference: float, values: tuple[float, ...]
) -> TemperatureFunction:
    """Make a function of a family with its value at the reference and its free coefficients."""
    if isinstance(family, Polynomial):
        return Polynomial((reference, *values))
    if isinstance(family, CubicSpline):
        anchored = tuple(reference if knot == 0.0 else 0.0 for knot in family.knots_k)
        return CubicSpline(family.knots_k, anchored).with_free(values)
    return replace(family, constant=reference - math.fsum(values), amplitudes=values)


def file_parameters(
    regression: Regression,
    layout: Layout,
    state: State,
    sets: Sets,
    nominal: Floats,
    used: Iterable[int],
) -> Floats:
    """
    Differentiate the file's parameters, in its order, by the regression's.

    `nominal`: K0 [input units per m/s^2], shape (3,).
    """
    used = list(used)
    n_sets = len(sets.levels())
    n, m = sets.static.n_free, sets.dynamic.n_free
    rows: list[Floats] = []

    def row(*terms: tuple[int, float]) -> None:
        made = np.zeros(layout.n_unit)
        for place, value in terms:
            if place >= 0:
                made[place] += value
        rows.append(made)

    for axis in range(3):
        for places, level, unit in (
            (layout.weights[0, axis], (int(layout.bias[axis]), nominal[axis]), nominal[axis]),
            (layout.weights[1, axis], (int(layout.kappa[axis]), 1.0 / state.kappa[axis]), 1.0),
        ):
            each = [(int(p), unit / r) for p, r in zip(places, regression.rms, strict=True)]
            row(level)
            for k in range(n):
                row(each[k])
            row(level, each[n])
            if sets.is_shared:
                for k in range(n):
                    row(each[k], *([each[n + 1 + k]] if k < m else []))
            else:
                for k in range(m):
                    row(each[n + 1 + k])
            for k in used:
                row(each[n_sets + k])
    a, _, c = state.skew
    # M[1][0] = -a, M[2][0] = a c - b, M[2][1] = -c of the skew (a, b, c) of its inverse.
    s = [int(place) for place in layout.skew]
    row((s[0], -1.0))
    row((s[0], c), (s[1], -1.0), (s[2], a))
    row((s[2], -1.0))
    return np.array(rows)


def _slow_error(windows: ThermalWindows, learnt: Learnt) -> Floats:
    """
    Say what the bias does of itself: another one in each mounting, and a walk [m/s^2].

    The walk's mean square over a run as long as the bags is half of what it has at the end.
    """
    prior = learnt.prior
    data = windows.data
    length = [float(np.ptp(data.time[data.bag == bag])) for bag in np.unique(data.bag)]
    walked = prior.sigma**2 * prior.rho * float(np.median(length)) / 2.0
    return np.sqrt(prior.offset_sd**2 + walked)


def _numbers(values: Floats) -> tuple[float, ...]:
    return tuple(float(v) + 0.0 for v in values)  # no -0.0


def _triple(values: Floats) -> tuple[float, float, float]:
    a, b, c = _numbers(values)
    return a, b, c


def _column_range(column: Column, values: Floats) -> tuple[float, float]:
    if column.kind == 'even':
        return column.range
    reach = _LINEAR_REACH**2 if column.kind == 'square' else _LINEAR_REACH
    return _widened(values, reach, 0.01)


def _widened(values: Floats, reach: float, margin: float) -> tuple[float, float]:
    lower, upper = _range(values, margin)
    return min(lower, reach * lower), max(upper, reach * upper)


def _range(values: Floats, smallest_margin: float) -> tuple[float, float]:
    lower, upper = float(np.min(values)), float(np.max(values))
    margin = max(_EDGE_MARGIN * (upper - lower), smallest_margin)
    return lower - margin, upper + margin
