# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the candidate models: which functions and terms the two coefficient sets consist of.

Every model is linear, per axis, in its bias and its scale parameters, given the lags' time
constants. A model is a table of regressor columns, and per regime a selection of them in the
order of `calibration.AxisSet.covariance`.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..typing import Floats
from ..unit.calibration import AxisSet, LinearTerm, MemoryTerm
from ..unit.functions import CubicSpline, Exponential, Polynomial, TemperatureFunction
from .table import WindowTable

Part = Literal['bias', 'scale']
RegimeName = Literal['static', 'dynamic']


@dataclass(frozen=True)
class ModelSpec:
    """
    One candidate model.

    Parameters
    ----------
    name : str
        How tables and the provenance call it.
    static : TemperatureFunction
        Shape of the bias function of the static set; the scale function has the same shape. Its
        coefficients do not matter.
    dynamic : TemperatureFunction or None, optional
        Shape of the dynamic set's own functions, fitted beside the static ones; None = the
        dynamic set shares the static curve.
    gradient, rate : bool, optional
        Terms in ``T_case - T_board`` and in ``dT_board/dt``.
    n_lags : int, optional
        Number of memory terms.
    live : {'both', 'dynamic'}, optional
        Whether the thermal terms act in both regimes or in the dynamic one only.

    """

    name: str
    static: TemperatureFunction
    dynamic: TemperatureFunction | None = None
    gradient: bool = False
    rate: bool = False
    n_lags: int = 0
    live: Literal['both', 'dynamic'] = 'both'

    def n_columns(self, part: Part) -> int:
        """
        Count the parameters of one axis's bias or scale.

        """
        own = 0 if self.dynamic is None else self.dynamic.n_free + (part == 'bias')
        return 1 + self.static.n_free + own + self.gradient + self.rate + self.n_lags

    def memory_columns(self, part: Part) -> range:
        """
        Which columns are the memory's.

        """
        n = self.n_columns(part)
        return range(n - self.n_lags, n)

    @property
    def n_parameters(self) -> int:
        """
        Number of parameters of the three axes and the time constants; the measure of size.

        """
        return 3 * (self.n_columns('bias') + self.n_columns('scale')) + self.n_lags

    def columns(self, table: WindowTable, memory: Floats, part: Part) -> Floats:
        """
        Evaluate the regressor columns.

        Parameters
        ----------
        table : WindowTable
            n windows.
        memory : ndarray, shape (n, n_lags)
            Memory regressors.
        part : {'bias', 'scale'}
            Which function.

        Returns
        -------
        ndarray, shape (n, n_columns)
            Columns: level, static curve, (delta, dynamic curve,) gradient, rate, memory.

        """
        weight = table.weight
        result = [np.ones(len(table.t))]
        basis = self.static.basis(table.t)
        if self.dynamic is None:
            result += basis
        else:
            result += [(1.0 - weight) * column for column in basis]
            result += [weight] if part == 'bias' else []
            result += [weight * column for column in self.dynamic.basis(table.t)]
        live = self.live_weight(table)
        result += [live * table.gradient] if self.gradient else []
        result += [live * table.rate] if self.rate else []
        result += [live * memory[:, k] for k in range(self.n_lags)]
        return np.column_stack(result)

    def live_weight(self, table: WindowTable) -> Floats:
        """
        Weight of the thermal terms, shape (n,).

        """
        return np.ones(len(table.t)) if self.live == 'both' else table.weight

    def selection(self, regime: RegimeName, part: Part) -> Floats:
        """
        Map the column parameters onto one regime's set.

        Parameters
        ----------
        regime : {'static', 'dynamic'}
            The set.
        part : {'bias', 'scale'}
            Which function.

        Returns
        -------
        ndarray, shape (m, n_columns)
            Rows: level, free coefficients, gradient, rate, memory; a term that the model lacks,
            or that is dead in this regime, is a row of zeros.

        """
        n_static = self.static.n_free
        n = self.n_columns(part)
        is_dynamic = regime == 'dynamic'
        level = np.eye(1, n)
        if self.dynamic is None or not is_dynamic:
            curve = np.eye(n_static, n, 1)
        else:
            n_dynamic = self.dynamic.n_free
            own = 1 + n_static
            if part == 'bias':
                level[0, own] = 1.0
                own += 1
            curve = np.eye(n_dynamic, n, own)
        is_live = self.live == 'both' or is_dynamic
        at = n - self.n_lags - self.rate - self.gradient
        terms = np.zeros((2 + self.n_lags, n))
        if is_live and self.gradient:
            terms[0, at] = 1.0
        if is_live and self.rate:
            terms[1, at + self.gradient] = 1.0
        for k in range(self.n_lags):
            terms[2 + k, n - self.n_lags + k] = float(is_live)
        return np.vstack((level, curve, terms))

    def axis_set(
        self,
        regime: RegimeName,
        bias: Floats,
        scale: Floats,
        covariance: Floats | None,
        residual_sd: float,
    ) -> AxisSet:
        """
        Write one axis's parameters as a coefficient set.

        Parameters
        ----------
        regime : {'static', 'dynamic'}
            The set.
        bias : ndarray, shape (n_columns('bias'),)
            Bias parameters, in input units.
        scale : ndarray, shape (n_columns('scale'),)
            Scale parameters; the first is K.
        covariance : ndarray or None
            Covariance of ``[bias, scale / K]``.
        residual_sd : float
            What the set leaves unexplained.

        Returns
        -------
        AxisSet
            The set.

        """
        select_bias = self.selection(regime, 'bias')
        select_scale = self.selection(regime, 'scale')
        b = select_bias @ bias
        s = select_scale @ scale / scale[0]
        shape = self.static if regime == 'static' or self.dynamic is None else self.dynamic
        n = shape.n_free
        rows: tuple[tuple[float, ...], ...] = ()
        if covariance is not None:
            select = np.zeros((len(b) + len(s), covariance.shape[0]))
            select[: len(b), : len(bias)] = select_bias
            select[len(b) :, len(bias) :] = select_scale
            full = select @ covariance @ select.T
            rows = tuple(tuple(full[i, : i + 1].tolist()) for i in range(len(full)))
        return AxisSet(
            bias_function=normalised(shape, b[1 : 1 + n], 0.0),
            scale_function=normalised(shape, s[1 : 1 + n], 1.0),
            delta=float(b[0] - bias[0]),
            gradient=LinearTerm(float(b[1 + n]), float(s[1 + n])),
            rate=LinearTerm(float(b[2 + n]), float(s[2 + n])),
            memory=MemoryTerm(tuple(b[3 + n :].tolist()), tuple(s[3 + n :].tolist())),
            residual_sd_m_s2=residual_sd,
            covariance=rows,
        )


def normalised(
    shape: TemperatureFunction, free: Floats, at_reference: float
) -> TemperatureFunction:
    """
    Put free coefficients and the value at the reference into a function's shape.

    Parameters
    ----------
    shape : TemperatureFunction
        The family, order and knots.
    free : ndarray, shape (n_free,)
        Free coefficients.
    at_reference : float
        0 for a bias function, 1 for a scale function.

    Returns
    -------
    TemperatureFunction
        The function. A spline's or an exponential's free coefficients act around the value at
        the reference.

    """
    values = tuple(float(v) for v in free)
    if isinstance(shape, Polynomial):
        return Polynomial((at_reference, *values))
    if isinstance(shape, CubicSpline):
        # The cardinal splines do not see a constant: it is added to every knot.
        at = shape.knots_k.index(0.0)
        knots = tuple(at_reference + v for v in values)
        return CubicSpline(shape.knots_k, (*knots[:at], at_reference, *knots[at:]))
    return Exponential(at_reference - sum(values), values, shape.e_fold_k)


def polynomial(order: int) -> Polynomial:
    """
    Make the shape of a polynomial of an order; 0 is the constant.

    """
    return Polynomial((0.0,) * (order + 1))
