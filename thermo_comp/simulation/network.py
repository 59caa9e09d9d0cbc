# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal network of a unit (lumped parts, heat paths, thermostat) and its solution.

The state of the network obeys ``dx/dt = A x + b u(t) + p``: `x` holds the temperatures of the
parts, then the integral of the thermostat's controller [W]; `u` is the air temperature; `p` is
constant. Between the knots of the air temperature the solution is linear in time plus decaying
modes. The nonlinear part of a convective heat flow is constant in each step of 1 s.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import root

from ..typing import Floats

AIR = 'air'
_STEP_S = 1.0  # time step over which convection is held constant [s]


@dataclass(frozen=True)
class Link:
    """
    Heat path between two parts, or between a part and the chamber's air, `AIR`. The heat flow [W]
    is `conductance` times the temperature difference [K] to the power `exponent`, which is 1.25
    for free convection.
    """

    a: str
    b: str
    conductance: float
    exponent: float = 1.0


@dataclass(frozen=True)
class Thermostat:
    """Heater of a part, up to `max_power` [W]; PI gains [W/K], [W/(K s)]; `set_point` [degC]."""

    node: str
    set_point: float
    proportional: float
    integral: float
    max_power: float


@dataclass(frozen=True)
class ThermalNetwork:
    """Heat capacities of parts [J/K], heat paths between parts, dissipation in parts [W]."""

    capacity: Mapping[str, float] = field(hash=False)
    links: tuple[Link, ...]
    power: Mapping[str, float] = field(default_factory=dict, hash=False)
    thermostat: Thermostat | None = None

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the parts in the order of every temperature array."""
        return tuple(self.capacity)

    @property
    def is_convective(self) -> bool:
        """Whether the heat flow of any path is nonlinear."""
        return any(link.exponent != 1.0 for link in self.links)

    @property
    def _places(self) -> dict[str, int]:
        return {AIR: -1, **{name: i for i, name in enumerate(self.nodes)}}

    def system(self) -> tuple[Floats, Floats, Floats]:
        """Return A, b, p of ``dx/dt = A x + b u + p``, as if heat paths were linear; A: (k, k)."""
        n, index = len(self.nodes), self._places
        size = n + (self.thermostat is not None)
        both, p = np.zeros((size + 1, size + 1)), np.zeros(size)
        for link in self.links:
            i, j = index[link.a], index[link.b]
            both[[i, j], [i, j]] -= link.conductance
            both[[i, j], [j, i]] += link.conductance
        A, b = both[:-1, :-1].copy(), both[:-1, -1].copy()
        for name, watts in self.power.items():
            p[index[name]] += watts
        heat = self.thermostat
        if heat is not None:
            i = index[heat.node]
            # Heater power = proportional * (set point - T) + integral, which is state n.
            A[i, i] -= heat.proportional
            A[i, n] += 1.0
            A[n, i] -= heat.integral
            p[[i, n]] += np.array([heat.proportional, heat.integral]) * heat.set_point
        capacities = np.array(list(self.capacity.values()))
        A[:n] /= capacities[:, None]
        b[:n] /= capacities
        p[:n] /= capacities
        return A, b, p

    def convection(self, state: Floats, air: float) -> Floats:
        """Return the part of ``dx/dt`` that `system` lacks: nonlinear heat flows, shape (k,)."""
        index, at = self._places, np.append(state, air)
        flow = np.zeros(len(at))
        for link in self.links:
            i, j = index[link.a], index[link.b]
            drop = at[i] - at[j]
            extra = link.conductance * (abs(drop) ** (link.exponent - 1.0) - 1.0) * drop
            flow[[i, j]] += -extra, extra
        flow[: len(self.nodes)] /= list(self.capacity.values())
        return flow[:-1]

    def settled(self, air: float, power: Floats | None = None) -> Floats:
        """Return the steady state in air at `air` degC, (k,); `power` replaces p in ``dx/dt``."""
        A, b, p = self.system()
        drive = p if power is None else power
        state = np.linalg.solve(A, -b * air - drive)
        if self.is_convective:

            def change(x: Floats) -> Floats:
                return np.asarray(A @ x + b * air + drive + self.convection(x, air))

            state = root(change, state, tol=1e-13).x
        return np.asarray(state, dtype=np.float64)

    def equilibrium(self, air: float) -> Floats:
        """Return the steady temperatures [degC] of the parts, shape (n_parts,)."""
        return self.settled(air)[: len(self.nodes)]

    def air_for(self, node: str, temperature: float) -> float:
        """Return the air temperature at which a part settles at `temperature`."""
        i = self.nodes.index(node)

        def error(air: Floats) -> float:
            return float(self.equilibrium(air[0])[i] - temperature)

        return float(root(error, 0.0, tol=1e-13).x[0])


class ThermalResponse:
    """
    Temperatures of a thermal network at any time of a chamber program.

    `air` holds the chamber's temperatures at the knots `time` [s], shape (m,); `power` is the
    dissipation between the knots in addition to the constant powers [W], shape (m - 1, n_parts).
    At the start all temperatures are in equilibrium with the air and the powers at that time.
    """

    def __init__(
        self, network: ThermalNetwork, time: Floats, air: Floats, power: Floats | None = None
    ) -> None:
        self.network, self._time = network, time
        heat = network.thermostat
        if heat is not None:
            watts = [network.settled(float(a))[-1] for a in (air.max(), air.min())]
            if watts[0] < 0.0 or watts[1] > heat.max_power:
                raise ValueError(
                    f'air of {air.min():g}..{air.max():g} degC needs {watts[0]:.2f}..'
                    f'{watts[1]:.2f} W of the thermostat of the unit, which gives 0..'
                    f'{heat.max_power:g} W: choose other temperatures'
                )
        A, b, p = network.system()
        drive = np.tile(p, (len(self._time) - 1, 1))
        if power is not None:
            drive[:, : len(network.nodes)] += power / list(network.capacity.values())
        if network.is_convective:
            steps = np.arange(self._time[0], self._time[-1], _STEP_S)
            fine = np.union1d(self._time, steps)
            drive = drive[np.searchsorted(self._time, fine[:-1], side='right') - 1]
            air, self._time = np.interp(fine, self._time, air), fine
        inverse = np.linalg.inv(A)
        rate, modes = np.linalg.eig(A)
        unmix = np.linalg.inv(modes)
        self._rate, self._modes = rate, modes

        length = np.diff(self._time)
        # State per interval: alpha + beta (t - t_knot) plus decaying modes from `_amplitude`.
        self._beta = -(np.diff(air) / length)[:, None] * (inverse @ b)
        self._alpha = (self._beta - np.outer(air[:-1], b) - drive) @ inverse.T
        self._amplitude = np.empty((len(length), len(rate)), dtype=complex)
        state = network.settled(air[0], drive[0])
        before = network.convection(state, air[0])
        for k, lasts in enumerate(length):
            # Extrapolate an interval's mean convection from the last two values (Adams-Bashforth).
            now = network.convection(state, air[k])
            self._alpha[k] -= inverse @ (1.5 * now - 0.5 * before)
            self._amplitude[k] = unmix @ (state - self._alpha[k])
            decayed = modes @ (np.exp(rate * lasts) * self._amplitude[k])
            state, before = self._alpha[k] + self._beta[k] * lasts + decayed.real, now

    def states(self, time: Floats) -> Floats:
        """Return the parts' temperatures and the thermostat's integral [W], shape (m, k)."""
        k = np.clip(np.searchsorted(self._time, time, side='right') - 1, 0, len(self._time) - 2)
        since = (time - self._time[k])[:, None]
        decaying = np.exp(since * self._rate) * self._amplitude[k]
        states: Floats = self._alpha[k] + self._beta[k] * since + (decaying @ self._modes.T).real
        return states

    def temperatures(self, time: Floats) -> Floats:
        """Return the temperatures [degC] in the order of ``network.nodes``, shape (m, n_parts)."""
        return self.states(time)[:, : len(self.network.nodes)]
