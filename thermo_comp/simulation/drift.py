# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the physics of the errors: bias and scale driven by the temperatures of physical parts.

Each effect sits in the part where it arises: a tempco in a reference, an integrator or a magnet,
a thermo-EMF or a thermo-elastic stress in the difference between two parts, a creep in a joint
that relaxes. Deviations count from the still state in which the board's thermometer shows the
reference temperature, so bias and scale there are the unit's constants.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .network import ThermalNetwork

Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class PartEffect:
    """
    Tempco of one part, per axis, in the deviation `d` of its temperature.

    ``bias += bias * d + bias_curvature * d^2`` and likewise for the scale.

    Parameters
    ----------
    part : str
        Part of the thermal network.
    scale, scale_curvature : tuple of float, optional
        Relative scale change, ppm/K and ppm/K^2.
    bias, bias_curvature : tuple of float, optional
        Bias change, ug/K and ug/K^2.

    """

    part: str
    scale: Triple = ZERO
    scale_curvature: Triple = ZERO
    bias: Triple = ZERO
    bias_curvature: Triple = ZERO


@dataclass(frozen=True)
class DifferenceEffect:
    """
    Effect of a temperature difference between two parts, per axis.

    Parameters
    ----------
    hot, cold : str
        The effect is proportional to the change of ``T_hot - T_cold``.
    scale : tuple of float, optional
        Relative scale change, ppm/K.
    bias : tuple of float, optional
        Bias change, ug/K.

    """

    hot: str
    cold: str
    scale: Triple = ZERO
    bias: Triple = ZERO


@dataclass(frozen=True)
class CreepEffect:
    """
    Slow relaxation in a part: the effect follows a temperature change and then dies away.

    Parameters
    ----------
    part : str
        Part that relaxes.
    time_constant : float
        Relaxation time, s.
    bias : tuple of float, optional
        Bias right after a quick change of the part's temperature, ug/K.

    """

    part: str
    time_constant: float
    bias: Triple = ZERO


@dataclass(frozen=True)
class DriftModel:
    """
    All effects of a unit.

    Parameters
    ----------
    parts : tuple of PartEffect, optional
        Tempcos.
    differences : tuple of DifferenceEffect, optional
        Effects of gradients.
    creeps : tuple of CreepEffect, optional
        Relaxations.

    """

    parts: tuple[PartEffect, ...] = ()
    differences: tuple[DifferenceEffect, ...] = ()
    creeps: tuple[CreepEffect, ...] = ()

    @property
    def followers(self) -> tuple[tuple[str, float], ...]:
        """
        What the thermal response must follow for the creeps: part and time constant.

        """
        return tuple((creep.part, creep.time_constant) for creep in self.creeps)

    def evaluate(
        self, network: ThermalNetwork, states: NDArray[np.float64], origin: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """
        Return the change of bias and scale.

        Parameters
        ----------
        network : ThermalNetwork
            The parts.
        states : ndarray, shape (m, k)
            States of the response: the parts first, the followers of the creeps last.
        origin : ndarray, shape (n_parts,)
            Temperatures of the parts from which deviations count, degC.

        Returns
        -------
        bias : ndarray, shape (m, 3)
            Change of the bias, ug.
        scale : ndarray, shape (m, 3)
            Relative change of the scale.

        """
        index = {name: i for i, name in enumerate(network.nodes)}
        deviation = states[:, : len(origin)] - origin
        bias, ppm = np.zeros((len(states), 3)), np.zeros((len(states), 3))
        for part in self.parts:
            d = deviation[:, [index[part.part]]]
            bias += d * part.bias + d * d * np.array(part.bias_curvature)
            ppm += d * part.scale + d * d * np.array(part.scale_curvature)
        for pair in self.differences:
            d = deviation[:, [index[pair.hot]]] - deviation[:, [index[pair.cold]]]
            bias += d * pair.bias
            ppm += d * pair.scale
        followed = states[:, states.shape[1] - len(self.creeps) :]
        for k, creep in enumerate(self.creeps):
            d = states[:, [index[creep.part]]] - followed[:, [k]]
            bias += d * creep.bias
        return bias, ppm * 1e-6
