# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the ready-made units: a thermostatted quartz triad, a bare quartz one and a MEMS one.

Every seed is another specimen: tempcos, heat paths, misalignment and constants are drawn around
what such units show. The tables below are physics (watts, joules per kelvin, tempcos of parts);
nothing in them knows how a compensator would describe the result.

"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .converter import Converter
from .drift import CreepEffect, DifferenceEffect, DriftModel, PartEffect, Triple
from .network import AIR, Link, ThermalNetwork, Thermostat
from .streams import Stream, generator
from .thermometers import ThermometerModel
from .unit import MICRO_G, STANDARD_GRAVITY, UnitModel


class _Specimen:
    """
    Draws the constants of one specimen.

    """

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self.serial = f'{name}-{seed:04d}'
        self._rng = generator(seed, Stream.UNIT, UNIT_NAMES.index(name))

    def near(self, value: float, spread: float = 0.05) -> float:
        return value * (1.0 + spread * self._rng.uniform(-1.0, 1.0))

    def axes(self, value: float, spread: float) -> Triple:
        # Around one value, the sign kept.
        x, y, z = value * (1.0 + spread * self._rng.uniform(-1.0, 1.0, 3))
        return float(x), float(y), float(z)

    def signed(self, low: float, high: float) -> Triple:
        # Magnitudes even in the logarithm, random signs.
        size = np.exp(self._rng.uniform(math.log(low), math.log(high), 3))
        x, y, z = size * self._rng.choice((-1.0, 1.0), 3)
        return float(x), float(y), float(z)

    def normal(self, sd: float) -> Triple:
        x, y, z = sd * self._rng.standard_normal(3)
        return float(x), float(y), float(z)

    def misalignment(self, sd: float) -> tuple[Triple, Triple, Triple]:
        a, b, c = self.normal(sd)
        return (1.0, 0.0, 0.0), (a, 1.0, 0.0), (b, c, 1.0)

    def links(self, *paths: tuple[str, str, float]) -> tuple[Link, ...]:
        return tuple(Link(a, b, self.near(conductance)) for a, b, conductance in paths)

    def constants(
        self, full_scale_g: float, bias_ug: float, spread: float = 0.01
    ) -> tuple[Triple, Triple]:
        K = self.axes(32768.0 / (full_scale_g * STANDARD_GRAVITY), spread)
        bx, by, bz = self.normal(bias_ug)
        return K, (bx * K[0] * MICRO_G, by * K[1] * MICRO_G, bz * K[2] * MICRO_G)


def _thermostatted(seed: int) -> UnitModel:
    draw = _Specimen('thermostatted', seed)
    network = ThermalNetwork(
        capacity={
            'case': draw.near(1500.0),
            'board': draw.near(110.0),
            'cover': draw.near(65.0),
            'reference': draw.near(12.0),
            'integrator': draw.near(25.0),
            'oven': draw.near(200.0),
            'head': draw.near(400.0),
        },
        links=draw.links(
            (AIR, 'case', 5.0),
            ('case', 'board', 0.40),
            ('board', 'cover', 0.16),
            ('cover', 'reference', 0.04),
            ('board', 'reference', 0.03),
            ('board', 'integrator', 0.03),
            ('case', 'oven', 0.15),
            ('board', 'oven', 0.02),
            ('oven', 'head', 1.5),
        ),
        power={'board': 0.8, 'reference': 0.02, 'head': 0.3},
        thermostat=Thermostat('oven', 55.0, 20.0, 0.08, 1800.0, 25.0),
    )
    drift = DriftModel(
        parts=(
            # The reference current sets the scale of all axes; its curvature is a bandgap's.
            PartEffect(
                'reference', scale=draw.axes(40.0, 0.15), scale_curvature=draw.axes(0.02, 0.5)
            ),
            # Dielectric absorption and charge injection of each axis' own, potted integrator;
            # the leakage of its switches, which bends upwards, sits on the board itself.
            PartEffect('integrator', scale=draw.normal(3.0), bias=draw.signed(6.0, 14.0)),
            PartEffect('board', bias=draw.normal(1.0), bias_curvature=draw.normal(0.03)),
            PartEffect('head', scale=draw.axes(80.0, 0.1), bias=draw.signed(0.3, 5.0)),
        ),
        differences=(
            DifferenceEffect('board', 'reference', bias=draw.normal(3.0)),
            DifferenceEffect('oven', 'head', bias=draw.normal(2.0)),
        ),
        creeps=(CreepEffect('reference', 5.0 * 3600.0, bias=draw.normal(0.02)),),
    )
    K, bias = draw.constants(11.0, 1500.0)
    return UnitModel(
        name=draw.name,
        serial=draw.serial,
        network=network,
        drift=drift,
        board=ThermometerModel('board', phase=0.5),
        case=ThermometerModel('case'),
        scale_factor=K,
        bias_at_reference=bias,
        misalignment=draw.misalignment(1e-3),
        noise_density=(5.0, 5.0, 5.0),
        converter=Converter(),
    )


def _bare_quartz(seed: int) -> UnitModel:
    draw = _Specimen('bare-quartz', seed)
    network = ThermalNetwork(
        capacity={
            'case': draw.near(900.0),
            'board': draw.near(150.0),
            'cover': draw.near(45.0),
            'reference': draw.near(10.0),
            'head': draw.near(120.0),
            'magnet': draw.near(25.0),
            'mount': draw.near(50.0),
            'pendulum': draw.near(3.0),
        },
        links=draw.links(
            (AIR, 'case', 4.0),
            ('case', 'board', 0.50),
            ('board', 'cover', 0.12),
            ('cover', 'reference', 0.04),
            ('board', 'reference', 0.02),
            ('board', 'head', 4.0),
            ('head', 'magnet', 0.80),
            ('head', 'mount', 0.05),
            ('case', 'mount', 0.01),
            ('head', 'pendulum', 0.01),
            ('magnet', 'pendulum', 0.01),
        ),
        power={'board': 0.6, 'magnet': 0.02},
    )
    drift = DriftModel(
        parts=(
            PartEffect(
                'magnet', scale=draw.axes(48.0, 0.01), scale_curvature=draw.axes(0.31, 0.02)
            ),
            PartEffect('reference', scale=draw.axes(29.5, 0.01)),
            PartEffect('pendulum', bias=draw.signed(0.3, 5.0), bias_curvature=draw.normal(0.005)),
        ),
        differences=(
            # The shunt that offsets the magnet's own tempco, and the coil on the pendulum, are
            # not at one temperature in a ramp: parts that balance in still air do not then.
            DifferenceEffect(
                'head', 'pendulum', scale=draw.axes(-115.0, 0.2), bias=draw.normal(15.0)
            ),
            # Stress through the joint to the mounting ring, heavy and slow, bolted to the case.
            DifferenceEffect('mount', 'head', scale=draw.axes(15.0, 0.3), bias=draw.normal(4.0)),
        ),
        creeps=(CreepEffect('pendulum', 6.0 * 3600.0, bias=draw.normal(0.02)),),
    )
    K, bias = draw.constants(11.0, 2000.0)
    return UnitModel(
        name=draw.name,
        serial=draw.serial,
        network=network,
        drift=drift,
        board=ThermometerModel('board', phase=0.5),
        case=ThermometerModel('case'),
        scale_factor=K,
        bias_at_reference=bias,
        misalignment=draw.misalignment(1e-3),
        noise_density=(5.0, 5.0, 5.0),
        converter=Converter(),
    )


def _mems(seed: int) -> UnitModel:
    draw = _Specimen('mems', seed)
    network = ThermalNetwork(
        capacity={
            'case': draw.near(60.0),
            'board': draw.near(12.0),
            'package': draw.near(0.6),
            'die': draw.near(0.05),
        },
        links=draw.links(
            (AIR, 'case', 0.5),
            ('case', 'board', 0.08),
            ('board', 'package', 0.02),
            ('package', 'die', 0.01),
        ),
        power={'board': 0.15, 'die': 0.004},
    )
    drift = DriftModel(
        parts=(
            PartEffect(
                'die',
                scale=draw.normal(150.0),
                bias=draw.signed(100.0, 500.0),
                bias_curvature=draw.normal(3.0),
            ),
        ),
        differences=(DifferenceEffect('board', 'package', bias=draw.normal(300.0)),),
        creeps=(CreepEffect('package', 4.0 * 3600.0, bias=draw.normal(2.0)),),
    )
    K, bias = draw.constants(16.0, 20000.0, spread=0.02)
    return UnitModel(
        name=draw.name,
        serial=draw.serial,
        network=network,
        drift=drift,
        board=ThermometerModel('board', noise_sd=0.02, phase=0.5),
        case=ThermometerModel('case', noise_sd=0.02),
        scale_factor=K,
        bias_at_reference=bias,
        misalignment=draw.misalignment(1e-2),
        noise_density=(120.0, 120.0, 150.0),
        converter=Converter(carries_remainder=False),
    )


_PRESETS: dict[str, Callable[[int], UnitModel]] = {
    'thermostatted': _thermostatted,
    'bare-quartz': _bare_quartz,
    'mems': _mems,
}
UNIT_NAMES = tuple(_PRESETS)


def unit_preset(name: str, seed: int = 0) -> UnitModel:
    """
    Return one specimen of a kind of unit.

    Parameters
    ----------
    name : str
        'thermostatted' (quartz triad in an oven, the converter's board outside: the board's
        drift dominates), 'bare-quartz' (no oven: the magnet's scale tempco dominates) or 'mems'.
    seed : int, optional
        Another specimen for every seed, not negative.

    Returns
    -------
    UnitModel
        The unit.

    Raises
    ------
    ValueError
        If there is no such preset.

    """
    if name not in _PRESETS:
        raise ValueError(f'`name` must be one of {", ".join(UNIT_NAMES)}, got {name!r}')
    return _PRESETS[name](seed)
