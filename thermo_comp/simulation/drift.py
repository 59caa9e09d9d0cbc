# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the physics of the thermal errors: each effect depends on temperatures of parts, and is 0 in
the reference state, which is the steady state with the board at the reference temperature.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from ..typing import Floats

Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)


def triple(values: Floats) -> Triple:
    """Return the values of three axes as plain numbers."""
    x, y, z = values.tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class PartHistory:
    """
    Temperatures of the parts on a uniform grid of `step` seconds: deviations from the reference
    state [K], shape (m, n_parts), and the temperatures in the reference state [degC].
    """

    nodes: tuple[str, ...]
    deviation: Floats
    origin: Floats
    step: float

    def of(self, part: str) -> Floats:
        """Return a part's temperature less its temperature in the reference state [K], (m,)."""
        return self.deviation[:, self.nodes.index(part)]


@dataclass(frozen=True, kw_only=True)
class Effect(ABC):
    """
    Base class of the causes of thermal errors. Two signals, `first` and `second`, change the bias
    of each axis by ``bias * first + bias_curvature * second``, and the scale likewise.

    The coefficients are in ug (bias) or ppm (scale) per unit of the signal.
    """

    scale: Triple = ZERO
    scale_curvature: Triple = ZERO
    bias: Triple = ZERO
    bias_curvature: Triple = ZERO

    @abstractmethod
    def _signals(self, history: PartHistory) -> tuple[Floats, Floats | float]: ...

    def change(self, history: PartHistory) -> Floats:
        """Return the change of the bias [ug] and of the scale [ppm], shape (2, m, 3)."""
        first, second = (np.reshape(s, (-1, 1)) for s in self._signals(history))
        straight, bent = (self.bias, self.scale), (self.bias_curvature, self.scale_curvature)
        result: Floats = first * np.array(straight)[:, None] + second * np.array(bent)[:, None]
        return result


@dataclass(frozen=True)
class PartEffect(Effect):
    """
    Temperature coefficient of a part, or stress or thermo-EMF between two parts. The two signals
    are d and d^2; d is the temperature of `part` less its temperature in the reference state [K].
    If a part `cold` is given, the same signals of `cold` are subtracted.
    """

    part: str
    cold: str = ''

    def _signals(self, history: PartHistory) -> tuple[Floats, Floats]:
        d = history.of(self.part)
        if not self.cold:
            return d, d * d
        cold = history.of(self.cold)
        return d - cold, d * d - cold * cold


@dataclass(frozen=True)
class FlowEffect(Effect):
    """
    Effect of the size of a heat flow between two parts, less its effect in the reference state.

    With ``x = |T_hot - T_cold| / knee`` and ``flow = x ** exponent`` the first signal is ``flow``
    less its value in the reference state, times ``d ** power``; d is the temperature of `cold`
    less its temperature in the reference state [K]. The second signal is the first times d. The
    exponent is 1.25 for convection in a gap, 1 for the load of a heat pump, 2 for the losses of a
    heat pump. If `is_limited` (a heat pump has a limited supply), ``flow / (1 + flow)`` replaces
    ``flow``.
    """

    hot: str
    cold: str
    exponent: float = 1.25
    knee: float = 1.0
    is_limited: bool = False
    power: int = 0

    def _signals(self, history: PartHistory) -> tuple[Floats, Floats]:
        at = [history.nodes.index(part) for part in (self.hot, self.cold)]
        at_rest = history.origin[at[:1]] - history.origin[at[1:]]
        difference = history.deviation[:, at[0]] - history.deviation[:, at[1]] + at_rest
        flow, flow_at_rest = (
            (np.abs(d) / self.knee) ** self.exponent for d in (difference, at_rest)
        )
        if self.is_limited:
            flow, flow_at_rest = flow / (1.0 + flow), flow_at_rest / (1.0 + flow_at_rest)
        first = (flow - flow_at_rest) * history.of(self.cold) ** self.power
        return first, first * history.of(self.cold)


@dataclass(frozen=True)
class CreepEffect(Effect):
    """Creep in a part: its temperature less its temperature lagged by `time_constant` [s]."""

    part: str
    time_constant: float

    def _signals(self, history: PartHistory) -> tuple[Floats, float]:
        d = history.of(self.part)
        # A first-order lag, settled at the start; the input is linear between grid points.
        kept = np.exp(-history.step / self.time_constant)
        new = 1.0 - self.time_constant / history.step * (1.0 - kept)
        lagged = lfilter([new, 1.0 - kept - new], [1.0, -kept], d - d[0]) + d[0]
        return d - lagged, 0.0


def drift_of(effects: Iterable[Effect], history: PartHistory) -> tuple[Floats, Floats]:
    """Return the change of the bias [ug] and the relative change of the scale, shape (m, 3)."""
    changes = [effect.change(history) for effect in effects]
    bias, ppm = sum(changes, start=np.zeros((2, len(history.deviation), 3)))
    return bias, ppm * 1e-6
