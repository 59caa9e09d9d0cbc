# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from a solution to the Calibration that the compensator applies.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np

from .. import __version__
from ..thermal.settings import DetectorSettings
from ..typing import Floats
from ..unit.calibration import (
    Axes,
    AxisReference,
    Calibration,
    Provenance,
    RegimeSet,
    ResidualSummary,
    Source,
    Unit,
)
from .evidence import ResidualRow, inflation
from .model import RegimeName
from .reduction import ReducedBag
from .regression import Outcome
from .solution import regressors
from .table import WindowTable
from .verdict import Finding

# Edges are widened by this part of the span, so that the run that was fitted is inside them.
_EDGE_MARGIN = 0.02
# A regime that the bags do not show has no range of its own: it takes all of them.
_FEWEST_WINDOWS = 5
# The response of a unit to heat flowing through it is linear: a ramp twice as fast as the
# chamber's has twice the terms. A curve over temperature has no such law: it ends where the data
# end.
_LINEAR_REACH = 2.0
# Orthogonality of a triad whose misalignment was not measured [rad].
UNKNOWN_SKEW = 5e-3


@dataclass(frozen=True)
class UnitFacts:
    """
    What the calibration says of the unit besides the fit.

    Parameters
    ----------
    unit : Unit
        Serial, input, full scale, cycle.
    noise_density : ndarray, shape (3,)
        White noise [m/s^2/sqrt(Hz)].
    board_lag : float
        Time constant of the board behind the case [s].
    slow_error : ndarray, shape (2, 3)
        What each regime's set leaves unexplained on each axis [m/s^2].

    """

    unit: Unit
    noise_density: Floats
    board_lag: float
    slow_error: Floats


def parameter_covariance(outcome: Outcome) -> Floats:
    """
    Covariance of all free parameters, as far as the data tell them apart.

    Parameters
    ----------
    outcome : Outcome
        A regression that has ended.

    Returns
    -------
    ndarray, shape (m, m)
        Inverse of the normal matrix; a combination that nothing determines gets no variance
        of its own, because nothing moves it either.

    """
    normal = outcome.information
    diagonal = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(diagonal, diagonal)
    values, vectors = np.linalg.eigh(scaled)
    keep = values > 1e-13 * values[-1]
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
    return np.asarray(inverse / np.outer(diagonal, diagonal))


def build_calibration(
    outcome: Outcome,
    table: WindowTable,
    bags: Sequence[ReducedBag],
    detector: DetectorSettings,
    facts: UnitFacts,
    reference_temperature: float,
    residuals: Sequence[ResidualRow] = (),
    findings: Sequence[Finding] = (),
) -> Calibration:
    """
    Write a solution as a calibration.

    Parameters
    ----------
    outcome : Outcome
        The regression.
    table : WindowTable
        What it was fitted on.
    bags : sequence of ReducedBag
        For the provenance.
    detector : DetectorSettings
        Settings under which the regimes were told apart.
    facts : UnitFacts
        The unit.
    reference_temperature : float
        T_ref.
    residuals : sequence of ResidualRow, optional
        For the provenance.
    findings : sequence of Finding, optional
        For the provenance; what is good is left out.

    Returns
    -------
    Calibration
        The calibration.

    """
    solution = outcome.solution
    covariance = parameter_covariance(outcome)
    n_bias = solution.bias.shape[1]
    sets = {}
    inflated = inflation(table, outcome)
    names: tuple[RegimeName, RegimeName] = ('static', 'dynamic')
    for regime, name in enumerate(names):
        axes = []
        for axis in range(3):
            where = outcome.layout.axis[axis]
            block = inflated[axis] * covariance[np.ix_(where, where)]
            # Scale parameters become relative to K.
            unit = np.ones(len(where))
            unit[n_bias:] = 1.0 / solution.scale[axis, 0]
            axes.append(
                solution.spec.axis_set(
                    name,
                    solution.bias[axis],
                    solution.scale[axis],
                    block * np.outer(unit, unit),
                    float(facts.slow_error[regime, axis]),
                )
            )
        ranges = _ranges(table, outcome, regime, reference_temperature)
        sets[name] = RegimeSet(x=axes[0], y=axes[1], z=axes[2], **ranges)
    matrix = solution.misalignment
    return Calibration(
        format_version=1,
        unit=facts.unit,
        reference_temperature_c=reference_temperature,
        gravity_m_s2=solution.gravity,
        axes=Axes(
            *(
                AxisReference(float(solution.scale[axis, 0]), float(solution.bias[axis, 0]))
                for axis in range(3)
            )
        ),
        static=sets['static'],
        dynamic=sets['dynamic'],
        noise_density_m_s2_sqrt_hz=_triple(facts.noise_density),
        misalignment=(_triple(matrix[0]), _triple(matrix[1]), _triple(matrix[2])),
        misalignment_sd=_misalignment_sd(outcome, float(inflated.mean()) * covariance),
        memory_time_constants_s=tuple(solution.time_constants_s.tolist()),
        board_lag_s=facts.board_lag,
        detector=detector,
        provenance=Provenance(
            created=datetime.now(timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ'),
            tool_version=__version__,
            model=solution.spec.name,
            sources=tuple(
                Source(bag.source.name, bag.source.sha256 or '', bag.n_samples) for bag in bags
            ),
            residuals=tuple(
                ResidualSummary(
                    row.section, row.fitted.n, row.raw.rms, row.fitted.rms, row.fitted.peak
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
    )


def _triple(values: Floats) -> tuple[float, float, float]:
    a, b, c = (float(v) + 0.0 for v in values)  # no -0.0
    return a, b, c


def _misalignment_sd(outcome: Outcome, covariance: Floats) -> tuple[float, float, float]:
    where = outcome.layout.skew
    if where[0] < 0:
        return (UNKNOWN_SKEW,) * 3
    a, _, c = outcome.solution.skew
    # M[1][0] = -a, M[2][0] = a c - b, M[2][1] = -c of the skew (a, b, c) of its inverse.
    jacobian = np.array([[-1.0, 0.0, 0.0], [c, -1.0, a], [0.0, 0.0, -1.0]])
    block = jacobian @ covariance[np.ix_(where, where)] @ jacobian.T
    return _triple(np.sqrt(np.maximum(np.diag(block), 0.0)))


def _ranges(
    table: WindowTable, outcome: Outcome, regime: int, reference_temperature: float
) -> dict[str, tuple[float, float]]:
    """
    Ranges of the regressors over a regime's windows.

    A set that shares its curve with the other regime was fitted on all the windows.

    """
    solution = outcome.solution
    rows = table.is_dynamic if regime else ~table.is_dynamic
    if solution.spec.dynamic is None or rows.sum() < _FEWEST_WINDOWS:
        rows = np.ones(len(table.t), dtype=bool)
    lags = regressors(table, solution.spec, solution.time_constants_s, solution.start_memory)
    memory = lags.bias[rows][:, list(solution.spec.memory_columns('bias'))]
    spec = solution.spec
    reach = _LINEAR_REACH if spec.gradient or spec.rate or spec.n_lags else 1.0
    return {
        'temperature_range_c': _range(table.t[rows] + reference_temperature, 0.01),
        'rate_range_k_min': _widened(table.rate[rows] * 60.0, reach),
        'gradient_range_k': _widened(table.gradient[rows], reach),
        'memory_range_k': _widened(memory.ravel(), reach) if memory.size else (-50.0, 50.0),
    }


def _widened(values: Floats, reach: float) -> tuple[float, float]:
    lower, upper = _range(values, 0.01)
    return min(lower, reach * lower), max(upper, reach * upper)


def _range(values: Floats, smallest_margin: float) -> tuple[float, float]:
    lower, upper = float(np.min(values)), float(np.max(values))
    margin = max(_EDGE_MARGIN * (upper - lower), smallest_margin)
    return lower - margin, upper + margin
