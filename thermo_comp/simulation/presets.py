# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the ready-made units: three instruments, and triads with one kind of physics each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from .drift import (
    ZERO,
    CreepEffect,
    Effect,
    FlowEffect,
    LeakageEffect,
    PartEffect,
    SlipEffect,
    Triple,
    triple,
)
from .network import AIR, Link, ThermalNetwork, Thermostat
from .unit import GyroModel, Stream, SwitchedLoad, UnitModel, generator, rounded


class _Specimen:
    """Draws the constants of one specimen."""

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self._seed = seed
        self._rng = generator(seed, Stream.UNIT, UNIT_NAMES.index(name))

    def near(self, value: float) -> float:
        return value * (1.0 + 0.05 * self._rng.uniform(-1.0, 1.0))

    def between(self, low: float, high: float) -> float:
        return float(self._rng.uniform(low, high))

    def axes(self, value: float, spread: float) -> Triple:
        # Spread around a value, with the same sign.
        return triple(value * (1.0 + spread * self._rng.uniform(-1.0, 1.0, 3)))

    def signed(self, low: float, high: float) -> Triple:
        # Log-uniform magnitudes, random signs.
        size = np.exp(self._rng.uniform(math.log(low), math.log(high), 3))
        return triple(size * self._rng.choice((-1.0, 1.0), 3))

    def normal(self, sd: float) -> Triple:
        return triple(sd * self._rng.standard_normal(3))

    def heat(self, **capacity: float) -> dict[str, float]:
        return {part: self.near(value) for part, value in capacity.items()}

    def links(self, *paths: tuple[str, str, float]) -> tuple[Link, ...]:
        return tuple(Link(a, b, self.near(conductance)) for a, b, conductance in paths)

    def unit(
        self,
        network: ThermalNetwork,
        drift: tuple[Effect, ...],
        *,
        full_scale_g: float,
        bias_ug: float,
        spread: float = 0.01,
        misalignment_sd: float = 1e-3,
        **others: Any,
    ) -> UnitModel:
        """Return the unit with random constants."""
        K = self.axes(32768.0 / (full_scale_g * STANDARD_GRAVITY), spread)
        bx, by, bz = self.normal(bias_ug)
        yx, zx, zy = self.normal(misalignment_sd)
        return UnitModel(
            serial=f'{self.name}-{self._seed:04d}',
            network=network,
            drift=drift,
            scale_factor=K,
            bias_at_reference=(bx * K[0] * MICRO_G, by * K[1] * MICRO_G, bz * K[2] * MICRO_G),
            misalignment=((1.0, 0.0, 0.0), (yx, 1.0, 0.0), (zx, zy, 1.0)),
            **others,
        )


def _only(axis: int, value: float) -> Triple:
    x, y, z = (value * (i == axis) for i in range(3))
    return x, y, z


def _thermostatted(draw: _Specimen) -> UnitModel:
    network = ThermalNetwork(
        capacity=draw.heat(
            case=1500, board=110, cover=65, reference=12, integrator=25, oven=200, head=400
        ),
        links=draw.links(
            (AIR, 'case', 5.0), ('case', 'board', 0.40), ('board', 'cover', 0.16),
            ('cover', 'reference', 0.04), ('board', 'reference', 0.03),
            ('board', 'integrator', 0.03), ('case', 'oven', 0.15), ('board', 'oven', 0.02),
            ('oven', 'head', 1.5),
        ),
        power={'board': 0.8, 'reference': 0.02, 'head': 0.3},
        thermostat=Thermostat('oven', 55.0, 20.0, 0.08, 25.0),
    )  # fmt: skip
    drift = (
        # The reference current sets the scale of all axes; its curvature is a bandgap's.
        PartEffect('reference', scale=draw.axes(40.0, 0.15), scale_curvature=draw.axes(0.02, 0.5)),
        # Dielectric absorption and charge injection of each axis' potted integrator; the leakage
        # of its switches, with positive curvature, is on the board.
        PartEffect('integrator', scale=draw.normal(3.0), bias=draw.signed(6.0, 14.0)),
        PartEffect('board', bias=draw.normal(1.0), bias_curvature=draw.normal(0.03)),
        PartEffect('head', scale=draw.axes(80.0, 0.1), bias=draw.signed(0.3, 5.0)),
        PartEffect('board', 'reference', bias=draw.normal(3.0)),
        PartEffect('oven', 'head', bias=draw.normal(2.0)),
        CreepEffect('reference', 5.0 * 3600.0, bias=draw.normal(0.02)),
    )
    return draw.unit(network, drift, full_scale_g=11.0, bias_ug=1500.0)


def _bare_quartz(draw: _Specimen) -> UnitModel:
    network = ThermalNetwork(
        capacity=draw.heat(
            case=900, board=150, cover=45, reference=10, head=120, magnet=25, mount=50, pendulum=3
        ),
        links=draw.links(
            (AIR, 'case', 4.0), ('case', 'board', 0.50), ('board', 'cover', 0.12),
            ('cover', 'reference', 0.04), ('board', 'reference', 0.02), ('board', 'head', 4.0),
            ('head', 'magnet', 0.80), ('head', 'mount', 0.05), ('case', 'mount', 0.01),
            ('head', 'pendulum', 0.01), ('magnet', 'pendulum', 0.01),
        ),
        power={'board': 0.6, 'magnet': 0.02},
    )  # fmt: skip
    drift = (
        PartEffect('magnet', scale=draw.axes(48.0, 0.01), scale_curvature=draw.axes(0.31, 0.02)),
        PartEffect('reference', scale=draw.axes(29.5, 0.01)),
        PartEffect('pendulum', bias=draw.signed(0.3, 5.0), bias_curvature=draw.normal(0.005)),
        # The shunt that compensates the magnet's tempco and the coil on the pendulum have
        # different temperatures in a ramp: effects that cancel in a soak do not cancel then.
        PartEffect('head', 'pendulum', scale=draw.axes(-115.0, 0.2), bias=draw.normal(15.0)),
        # Stress through the joint to the mounting ring, heavy and slow, bolted to the case.
        PartEffect('mount', 'head', scale=draw.axes(15.0, 0.3), bias=draw.normal(4.0)),
        CreepEffect('pendulum', 6.0 * 3600.0, bias=draw.normal(0.02)),
    )
    return draw.unit(network, drift, full_scale_g=11.0, bias_ug=2000.0)


def _mems(draw: _Specimen) -> UnitModel:
    network = ThermalNetwork(
        capacity=draw.heat(case=60, board=12, package=0.6, die=0.05),
        links=draw.links(
            (AIR, 'case', 0.5), ('case', 'board', 0.08), ('board', 'package', 0.02),
            ('package', 'die', 0.01),
        ),
        power={'board': 0.15, 'die': 0.004},
    )  # fmt: skip
    drift = (
        PartEffect(
            'die',
            scale=draw.normal(150.0),
            bias=draw.signed(100.0, 500.0),
            bias_curvature=draw.normal(3.0),
        ),
        PartEffect('board', 'package', bias=draw.normal(300.0)),
        CreepEffect('package', 4.0 * 3600.0, bias=draw.normal(2.0)),
    )
    unit = draw.unit(
        network,
        drift,
        full_scale_g=16.0,
        bias_ug=20000.0,
        spread=0.02,
        misalignment_sd=1e-2,
        noise_density=(120.0, 120.0, 150.0),
        converter=rounded,
    )
    rate = (
        PartEffect('die', bias=draw.signed(5.0, 20.0), bias_curvature=draw.normal(0.1)),
        PartEffect('board', 'package', bias=draw.normal(30.0)),
        CreepEffect('package', 4.0 * 3600.0, bias=draw.normal(0.1)),
    )
    gyro = GyroModel(rate, draw.normal(500.0), (5.0, 5.0, 5.0), turn_on=2.0)
    return replace(unit.with_thermometers(noise_sd=0.02), gyro=gyro)


def _triad(draw: _Specimen) -> UnitModel:
    """Draw a triad of bare heads on a board: tempcos that lag, and the physics of its kind."""
    kind = draw.name
    heads = ['head-x', 'head-y', 'head-z'] if kind in _OWN_HEADS else ['head']
    board_tau, taus = draw.between(400.0, 900.0), [draw.between(500.0, 1500.0) for _ in heads]
    if kind == 'demo':
        # Sample bags are short: the unit must settle in their soaks.
        board_tau *= 0.25
    capacity = {'case': draw.between(900.0, 1800.0), 'board': 0.4 * board_tau}
    links = [*draw.links((AIR, 'case', 4.0)), Link('case', 'board', 0.4)]
    for head, tau in zip(heads, taus, strict=True):
        # A head has a small heat capacity, so that it hardly affects the board.
        to_case = draw.between(0.2, 0.8) if kind in _BETWEEN else 0.0
        capacity[head] = 0.02 * tau
        links.append(Link('board', head, 0.02 * (1.0 - to_case)))
        if to_case:
            links.append(Link('case', head, 0.02 * to_case))
    if kind == 'convection':
        # Convection in the gap carries part of the heat.
        links[1] = Link('case', 'board', 0.15)
        links.append(Link('case', 'board', draw.between(0.15, 0.35), exponent=1.25))
    network = ThermalNetwork(capacity, tuple(links), power={'board': draw.between(0.05, 0.15)})
    drift = _tempcos(draw, ['board'] if kind in _ON_BOARD else heads)
    if kind in _EXTRA:
        drift += _EXTRA[kind](draw)
    load = SwitchedLoad('board', draw.between(0.3, 0.8)) if kind == 'switched-load' else None
    return draw.unit(
        network,
        tuple(drift) if kind != 'plain' else (),
        full_scale_g=9.975,
        bias_ug=1500.0,
        # With the converter's rounding at 4 Hz, 60 s means have a noise of 0.65 ug per axis.
        noise_density=(3.0, 3.0, 3.0),
        bias_walk=(3.0, 3.0, 3.0) if kind == 'slow-noise' else ZERO,
        load=load,
    )


def _tempcos(draw: _Specimen, parts: list[str]) -> list[Effect]:
    values: dict[str, Any] = {
        'bias': draw.signed(2.0, 12.0),
        'bias_curvature': draw.normal(0.08),
        'scale': draw.axes(60.0, 0.4),
        'scale_curvature': draw.axes(0.2, 0.6),
    }
    if len(parts) == 1:
        return [PartEffect(parts[0], **values)]
    return [
        PartEffect(part, **{name: _only(i, value[i]) for name, value in values.items()})  # type: ignore[arg-type]
        for i, part in enumerate(parts)
    ]


def _slips(draw: _Specimen) -> list[Effect]:
    # Per axis a joint that slips abruptly and a joint that slips gradually.
    effects: list[Effect] = []
    for i in range(3):
        for is_gradual in (False, True):
            width = draw.between(0.5, 1.5)
            stress = draw.signed(1.5, 4.0)[i] / width
            effects.append(SlipEffect('head', width, is_gradual, bias=_only(i, stress)))
    return effects


def _loads(draw: _Specimen) -> list[Effect]:
    # The paper: other offsets, slopes and curvatures while the ambient changes, as with a heat
    # pump at the limit of its supply.
    knee, exponent = draw.between(0.4, 0.9), draw.between(1.5, 2.5)
    sizes = ((10.0, 40.0, 20.0), (1.0, 4.0, 5.0), (0.03, 0.1, 0.1))
    return [
        FlowEffect(
            'case', 'board', exponent, knee, True, power,
            bias=draw.signed(low, high), scale=draw.normal(ppm),
        )
        for power, (low, high, ppm) in enumerate(sizes)
    ]  # fmt: skip


def _sample(draw: _Specimen) -> list[Effect]:
    # Large loads of the paper's kind, and a stress that decays with the lag of the heads.
    stress = PartEffect('board', 'head', bias=draw.signed(0.5, 1.0), scale=draw.normal(1.0))
    load = FlowEffect('case', 'board', 2.0, 0.5, True, bias=draw.signed(60.0, 120.0))
    return [*_loads(draw), load, stress]


# Kinds with a thermal node for each head, and kinds whose heads are also linked to the case.
_OWN_HEADS = ('own-lags', 'between', 'switched-load')
_BETWEEN = ('between', 'switched-load')
# Kinds whose heads have no lag behind the board.
_ON_BOARD = ('paper', 'demo')
_EXTRA: dict[str, Callable[[_Specimen], list[Effect]]] = {
    # Quartz against metal: the difference of the expansion coefficients grows with temperature.
    'products': lambda draw: [
        PartEffect(
            'board', 'head', bias=draw.signed(3.0, 12.0), bias_curvature=draw.signed(0.1, 0.5),
            scale=draw.signed(10.0, 40.0), scale_curvature=draw.signed(0.3, 1.5),
        )
    ],
    'hysteresis': _slips,
    # A heat pump between case and board: its load, its losses, and the gas it stirs.
    'even': lambda draw: [
        FlowEffect('case', 'board', 1.0, bias=draw.signed(3.0, 12.0), scale=draw.normal(10.0)),
        FlowEffect('case', 'board', 2.0, bias=draw.signed(0.2, 1.0)),
        FlowEffect('case', 'board', 1.25, bias=draw.normal(2.0), bias_curvature=draw.normal(0.05)),
    ],
    # Doubles every 7 to 10 K; a few ug at the reference.
    'convection': lambda draw: [
        LeakageEffect('board', draw.between(10.0, 14.5), bias=draw.signed(1.0, 5.0))
    ],
    'paper': _loads,
    'demo': _sample,
}  # fmt: skip
_INSTRUMENTS = {'thermostatted': _thermostatted, 'bare-quartz': _bare_quartz, 'mems': _mems}
TRIAD_NAMES = (
    'own-lags', 'between', 'products', 'hysteresis', 'even', 'convection', 'switched-load',
    'paper', 'slow-noise', 'plain', 'demo',
)  # fmt: skip
UNIT_NAMES = (*_INSTRUMENTS, *TRIAD_NAMES)


def unit_preset(name: str, seed: int = 0) -> UnitModel:
    """
    Return a specimen of a kind of unit, different for every seed (>= 0).

    'thermostatted' (quartz triad in an oven, the converter's board outside: the board's drift
    dominates), 'bare-quartz' (no oven: the magnet's scale tempco dominates), 'mems', 'demo' (the
    sample unit: paper and lags), or a triad with one kind of physics in addition to tempcos that
    lag; see the table in docs/accuracy.md.
    """
    if name not in UNIT_NAMES:
        raise ValueError(f'`name` must be one of {", ".join(UNIT_NAMES)}, got {name!r}')
    return _INSTRUMENTS.get(name, _triad)(_Specimen(name, seed))
