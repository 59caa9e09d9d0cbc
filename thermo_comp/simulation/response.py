# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the heat flow over a program: the network solved exactly, in its modes.

The air temperature is straight between knots; within such an interval the solution is a straight
line plus decaying modes, so any instant can be evaluated without integrating up to it. A network
with convection has no modes and is integrated, interval by interval.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from ..typing import Floats
from .network import ThermalNetwork

_CHUNK = 65536  # instants evaluated at once; bounds the memory of the mode table
_MODES_CONDITION = 1e9  # eigenvectors worse than that have no accurate modal solution


class ThermalResponse:
    """
    Temperatures of a network over a program, at any instant.

    network: the parts
    knot_time, knot_air: times [s] and air temperatures [degC] of knots; straight between them,
        shape (m,)
    power: what the parts dissipate between the knots beside the network's constant powers, W,
        shape (m - 1, n_parts)
    is_warm: true starts in equilibrium with everything on; False has the unit switched on at the
        first knot, every part at the air's temperature

    Raises ValueError if the program drives the thermostat's heater out of its power range, or the
    network's modes cannot be told apart.
    """

    def __init__(
        self,
        network: ThermalNetwork,
        knot_time: ArrayLike,
        knot_air: ArrayLike,
        *,
        power: ArrayLike | None = None,
        is_warm: bool = True,
    ) -> None:
        self.network = network
        self._time = np.asarray(knot_time, dtype=float)
        air = np.asarray(knot_air, dtype=float)
        heat = network.thermostat
        if heat is not None:
            watts = [network.heater_power(float(a)) for a in (air.max(), air.min())]
            if watts[0] < 0.0 or watts[1] > heat.max_power:
                raise ValueError(
                    f'air of {air.min():g}..{air.max():g} degC needs {watts[0]:.2f}..'
                    f'{watts[1]:.2f} W of a thermostat that gives 0..{heat.max_power:g} W'
                )
        A, b, p = network.system()
        drive = np.tile(p, (len(self._time) - 1, 1))
        if power is not None:
            drive[:, : len(network.nodes)] += np.asarray(power) / list(network.capacity.values())
        state = self._first_state(air[0], drive[0], is_warm)
        self._integrated: list[Any] = []
        if network.is_convective:
            self._integrate(air, drive, state)
            return
        inverse = np.linalg.inv(A)
        rate, modes = np.linalg.eig(A)
        if np.linalg.cond(modes) > _MODES_CONDITION:
            raise ValueError('the network has modes that cannot be told apart; change a capacity')
        self._rate, self._modes = rate, modes

        length = np.diff(self._time)
        slope = np.diff(air) / length
        # Straight part of each interval: alpha + beta (t - t_knot).
        self._beta = -slope[:, None] * (inverse @ b)
        self._alpha = (self._beta - np.outer(air[:-1], b) - drive) @ inverse.T
        unmix = np.linalg.inv(modes)
        # Amplitude of each mode at the start of each interval.
        jump = (self._alpha[1:] - self._alpha[:-1] - self._beta[:-1] * length[:-1, None]) @ unmix.T
        amplitude = np.empty((len(length), len(rate)), dtype=complex)
        amplitude[0] = unmix @ (state - self._alpha[0])
        for k in range(1, len(length)):
            decayed = np.exp(rate * length[k - 1]) * amplitude[k - 1]
            amplitude[k] = decayed - jump[k - 1]
        self._amplitude = amplitude

    def _first_state(self, air: float, drive: Floats, is_warm: bool) -> Floats:
        if is_warm:
            return self.network.settled(air, drive)
        state = np.zeros(len(drive))
        state[: len(self.network.nodes)] = air
        if self.network.thermostat is not None:
            state[-1] = air
        return state

    def _integrate(self, air: Floats, drive: Floats, state: Floats) -> None:
        A, b, _ = self.network.system()
        for k, (begin, end) in enumerate(pairwise(self._time)):

            def flow(t: float, x: Floats, k: int = k) -> Floats:
                now = float(np.interp(t, self._time, air))
                return np.asarray(A @ x + b * now + drive[k] + self.network.convection(x, now)[0])

            solved = solve_ivp(
                flow, (begin, end), state, 'LSODA', dense_output=True, rtol=1e-9, atol=1e-9
            )
            state = solved.y[:, -1]
            self._integrated.append(solved.sol)

    def states(self, time: ArrayLike) -> Floats:
        """
        Return the parts' temperatures, the thermostat's integral [W] and set point, shape (m, k).
        """
        time = np.atleast_1d(np.asarray(time, dtype=float))
        k = np.clip(np.searchsorted(self._time, time, side='right') - 1, 0, len(self._time) - 2)
        states = np.empty((len(time), len(self.network.system()[1])))
        if self._integrated:
            for interval in np.unique(k):
                here = k == interval
                states[here] = self._integrated[interval](time[here]).T
            return states
        for first in range(0, len(time), _CHUNK):
            piece = slice(first, first + _CHUNK)
            at, since = k[piece], time[piece] - self._time[k[piece]]
            decaying = np.exp(since[:, None] * self._rate) * self._amplitude[at]
            straight = self._alpha[at] + self._beta[at] * since[:, None]
            states[piece] = straight + (decaying @ self._modes.T).real
        return states

    def temperatures(self, time: ArrayLike) -> Floats:
        """Return the temperatures [degC] in the order of ``network.nodes``, shape (m, n_parts)."""
        return self.states(time)[:, : len(self.network.nodes)]
