# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the covariance of all parameters, and the order of the parameters in this covariance."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..quantities import QUANTITIES
from ..typing import Floats
from .functions import TemperatureFunction
from .schema import broken

#: Largest share of a parameter's variance that may be in `diagonal` instead of `factor`.
_TOLERANCE = 1e-5
#: Most negative eigenvalue of a correlation matrix that is accepted as due to rounding.
_MOST_NEGATIVE = -1e-6
_FLOAT32 = np.dtype('<f4')


@dataclass(frozen=True)
class Posterior:
    """
    Covariance of all parameters, ``factor @ factor.T + diag(diagonal)``, in the order that
    docs/calibration_file.md states.
    """

    rank: Annotated[int, QUANTITIES['number'], 'Number of columns of the factor.']
    factor: Annotated[
        str, 'base64 of little-endian float32: one row of `rank` numbers per parameter.'
    ]
    diagonal: Annotated[
        str, 'base64 of little-endian float32: the vector `diagonal`, a variance per parameter.'
    ]

    def __post_init__(self) -> None:
        n, size = self.n_parameters, len(_decoded('factor', self.factor))
        if size != n * self.rank:
            rule = f'hold {n} x {self.rank} numbers (`diagonal` x `rank`)'
            raise broken('factor', rule, size)
        if (self.variances < 0.0).any():
            raise ValueError('`diagonal` must not have a negative variance')

    @classmethod
    def of(cls, matrix: npt.NDArray[np.floating[Any]], variances: Floats) -> Posterior:
        """Encode the factor, (n_parameters, rank), and the diagonal of a covariance."""
        return cls(matrix.shape[1], _encoded(matrix), _encoded(variances))

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""
        return len(self.variances)

    @cached_property
    def matrix(self) -> Floats:
        """The factor of the covariance, shape (n_parameters, rank)."""
        return _decoded('factor', self.factor).reshape(self.n_parameters, self.rank)

    @cached_property
    def variances(self) -> Floats:
        """The variances added to the covariance's diagonal, shape (n_parameters,)."""
        return _decoded('diagonal', self.diagonal)

    def covariance(self) -> Floats:
        """Return the covariance matrix, shape (n_parameters, n_parameters)."""
        result: Floats = self.matrix @ self.matrix.T + np.diag(self.variances)
        return result

    def check_size(self, expected: int) -> None:
        """Raise ValueError, with the key's name, if there are not `expected` parameters."""
        if self.n_parameters != expected:
            rule = f'have one number per parameter ({expected})'
            raise broken('posterior.diagonal', rule, self.n_parameters)


class Block(NamedTuple):
    """
    Indices, in the posterior, of the parameters of an axis' bias or scale.

    static, dynamic: index of the regime's value at T_ref; its curve's coefficients follow
    response: index of the first weight of the columns; end: index after the last weight
    """

    static: int
    dynamic: int
    response: int
    end: int

    @property
    def rows(self) -> slice:
        """Indices of all parameters of the block."""
        return slice(self.static, self.end)


def lay_out(
    pairs: Iterable[tuple[TemperatureFunction, TemperatureFunction]], n_columns: int
) -> list[Block]:
    """Return the parameter indices of each pair of a static and a dynamic curve."""
    blocks = [Block(0, 0, 0, 0)]
    for static, dynamic in pairs:
        begin = blocks[-1].end
        middle = begin + 1 + static.n_free
        response = middle + 1 + dynamic.n_free
        blocks.append(Block(begin, middle, response, response + n_columns))
    return blocks[1:]


class ParameterLayout(NamedTuple):
    """
    The order of a calibration's parameters in its posterior: bias [input units] and relative scale
    of each axis. From index `nonlinear` on, each axis has nonlinear coefficients, then their
    changes per kelvin. From index `misalignment` on, there are M[1][0], M[2][0], M[2][1].
    """

    bias: list[Block]
    scale: list[Block]
    nonlinear: int
    misalignment: int
    n_parameters: int

    @property
    def force(self) -> list[slice]:
        """Indices of the coefficients of the nonlinear terms of each axis."""
        n = (self.misalignment - self.nonlinear) // 3
        return [slice(first, first + n) for first in (self.nonlinear + n * k for k in range(3))]


def posterior_of(covariance: Floats) -> Posterior:
    """Encode a covariance with the smallest rank that `_TOLERANCE` permits."""
    diagonal = np.diag(covariance).copy()
    if not np.all(diagonal >= 0.0):
        raise ValueError('`covariance` must not have a negative variance')
    # Scale the covariance to correlations: variances of biases [counts^2] and of relative scales
    # differ by 10 orders of magnitude.
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    with np.errstate(over='ignore'):
        correlation = (covariance + covariance.T) / 2.0 / scale / scale[:, np.newaxis]
    # `eigh` needs finite numbers. A matrix with entries of 2 or more is no correlation matrix.
    is_bounded = np.abs(correlation).max(initial=0.0) < 2.0
    eigenvalues, vectors = np.linalg.eigh(correlation if is_bounded else -np.eye(1))
    if not eigenvalues[0] > _MOST_NEGATIVE:
        raise ValueError('`covariance` must be positive semidefinite')
    columns = vectors[:, ::-1] * np.sqrt(np.maximum(eigenvalues[::-1], 0.0))
    whole = np.where(diagonal > 0.0, 1.0, 0.0)
    remaining = whole[:, np.newaxis] - np.cumsum(columns**2, axis=1)
    is_enough = np.all(remaining <= _TOLERANCE, axis=0)
    rank = int(np.argmax(is_enough)) + 1 if diagonal.any() else 0
    factor = _single(columns[:, :rank] * scale[:, np.newaxis])
    of_factor = np.sum(factor.astype(np.float64) ** 2, axis=1)
    return Posterior.of(factor, np.maximum(diagonal - of_factor, 0.0))


def _encoded(numbers: npt.NDArray[np.floating[Any]]) -> str:
    return base64.b64encode(_single(numbers).tobytes()).decode('ascii')


def _single(numbers: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float32]:
    # A number that overflows single precision becomes inf, and `_decoded` refuses it.
    with np.errstate(over='ignore'):
        return numbers.astype(_FLOAT32)


def _decoded(key: str, text: str) -> Floats:
    try:
        numbers = np.frombuffer(base64.b64decode(text, validate=True), _FLOAT32)
    except ValueError as error:
        raise ValueError(f'`{key}` must be base64 of float32 numbers: {error}') from error
    if not np.isfinite(numbers).all():
        raise ValueError(f'`{key}` must hold finite numbers')
    result = numbers.astype(np.float64)
    result.flags.writeable = False
    return result
