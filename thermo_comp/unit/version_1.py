# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the calibration file of version 1: what it said in its own way becomes response and posterior.

There each set had terms of its own in ``T_case - T_board``, in ``dT_board/dt`` and in
``T_board - L_k``, and each axis of each set a covariance of its own.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, TypeVar

import numpy as np

from ..typing import Floats
from .calibration import AXES, FORMAT_VERSION, AxisSet, Calibration, ResponseTerm, parameter_layout
from .posterior import posterior_of
from .schema import Positive, SchemaError, build, naming

Regime = Literal['static', 'dynamic']
REGIMES: tuple[Regime, Regime] = ('static', 'dynamic')
_NEW_KEYS = ('sensors', 'response', 'posterior', 'evidence', 'slow_noise_m_s2_sqrt_h', 'gyroscope')
_Part = TypeVar('_Part')


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

    def __post_init__(self) -> None:
        if len(self.memory.bias) != len(self.memory.scale):
            raise ValueError(
                '`memory` must have as many bias as scale coefficients, '
                f'got {len(self.memory.bias)} and {len(self.memory.scale)}'
            )

    @property
    def weights(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the coefficients of gradient, rate and lags on the bias and on the scale."""
        return (
            (self.gradient.bias, self.rate.bias, *self.memory.bias),
            (self.gradient.scale, self.rate.scale, *self.memory.scale),
        )


@dataclass(frozen=True)
class _OfSet:
    """What a set had."""

    gradient_range_k: tuple[float, float] = (-50.0, 50.0)
    memory_range_k: tuple[float, float] = (-50.0, 50.0)

    def __post_init__(self) -> None:
        for name in ('gradient_range_k', 'memory_range_k'):
            lower, upper = getattr(self, name)
            if not lower < upper:
                raise ValueError(f'`{name}` must be [lower, upper] with lower < upper')


@dataclass(frozen=True)
class _OfFile:
    """What the top level had."""

    memory_time_constants_s: tuple[Positive, ...] = ()


def read_version_1(data: dict[str, Any]) -> Calibration:
    """
    Build a Calibration from the plain values of a file of version 1.

    Raises SchemaError if a key is unknown or missing, or a value is not acceptable.
    """
    for key in _NEW_KEYS:
        if key in data:
            raise SchemaError(key, 'unknown key in a file of version 1')
    data = deepcopy(data)
    lags = _cut(data, _OfFile).memory_time_constants_s
    terms: list[ResponseTerm] = []
    sets: list[tuple[Regime, _OfSet, list[_OfAxis]]] = [
        (regime, _cut(data, _OfSet, regime), [_cut(data, _OfAxis, regime, one) for one in AXES])
        for regime in REGIMES
    ]
    calibration = build(Calibration, {**data, 'format_version': FORMAT_VERSION})
    for regime, edges, axes in sets:
        for name, axis in zip(AXES, axes, strict=True):
            if len(axis.memory.bias) not in (0, len(lags)):
                raise SchemaError(
                    f'{regime}.{name}.memory',
                    f'must have one coefficient per memory_time_constants_s ({len(lags)}), '
                    f'got {len(axis.memory.bias)}',
                )
        terms += _terms(regime, edges, axes, lags, calibration)
    with naming(''):
        calibration = replace(calibration, response=tuple(terms))
    matrix = _matrix(calibration, sets)
    # A term without weight is a term all the same where something is known of its uncertainty.
    layout = parameter_layout(calibration)
    blocks = (*layout.bias, *layout.scale)
    unused = [
        k
        for k, term in enumerate(terms)
        if not any(term.bias + term.scale)
        and not any(matrix[one.response + k, one.response + k] for one in blocks)
    ]
    used = tuple(term for k, term in enumerate(terms) if k not in unused)
    if not any(axis.covariance for _, _, axes in sets for axis in axes):
        return replace(calibration, response=used)
    gone = [one.response + k for one in blocks for k in unused]
    posterior = posterior_of(
        np.delete(np.delete(matrix, gone, axis=0), gone, axis=1), tolerance=0.0
    )
    return replace(calibration, response=used, posterior=posterior)


def _cut(data: dict[str, Any], part: type[_Part], *path: str) -> _Part:
    """Take the keys of a dataclass out of a mapping and build it."""
    values: Any = data
    for name in path:
        values = values.get(name) if isinstance(values, dict) else None
    taken = {}
    if isinstance(values, dict):
        names = [field.name for field in fields(part)]  # type: ignore[arg-type]
        taken = {name: values.pop(name) for name in names if name in values}
    return build(part, taken, '.'.join(path))


def _terms(
    regime: Regime,
    edges: _OfSet,
    axes: list[_OfAxis],
    lags: tuple[float, ...],
    calibration: Calibration,
) -> list[ResponseTerm]:
    """List a set's terms: gradient, rate, then one per lag, those without weight as well."""
    lower, upper = getattr(calibration, regime).rate_range_k_min
    regressors: list[tuple[Literal['now', 'rate', 'board'], float, tuple[float, float]]] = [
        ('now', 0.0, edges.gradient_range_k),
        ('rate', 0.0, (lower / 60.0, upper / 60.0)),
        *(('board', tau, edges.memory_range_k) for tau in lags),
    ]
    result = []
    for k, (kind, tau, limits) in enumerate(regressors):
        bias, scale = (
            [weights[k] if k < len(weights) else 0.0 for weights in part]
            for part in zip(*(axis.weights for axis in axes), strict=True)
        )
        result.append(
            ResponseTerm(
                kind,
                kind,
                tau_s=tau,
                during=regime,
                range=limits,
                bias=(bias[0], bias[1], bias[2]),
                scale=(scale[0], scale[1], scale[2]),
            )
        )
    return result


def _matrix(calibration: Calibration, sets: list[tuple[Regime, _OfSet, list[_OfAxis]]]) -> Floats:
    """Put the covariances of the sets and of the misalignment where they belong."""
    layout = parameter_layout(calibration)
    matrix = np.zeros((layout.n_parameters, layout.n_parameters))
    n_terms = len(calibration.response) // 2
    for number, (regime, _, axes) in enumerate(sets):
        for a, (name, axis) in enumerate(zip(AXES, axes, strict=True)):
            if not axis.covariance:
                continue
            axis_set: AxisSet = getattr(getattr(calibration, regime), name)
            places: list[int] = []
            for block, function in (
                (layout.bias[a], axis_set.bias_function),
                (layout.scale[a], axis_set.scale_function),
            ):
                level = getattr(block, regime)
                first_term = block.response + number * n_terms
                places += range(level, level + 1 + function.n_free)
                places += range(first_term, first_term + len(axis.weights[0]))
            with naming(f'{regime}.{name}'):
                matrix[np.ix_(places, places)] = _full(axis.covariance, len(places))
    first = layout.misalignment
    diagonal = range(first, first + 3)
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
        matrix[i, : i + 1] = row
        matrix[: i + 1, i] = row
    posterior_of(matrix)
    return matrix
