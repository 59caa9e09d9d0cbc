# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the calibration file of version 1, whose sets had terms of their own in ``T_case - T_board``,
``dT_board/dt`` and ``T_board - L_k``, and whose axes a covariance each, as response and posterior.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, TypeVar

import numpy as np

from ..quantities import QUANTITIES
from ..typing import Floats
from .calibration import AXES, FORMAT_VERSION, Calibration, ResponseTerm, parameter_layout
from .posterior import posterior_of
from .schema import SchemaError, build, check_ranges, naming

REGIMES = ('static', 'dynamic')
_NEW_KEYS = ('sensors', 'response', 'posterior', 'evidence', 'slow_noise_m_s2_sqrt_h', 'gyroscope')
_Part = TypeVar('_Part')
_TimeConstant = Annotated[float, QUANTITIES['time constant']]


@dataclass(frozen=True)
class _Linear:
    """Coefficients of one regressor."""

    bias: float = 0.0
    scale: float = 0.0


@dataclass(frozen=True)
class _Memory:
    """Coefficients of the lags, one per time constant."""

    bias: tuple[float, ...] = ()
    scale: tuple[float, ...] = ()


@dataclass(frozen=True)
class _OfAxis:
    """What an axis of a set had."""

    gradient: _Linear = _Linear()
    rate: _Linear = _Linear()
    memory: _Memory = _Memory()
    covariance: tuple[tuple[float, ...], ...] = ()

    def weights(self, n_lags: int) -> list[tuple[float, ...]]:
        """Return the coefficients of gradient, rate and lags on the bias and on the scale."""
        sizes = len(self.memory.bias), len(self.memory.scale)
        if sizes not in ((0, 0), (n_lags, n_lags)):
            raise ValueError(
                '`memory` must have as many bias as scale coefficients, one per '
                f'memory_time_constants_s ({n_lags}), got {sizes[0]} and {sizes[1]}'
            )
        nil = (0.0,) * (n_lags - sizes[0])
        return [
            (self.gradient.bias, self.rate.bias, *self.memory.bias, *nil),
            (self.gradient.scale, self.rate.scale, *self.memory.scale, *nil),
        ]


@dataclass(frozen=True)
class _OfSet:
    """What a set had."""

    gradient_range_k: tuple[float, float] = (-50.0, 50.0)
    memory_range_k: tuple[float, float] = (-50.0, 50.0)

    def __post_init__(self) -> None:
        span = QUANTITIES['span of a column']
        check_ranges(self, gradient_range_k=span, memory_range_k=span)


def read_version_1(data: dict[str, Any]) -> Calibration:
    """Build a Calibration from the plain values of a file of version 1, or raise SchemaError."""
    for key in _NEW_KEYS:
        if key in data:
            raise SchemaError(key, 'unknown key in a file of version 1')
    data = deepcopy(data)
    key = 'memory_time_constants_s'
    lags = build(tuple[_TimeConstant, ...], data.pop(key, []), key)
    edges = [_cut(data, _OfSet, regime) for regime in REGIMES]
    axes = [[_cut(data, _OfAxis, regime, one) for one in AXES] for regime in REGIMES]
    calibration = build(Calibration, {**data, 'format_version': FORMAT_VERSION})
    terms: list[ResponseTerm] = []
    for regime, ranges, own in zip(REGIMES, edges, axes, strict=True):
        weights = []
        for name, axis in zip(AXES, own, strict=True):
            with naming(f'{regime}.{name}'):
                weights.append(axis.weights(len(lags)))
        of_rate = [edge / 60.0 for edge in getattr(calibration, regime).rate_range_k_min]
        regressors = [
            ('now', 0.0, ranges.gradient_range_k),
            ('rate', 0.0, of_rate),
            *(('board', tau, ranges.memory_range_k) for tau in lags),
        ]
        for (kind, tau, limits), by_axis in zip(regressors, np.transpose(weights), strict=True):
            bias, scale = by_axis.tolist()
            keys = {'group': kind, 'kind': kind, 'tau_s': tau, 'during': regime}
            keys |= {'range': list(limits), 'bias': bias, 'scale': scale}
            terms.append(build(ResponseTerm, keys))
    is_known = any(axis.covariance for own in axes for axis in own)
    # Of a term without weight something may be known all the same.
    used = tuple(term for term in terms if is_known or any(term.bias + term.scale))
    with naming(''):
        calibration = replace(calibration, response=used)
    if is_known:
        posterior = posterior_of(_matrix(calibration, axes), tolerance=0.0)
        calibration = replace(calibration, posterior=posterior)
    return calibration


def _cut(data: dict[str, Any], part: type[_Part], *path: str) -> _Part:
    """Take the keys of a dataclass out of a mapping and build it."""
    values: Any = data
    for name in path:
        values = values.get(name) if isinstance(values, dict) else None
    names = [field.name for field in fields(part)]  # type: ignore[arg-type]
    has = isinstance(values, dict)
    taken = {name: values.pop(name) for name in names if has and name in values}
    return build(part, taken, '.'.join(path))


def _matrix(calibration: Calibration, axes: list[list[_OfAxis]]) -> Floats:
    """Put the covariances of the sets and of the misalignment where they belong."""
    layout = parameter_layout(calibration)
    matrix = np.zeros((layout.n_parameters, layout.n_parameters))
    n_terms = len(calibration.response) // 2
    for number, (regime, own) in enumerate(zip(REGIMES, axes, strict=True)):
        for a, (name, axis) in enumerate(zip(AXES, own, strict=True)):
            if not axis.covariance:
                continue
            places: list[int] = []
            for block in (layout.bias[a], layout.scale[a]):
                # Level and coefficients of a set end where what follows begins.
                places += range(block[number], block[number + 1])
                first_term = block.response + number * n_terms
                places += range(first_term, first_term + 2 + len(axis.memory.bias))
            with naming(f'{regime}.{name}'):
                matrix[np.ix_(places, places)] = _full(axis.covariance, len(places))
    diagonal = range(layout.misalignment, layout.n_parameters)
    matrix[diagonal, diagonal] = np.square(calibration.misalignment_sd)
    return matrix


def _full(rows: tuple[tuple[float, ...], ...], expected: int) -> Floats:
    if len(rows) != expected or any(len(row) != i + 1 for i, row in enumerate(rows)):
        raise ValueError(
            f'`covariance` must be the {expected} rows of a lower triangle, '
            f'got rows of {[len(row) for row in rows]}'
        )
    matrix = np.zeros((expected, expected))
    for i, row in enumerate(rows):
        matrix[i, : i + 1] = matrix[: i + 1, i] = row
    posterior_of(matrix)
    return matrix
