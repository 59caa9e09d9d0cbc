# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the heat flow over a program: the network solved exactly, in its modes.

To the network's state come the followers, slow relaxations that take no heat. The air temperature
is straight between knots; within such an interval the solution is a straight line plus decaying
modes, so any instant can be evaluated without integrating up to it.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .network import ThermalNetwork

_CHUNK = 65536  # instants evaluated at once; bounds the memory of the mode table
_MODES_CONDITION = 1e9  # eigenvectors worse than that have no accurate modal solution


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

    def heater_power(self, time: ArrayLike) -> NDArray[np.float64]:
        """
        Return what the thermostat spends, 0 W without one.

        Parameters
        ----------
        time : array_like, shape (m,)
            Instants within the program, s.

        Returns
        -------
        ndarray, shape (m,)
            Heater power, W.

        """
        states = self.states(time)
        heat = self.network.thermostat
        if heat is None:
            return np.zeros(len(states))
        n = len(self.network.nodes)
        error = states[:, n + 1] - states[:, self.network.nodes.index(heat.node)]
        return heat.proportional * error + states[:, n]

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
