# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the heat flow: lumped parts joined by conductances, solved exactly in the network's modes.

The state of the network obeys ``dx/dt = A x + b u(t) + p``: `x` holds the temperatures of the
parts, then the thermostat's integral and set point, then the followers (a slow relaxation that
takes no heat); `u` is the air temperature, straight between knots; `p` holds the constant powers.
Within a knot interval the solution is a straight line plus decaying modes, so any instant can be
evaluated without integrating up to it.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

AIR = 'air'
_CHUNK = 65536  # instants evaluated at once; bounds the memory of the mode table
_MODES_CONDITION = 1e9  # eigenvectors worse than that have no accurate modal solution


@dataclass(frozen=True)
class Link:
    """
    Heat path between two parts, or between a part and the air.

    Parameters
    ----------
    a, b : str
        The parts; `AIR` stands for the chamber's air.
    conductance : float
        Conductance of the path, W/K.

    """

    a: str
    b: str
    conductance: float


@dataclass(frozen=True)
class Thermostat:
    """
    Proportional-integral heater with a soft start.

    Parameters
    ----------
    node : str
        Part that is heated and measured.
    set_point : float
        Temperature to hold, degC.
    proportional : float
        Proportional gain, W/K.
    integral : float
        Integral gain, W/(K s).
    soft_start : float
        Time constant with which the set point is approached after power-on, s.
    max_power : float
        Most that the heater can give, W; the least is 0.

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
    Parts with heat capacities, the paths between them, and the power they dissipate.

    Parameters
    ----------
    capacity : mapping of str to float
        Heat capacity of each part, J/K; its keys name the parts and fix their order.
    links : tuple of Link
        Heat paths; at least one leads to the air.
    power : mapping of str to float, optional
        Constant dissipation of parts while the unit is on, W.
    thermostat : Thermostat or None, optional
        Heater of one part.

    Raises
    ------
    ValueError
        If a capacity or conductance is not positive, a link, power or thermostat names an
        unknown part, or a part has no heat path to the air.

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
        """
        Names of the parts in the order of every temperature array.

        """
        return tuple(self.capacity)

    def system(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """
        Return the matrices of ``dx/dt = A x + b u + p``.

        Returns
        -------
        A : ndarray, shape (k, k)
            State matrix, 1/s; the parts first, then the thermostat's integral and set point.
        b : ndarray, shape (k,)
            What the air temperature drives, 1/s.
        p : ndarray, shape (k,)
            Constant drive, K/s.

        """
        n = len(self.nodes)
        size = n + (0 if self.thermostat is None else 2)
        A, b, p = np.zeros((size, size)), np.zeros(size), np.zeros(size)
        index = {name: i for i, name in enumerate(self.nodes)}
        for link in self.links:
            for here, there in ((link.a, link.b), (link.b, link.a)):
                if here == AIR:
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

    def equilibrium(self, air: float) -> NDArray[np.float64]:
        """
        Return the temperatures after an endless soak.

        Parameters
        ----------
        air : float
            Air temperature, degC.

        Returns
        -------
        ndarray, shape (n_parts,)
            Temperatures of the parts, degC.

        """
        A, b, p = self.system()
        return np.linalg.solve(A, -b * air - p)[: len(self.nodes)]

    def air_for(self, node: str, temperature: float) -> float:
        """
        Return the air temperature whose endless soak brings a part to a temperature.

        Parameters
        ----------
        node : str
            Part.
        temperature : float
            Its temperature, degC.

        Returns
        -------
        float
            Air temperature, degC.

        """
        i = self.nodes.index(node)
        cold, hot = self.equilibrium(0.0)[i], self.equilibrium(1.0)[i]
        return float((temperature - cold) / (hot - cold))

    def heater_power(self, air: float) -> float:
        """
        Return what the thermostat spends in an endless soak, 0 W without one.

        Parameters
        ----------
        air : float
            Air temperature, degC.

        Returns
        -------
        float
            Heater power, W.

        """
        if self.thermostat is None:
            return 0.0
        A, b, p = self.system()
        return float(np.linalg.solve(A, -b * air - p)[len(self.nodes)])

    def ramp_lag(self, node: str, behind: str = AIR) -> float:
        """
        Return by how long a part trails another one in an endless ramp.

        Parameters
        ----------
        node : str
            Part that trails.
        behind : str, optional
            Part that leads, or the air.

        Returns
        -------
        float
            ``(T_behind - T_node) / (dT/dt)``, s, self-heating apart.

        """
        A, b, _ = self.system()
        lag = np.linalg.solve(A, np.linalg.solve(A, b))
        lead = 0.0 if behind == AIR else lag[self.nodes.index(behind)]
        return float(lag[self.nodes.index(node)] - lead)

    def stretched(self, factor: float, keep: tuple[str, ...] = ()) -> ThermalNetwork:
        """
        Return the network with every heat capacity multiplied, so that it is slower.

        Parameters
        ----------
        factor : float
            Multiplier of the capacities and of the thermostat's integral time.
        keep : tuple of str, optional
            Parts whose capacity stays.

        Returns
        -------
        ThermalNetwork
            Same paths and powers, other time constants.

        """
        capacity = {
            name: value * (1.0 if name in keep else factor)
            for name, value in self.capacity.items()
        }
        heat = self.thermostat
        if heat is not None:
            heat = replace(heat, integral=heat.integral / factor)
        return replace(self, capacity=capacity, thermostat=heat)


class ThermalResponse:
    """
    Temperatures of a network over a program, at any instant.

    Parameters
    ----------
    network : ThermalNetwork
        The parts.
    knot_time : array_like, shape (m,)
        Times of the air temperature's knots, increasing, s.
    knot_air : array_like, shape (m,)
        Air temperature at the knots, degC; straight between them.
    followers : sequence of (str, float), optional
        Slow relaxations: for each, the part it follows and its time constant, s.
    is_warm : bool, optional
        True starts in equilibrium with everything on; False has the unit switched on at the first
        knot, every part at the air's temperature.

    Raises
    ------
    ValueError
        If the program drives the thermostat's heater out of its power range, or the network's
        modes cannot be told apart.

    """

    def __init__(
        self,
        network: ThermalNetwork,
        knot_time: ArrayLike,
        knot_air: ArrayLike,
        *,
        followers: tuple[tuple[str, float], ...] = (),
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
        A, b, p = _with_followers(network, followers)
        inverse = np.linalg.inv(A)
        rate, modes = np.linalg.eig(A)
        if np.linalg.cond(modes) > _MODES_CONDITION:
            raise ValueError('the network has modes that cannot be told apart; change a capacity')
        self._rate, self._modes = rate, modes
        self._A, self._b, self._p = A, b, p

        length = np.diff(self._time)
        slope = np.diff(air) / length
        # Straight part of each interval: alpha + beta (t - t_knot).
        self._beta = -slope[:, None] * (inverse @ b)
        self._alpha = (self._beta - np.outer(air[:-1], b) - p) @ inverse.T
        unmix = np.linalg.inv(modes)
        state = -inverse @ (b * air[0] + p)
        if not is_warm:
            n = len(network.nodes)
            state[:] = air[0]
            state[n : n + 2 * (heat is not None)] = 0.0
            if heat is not None:
                state[n + 1] = air[0]
        # Amplitude of each mode at the start of each interval.
        jump = (self._alpha[1:] - self._alpha[:-1] - self._beta[:-1] * length[:-1, None]) @ unmix.T
        amplitude = np.empty((len(length), len(rate)), dtype=complex)
        amplitude[0] = unmix @ (state - self._alpha[0])
        for k in range(1, len(length)):
            decayed = np.exp(rate * length[k - 1]) * amplitude[k - 1]
            amplitude[k] = decayed - jump[k - 1]
        self._amplitude = amplitude

    def states(self, time: ArrayLike) -> NDArray[np.float64]:
        """
        Return the whole state, followers included.

        Parameters
        ----------
        time : array_like, shape (m,)
            Instants within the program, s.

        Returns
        -------
        ndarray, shape (m, k)
            Parts, then the thermostat's integral [W] and set point, then the followers.

        """
        time = np.atleast_1d(np.asarray(time, dtype=float))
        result = np.empty((len(time), len(self._rate)))
        for first in range(0, len(time), _CHUNK):
            piece = time[first : first + _CHUNK]
            k = np.searchsorted(self._time, piece, side='right') - 1
            k = np.clip(k, 0, len(self._beta) - 1)
            since = piece - self._time[k]
            decaying = np.exp(since[:, None] * self._rate) * self._amplitude[k]
            straight = self._alpha[k] + self._beta[k] * since[:, None]
            result[first : first + _CHUNK] = straight + (decaying @ self._modes.T).real
        return result

    def temperatures(self, time: ArrayLike) -> NDArray[np.float64]:
        """
        Return the temperatures of the parts.

        Parameters
        ----------
        time : array_like, shape (m,)
            Instants within the program, s.

        Returns
        -------
        ndarray, shape (m, n_parts)
            Temperatures in the order of ``network.nodes``, degC.

        """
        return self.states(time)[:, : len(self.network.nodes)]

    def derivative(
        self, states: NDArray[np.float64], air: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """
        Return the rate of change of states.

        Parameters
        ----------
        states : ndarray, shape (m, k)
            States as `states` gives them.
        air : ndarray, shape (m,)
            Air temperature at the same instants, degC.

        Returns
        -------
        ndarray, shape (m, k)
            ``A x + b u + p``, per second.

        """
        result: NDArray[np.float64] = states @ self._A.T + np.outer(air, self._b) + self._p
        return result


def _with_followers(
    network: ThermalNetwork, followers: tuple[tuple[str, float], ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    A0, b0, p0 = network.system()
    k = len(A0)
    size = k + len(followers)
    A, b, p = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    A[:k, :k], b[:k], p[:k] = A0, b0, p0
    for row, (node, time_constant) in enumerate(followers, start=k):
        A[row, network.nodes.index(node)] = 1.0 / time_constant
        A[row, row] = -1.0 / time_constant
    return A, b, p
