# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the heat paths: lumped parts joined by conductances, self-heating, the thermostat; solved.

The state of the network obeys ``dx/dt = A x + b u(t) + p``: `x` holds the temperatures of the
parts, then the thermostat's integral and set point; `u` is the air temperature; `p` holds the
constant powers. Between knots of the air the solution is a straight line plus decaying modes. A
network with convection has no modes and is integrated, interval by interval.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from ..typing import Floats

AIR = 'air'
_CHUNK = 65536  # instants evaluated at once; bounds the memory of the mode table


@dataclass(frozen=True)
class Link:
    """
    Heat path between two parts, or a part and the chamber's air, `AIR`: W/K (at 1 K, with
    convection). Heat flows as the power `exponent` of the difference, 1.25 by free convection.
    """

    a: str
    b: str
    conductance: float
    exponent: float = 1.0


@dataclass(frozen=True)
class Thermostat:
    """
    Heater of one part, 0 to `max_power` W, which holds `set_point` [degC], and approaches it with
    the time constant `soft_start` [s]; gains in W/K and W/(K s).
    """

    node: str
    set_point: float
    proportional: float
    integral: float
    soft_start: float
    max_power: float


@dataclass(frozen=True)
class ThermalNetwork:
    """Parts with heat capacities [J/K], the paths between them, and the power [W] they spend."""

    capacity: Mapping[str, float]
    links: tuple[Link, ...]
    power: Mapping[str, float] = field(default_factory=dict)
    thermostat: Thermostat | None = None

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the parts in the order of every temperature array."""
        return tuple(self.capacity)

    @property
    def is_convective(self) -> bool:
        """Whether a path's flow is no multiple of the difference."""
        return any(link.exponent != 1.0 for link in self.links)

    @property
    def _places(self) -> dict[str, int]:
        return {AIR: -1, **{name: i for i, name in enumerate(self.nodes)}}

    def system(self) -> tuple[Floats, Floats, Floats]:
        """Return A, b and p, shapes (k, k), (k,) and (k,), convection left out."""
        n, index = len(self.nodes), self._places
        size = n + (0 if self.thermostat is None else 2)
        both, p = np.zeros((size + 1, size + 1)), np.zeros(size)
        for link in self.links:
            if link.exponent == 1.0:
                i, j = index[link.a], index[link.b]
                both[[i, j], [i, j]] -= link.conductance
                both[[i, j], [j, i]] += link.conductance
        A, b = both[:-1, :-1].copy(), both[:-1, -1].copy()
        for name, watts in self.power.items():
            p[index[name]] += watts
        heat = self.thermostat
        if heat is not None:
            i, integral, set_point = index[heat.node], n, n + 1
            # Heater power = proportional * (set point - T) + integral state.
            A[i, i] -= heat.proportional
            A[i, set_point] += heat.proportional
            A[i, integral] += 1.0
            A[integral, set_point] += heat.integral
            A[integral, i] -= heat.integral
            A[set_point, set_point] = -1.0 / heat.soft_start
            p[set_point] = heat.set_point / heat.soft_start
        rows = np.array(list(self.capacity.values()))
        A[:n] /= rows[:, None]
        b[:n] /= rows
        p[:n] /= rows
        return A, b, p

    def convection(self, state: Floats, air: float) -> tuple[Floats, Floats]:
        """Return what convection adds to ``dx/dt`` of one state, and its derivatives by it."""
        index, at = self._places, np.append(state, air)
        flow, slope = np.zeros(len(at)), np.zeros((len(at), len(at)))
        for link in self.links:
            if link.exponent == 1.0:
                continue
            i, j = index[link.a], index[link.b]
            size = link.conductance * abs(at[i] - at[j]) ** (link.exponent - 1.0)
            for here, there in ((i, j), (j, i)):
                if here >= 0:
                    capacity = self.capacity[self.nodes[here]]
                    flow[here] -= size * (at[here] - at[there]) / capacity
                    slope[here, here] -= link.exponent * size / capacity
                    slope[here, there] += link.exponent * size / capacity
        return flow[:-1], slope[:-1, :-1]

    def settled(self, air: float, power: Floats | None = None) -> Floats:
        """Return the state after an endless soak under constant powers, shape (k,)."""
        A, b, p = self.system()
        drive = p if power is None else power
        if not self.is_convective:
            return np.asarray(np.linalg.solve(A, -b * air - drive), dtype=np.float64)
        # Newton's steps; the flow is convex, so some fifty reach the last digit from anywhere.
        state = np.full(len(b), air + 1.0)
        for _ in range(50):
            flow, slope = self.convection(state, air)
            state = state - np.linalg.solve(A + slope, A @ state + b * air + drive + flow)
        return state

    def equilibrium(self, air: float) -> Floats:
        """Return the temperatures [degC] of the parts after an endless soak, shape (n_parts,)."""
        return self.settled(air)[: len(self.nodes)]

    def air_for(self, node: str, temperature: float) -> float:
        """Return the air temperature whose endless soak brings a part to a temperature."""
        i, air = self.nodes.index(node), 0.0
        for _ in range(20 if self.is_convective else 1):
            cold, hot = self.equilibrium(air)[i], self.equilibrium(air + 1.0)[i]
            air += float((temperature - cold) / (hot - cold))
        return air


class ThermalResponse:
    """
    Temperatures of a network over a program, at any instant.

    `knot_air` are the air temperatures at the `knot_time` [s], shape (m,); `power` is what the
    parts dissipate between the knots beside the constant powers, W, shape (m - 1, n_parts). A warm
    start is in equilibrium with everything on; else all is switched on at the air's temperature.
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
            # The state behind the parts' temperatures.
            n = len(network.nodes)
            watts = [network.settled(float(a))[n] for a in (air.max(), air.min())]
            if watts[0] < 0.0 or watts[1] > heat.max_power:
                raise ValueError(
                    f'air of {air.min():g}..{air.max():g} degC needs {watts[0]:.2f}..'
                    f'{watts[1]:.2f} W of a thermostat that gives 0..{heat.max_power:g} W'
                )
        A, b, p = network.system()
        drive = np.tile(p, (len(self._time) - 1, 1))
        if power is not None:
            drive[:, : len(network.nodes)] += np.asarray(power) / list(network.capacity.values())
        # Parts and set point begin with the air, the integral with nothing.
        cold = np.full(len(p), air[0])
        cold[len(network.nodes) : len(p) - 1] = 0.0
        self._integrated: list[Any] = []
        if network.is_convective:
            self._integrate(air, drive, network.settled(air[0], drive[0]) if is_warm else cold)
            return
        inverse = np.linalg.inv(A)
        rate, modes = np.linalg.eig(A)
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
        state = -inverse @ (b * air[0] + drive[0]) if is_warm else cold
        amplitude[0] = unmix @ (state - self._alpha[0])
        for k in range(1, len(length)):
            decayed = np.exp(rate * length[k - 1]) * amplitude[k - 1]
            amplitude[k] = decayed - jump[k - 1]
        self._amplitude = amplitude

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
        """Return the parts' temperatures, the thermostat's integral [W] and set point, (m, k)."""
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
