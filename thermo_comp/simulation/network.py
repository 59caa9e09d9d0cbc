# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the heat paths: lumped parts joined by conductances, self-heating, the thermostat.

The state of the network obeys ``dx/dt = A x + b u(t) + p``: `x` holds the temperatures of the
parts, then the thermostat's integral and set point; `u` is the air temperature; `p` holds the
constant powers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..typing import Floats

AIR = 'air'


@dataclass(frozen=True)
class Link:
    """
    Heat path between two parts, or between a part and the chamber's air, `AIR`.

    The conductance is in W/K (at 1 K, with convection); the heat flows as the power `exponent` of
    the difference: 1 by conduction, 1.25 by free convection.
    """

    a: str
    b: str
    conductance: float
    exponent: float = 1.0


@dataclass(frozen=True)
class Thermostat:
    """
    Proportional-integral heater of one part, which holds `set_point` [degC].

    Gains in W/K and W/(K s); `soft_start` is the time constant with which the set point is
    approached after power-on, s; the heater gives 0 to `max_power` W.
    """

    node: str
    set_point: float
    proportional: float
    integral: float
    soft_start: float
    max_power: float


@dataclass(frozen=True)
class ThermalNetwork:
    """
    Parts with heat capacities [J/K], the paths between them, and the power [W] they dissipate.

    The keys of `capacity` name the parts and fix their order.

    Raises ValueError if a capacity or conductance is not positive, a link, power or thermostat
    names an unknown part, or a part has no heat path to the air.
    """

    capacity: Mapping[str, float]
    links: tuple[Link, ...]
    power: Mapping[str, float] = field(default_factory=dict)
    thermostat: Thermostat | None = None

    def __post_init__(self) -> None:
        for name, value in self.capacity.items():
            if not value > 0.0:
                raise ValueError(f'`capacity` of {name} must be positive, got {value}')
        heated = () if self.thermostat is None else (self.thermostat.node,)
        ends = {end for link in self.links for end in (link.a, link.b)} - {AIR}
        for name in (*ends, *self.power, *heated):
            if name not in self.capacity:
                raise ValueError(f'part {name!r} has no `capacity`')
        for link in self.links:
            if not link.conductance > 0.0:
                raise ValueError(f'`conductance` must be positive, got {link.conductance}')
        reached, grown = {AIR}, True
        while grown:
            grown = False
            for link in self.links:
                if (link.a in reached) != (link.b in reached):
                    reached |= {link.a, link.b}
                    grown = True
        for name in self.capacity:
            if name not in reached:
                raise ValueError(f'part {name!r} has no heat path to the air')

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the parts in the order of every temperature array."""
        return tuple(self.capacity)

    @property
    def is_convective(self) -> bool:
        """Whether a path's flow is no multiple of the difference."""
        return any(link.exponent != 1.0 for link in self.links)

    def system(self) -> tuple[Floats, Floats, Floats]:
        """
        Return the matrices of ``dx/dt = A x + b u + p``, convection left out.

        Shapes (k, k), (k,) and (k,): the parts first, then the thermostat's integral and set
        point.
        """
        n = len(self.nodes)
        size = n + (0 if self.thermostat is None else 2)
        A, b, p = np.zeros((size, size)), np.zeros(size), np.zeros(size)
        index = {name: i for i, name in enumerate(self.nodes)}
        for link in self.links:
            for here, there in ((link.a, link.b), (link.b, link.a)):
                if here == AIR or link.exponent != 1.0:
                    continue
                i = index[here]
                A[i, i] -= link.conductance
                if there == AIR:
                    b[i] += link.conductance
                else:
                    A[i, index[there]] += link.conductance
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
        """
        Return what convection adds to ``dx/dt`` of one state, and its derivatives by the state.
        """
        index = {name: i for i, name in enumerate(self.nodes)}
        flow, slope = np.zeros(len(state)), np.zeros((len(state), len(state)))
        for link in self.links:
            if link.exponent == 1.0:
                continue
            ends = [index.get(name) for name in (link.a, link.b)]
            a, b = (air if i is None else state[i] for i in ends)
            size = link.conductance * abs(a - b) ** (link.exponent - 1.0)
            for sign, i, name in ((-1.0, ends[0], link.a), (1.0, ends[1], link.b)):
                if i is None:
                    continue
                flow[i] += sign * size * (a - b) / self.capacity[name]
                for other, j in ((1.0, ends[0]), (-1.0, ends[1])):
                    if j is not None:
                        slope[i, j] += sign * other * link.exponent * size / self.capacity[name]
        return flow, slope

    def settled(self, air: float, drive: Floats) -> Floats:
        """Return the whole state after an endless soak under a constant drive, shape (k,)."""
        A, b, _ = self.system()
        if not self.is_convective:
            return np.asarray(-np.linalg.inv(A) @ (b * air + drive), dtype=np.float64)
        # Newton's steps; the flow is convex, so some fifty reach the last digit from anywhere.
        state = np.full(len(b), air + 1.0)
        for _ in range(50):
            flow, slope = self.convection(state, air)
            state = state - np.linalg.solve(A + slope, A @ state + b * air + drive + flow)
        return state

    def equilibrium(self, air: float) -> Floats:
        """Return the temperatures [degC] of the parts after an endless soak, shape (n_parts,)."""
        A, b, p = self.system()
        if self.is_convective:
            return self.settled(air, p)[: len(self.nodes)]
        return np.asarray(np.linalg.solve(A, -b * air - p)[: len(self.nodes)], dtype=np.float64)

    def air_for(self, node: str, temperature: float) -> float:
        """Return the air temperature whose endless soak brings a part to a temperature."""
        i, air = self.nodes.index(node), 0.0
        for _ in range(20 if self.is_convective else 1):
            cold, hot = self.equilibrium(air)[i], self.equilibrium(air + 1.0)[i]
            air += float((temperature - cold) / (hot - cold))
        return air

    def heater_power(self, air: float) -> float:
        """Return what the thermostat spends in an endless soak, W; 0 without one."""
        if self.thermostat is None:
            return 0.0
        A, b, p = self.system()
        return float(np.linalg.solve(A, -b * air - p)[len(self.nodes)])
