# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the simulated instrument: its parts, its drift, its converter and its thermometers.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .converter import Converter
from .drift import ZERO, DriftModel, Triple
from .network import ThermalNetwork
from .thermometers import ThermometerModel

STANDARD_GRAVITY = 9.80665
MICRO_G = STANDARD_GRAVITY * 1e-6


@dataclass(frozen=True)
class UnitModel:
    """
    One physical unit with all its constants: the truth that a calibration looks for.

    Per axis, ``counts = K * scale(T) * s + bias(T) + noise`` summed into whole counts, where
    ``s = inverse(M) @ f`` is the specific force along the sensitivity axes.

    Parameters
    ----------
    name : str
        Preset or other kind of unit.
    serial : str
        Serial number.
    network : ThermalNetwork
        Its parts and heat paths.
    drift : DriftModel
        Its temperature effects.
    board, case : ThermometerModel
        Its thermometers.
    scale_factor : tuple of float
        K per axis at the reference temperature, counts/cycle per m/s^2.
    bias_at_reference : tuple of float
        Bias per axis at the reference temperature, counts/cycle.
    misalignment : tuple of tuple of float, shape (3, 3)
        M, lower triangular with unit diagonal: from the sensitivity axes to the orthogonal frame.
    noise_density : tuple of float
        White noise of the acceleration per axis, ug/sqrt(Hz): the mean over `T` seconds has the
        standard deviation ``noise_density / sqrt(T)``.
    converter : Converter
        The converter.
    reference_temperature : float, optional
        Reading of the board's part at which K and bias hold in still air, degC.

    """

    name: str
    serial: str
    network: ThermalNetwork
    drift: DriftModel
    board: ThermometerModel
    case: ThermometerModel
    scale_factor: Triple
    bias_at_reference: Triple
    misalignment: tuple[Triple, Triple, Triple]
    noise_density: Triple
    converter: Converter
    reference_temperature: float = 20.0

    @property
    def M(self) -> NDArray[np.float64]:
        """
        Misalignment matrix, shape (3, 3).

        """
        return np.array(self.misalignment)

    @property
    def origin(self) -> NDArray[np.float64]:
        """
        Temperatures of the parts in the still state of the reference, shape (n_parts,), degC.

        """
        air = self.network.air_for(self.board.node, self.reference_temperature)
        return self.network.equilibrium(air)

    def with_thermometers(
        self,
        *,
        noise_sd: float | None = None,
        quantum: float | None = None,
        rate_hz: float | None = None,
    ) -> UnitModel:
        """
        Return the unit with other thermometers, the same kind on board and case.

        Parameters
        ----------
        noise_sd : float or None, optional
            White noise of a reading, K; None keeps.
        quantum : float or None, optional
            Step of the readings, K; None keeps.
        rate_hz : float or None, optional
            Readings per second; None keeps.

        Returns
        -------
        UnitModel
            The changed unit.

        """

        def changed(model: ThermometerModel) -> ThermometerModel:
            return replace(
                model,
                noise_sd=model.noise_sd if noise_sd is None else noise_sd,
                quantum=model.quantum if quantum is None else quantum,
                rate_hz=model.rate_hz if rate_hz is None else rate_hz,
            )

        return replace(self, board=changed(self.board), case=changed(self.case))

    def with_lags(self, *, case: float | None = None, board: float | None = None) -> UnitModel:
        """
        Return the unit with other thermal lags, by changing heat capacities alone.

        Parameters
        ----------
        case : float or None, optional
            Time constant of the case against the air: a ramp that begins in the air with the rate
            `r` starts the case off with the second derivative ``r / case``, s; None keeps.
        board : float or None, optional
            Lag of the board behind the case in an endless ramp, s; None keeps.

        Returns
        -------
        UnitModel
            The changed unit.

        Raises
        ------
        ValueError
            If a lag is not positive.

        """
        for label, value in (('case', case), ('board', board)):
            if value is not None and not value > 0.0:
                raise ValueError(f'`{label}` must be positive, got {value}')
        network, node = self.network, self.case.node
        if case is not None:
            _, b, _ = network.system()
            now = 1.0 / b[network.nodes.index(node)]
            capacity = {**network.capacity, node: network.capacity[node] * case / now}
            network = replace(network, capacity=capacity)
        if board is not None:
            now = network.ramp_lag(self.board.node, behind=node)
            network = network.stretched(board / now, keep=(node,))
        return replace(self, network=network)

    def without_noise(self) -> UnitModel:
        """
        Return the unit with no white noise on the axes and the thermometers.

        """
        return replace(self.with_thermometers(noise_sd=0.0), noise_density=ZERO)

    def without_drift(self) -> UnitModel:
        """
        Return the unit with bias and scale that do not depend on temperature.

        """
        return replace(self, drift=DriftModel())
