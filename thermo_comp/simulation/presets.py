# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the ready-made simulated units: three kinds of instruments and the sample bags' unit."""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from .drift import CreepEffect, Effect, FlowEffect, PartEffect, Triple, triple
from .network import AIR, Link, ThermalNetwork, Thermostat
from .unit import GyroModel, Stream, UnitModel, generator, rounded


class Specimen:
    """Draws the constants of a simulated unit; each `kind` has a separate random stream."""

    def __init__(self, name: str, seed: int, kind: int) -> None:
        self.name = name
        self._seed = seed
        self._rng = generator(seed, Stream.UNIT, kind)

    def near(self, value: float) -> float:
        """Draw a number within 5 % of a value."""
        return value * (1.0 + 0.05 * self._rng.uniform(-1.0, 1.0))

    def between(self, low: float, high: float) -> float:
        """Draw a number uniformly between two limits."""
        return float(self._rng.uniform(low, high))

    def axes(self, value: float, spread: float) -> Triple:
        """Draw a number for each axis, uniform within `value` times (1 +- `spread`)."""
        return triple(value * (1.0 + spread * self._rng.uniform(-1.0, 1.0, 3)))

    def signed(self, low: float, high: float) -> Triple:
        """Draw a number for each axis, of log-uniform magnitude and random sign."""
        size = np.exp(self._rng.uniform(math.log(low), math.log(high), 3))
        return triple(size * self._rng.choice((-1.0, 1.0), 3))

    def normal(self, sd: float) -> Triple:
        """Draw a number for each axis from a normal distribution of mean 0."""
        return triple(sd * self._rng.standard_normal(3))

    def heat(self, **capacity: float) -> dict[str, float]:
        """Draw heat capacities within 5 % of the given values."""
        return {part: self.near(value) for part, value in capacity.items()}

    def links(self, *paths: tuple[str, str, float]) -> tuple[Link, ...]:
        """Draw heat paths with conductances within 5 % of the given values."""
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
        """Return a unit with random scale factors, biases and misalignment."""
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

    def triad(self, network: ThermalNetwork, drift: Iterable[Effect], **others: Any) -> UnitModel:
        """Return a triad of bare sensor heads on a board, with random constants."""
        # At 4 Hz, means over 60 s have an sd of 0.65 ug: noise of 3 ug/sqrt(Hz), and rounding.
        noise: dict[str, Any] = {'noise_density': (3.0, 3.0, 3.0), 'full_scale_g': 9.975}
        return self.unit(network, tuple(drift), bias_ug=1500.0, **noise, **others)


def _thermostatted(draw: Specimen) -> UnitModel:
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
        # The reference current determines the scale of all axes, with the curvature over
        # temperature of a bandgap reference.
        PartEffect('reference', scale=draw.axes(40.0, 0.15), scale_curvature=draw.axes(0.02, 0.5)),
        # Each axis' potted integrator has dielectric absorption and charge injection; the leakage
        # of the integrator's switches depends on the temperature of the board.
        PartEffect('integrator', scale=draw.normal(3.0), bias=draw.signed(6.0, 14.0)),
        PartEffect('board', bias=draw.normal(1.0), bias_curvature=draw.normal(0.03)),
        PartEffect('head', scale=draw.axes(80.0, 0.1), bias=draw.signed(0.3, 5.0)),
        PartEffect('board', 'reference', bias=draw.normal(3.0)),
        PartEffect('oven', 'head', bias=draw.normal(2.0)),
        CreepEffect('reference', 5.0 * 3600.0, bias=draw.normal(0.02)),
    )
    return draw.unit(network, drift, full_scale_g=11.0, bias_ug=1500.0)


def _bare_quartz(draw: Specimen) -> UnitModel:
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
        # The effects of the coil on the pendulum and of the shunt, which compensates the magnet's
        # tempco, cancel only in a soak: in a ramp coil and shunt have different temperatures.
        PartEffect('head', 'pendulum', scale=draw.axes(-115.0, 0.2), bias=draw.normal(15.0)),
        # Stress acts through the joint to the mounting ring, which is heavy, slow and bolted to
        # the case.
        PartEffect('mount', 'head', scale=draw.axes(15.0, 0.3), bias=draw.normal(4.0)),
        CreepEffect('pendulum', 6.0 * 3600.0, bias=draw.normal(0.02)),
    )
    return draw.unit(network, drift, full_scale_g=11.0, bias_ug=2000.0)


def _mems(draw: Specimen) -> UnitModel:
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
    noise: dict[str, Any] = {'noise_density': (120.0, 120.0, 150.0), 'converter': rounded}
    spreads = {'bias_ug': 20000.0, 'spread': 0.02, 'misalignment_sd': 1e-2}
    unit = draw.unit(network, drift, full_scale_g=16.0, **spreads, **noise)
    rate = (
        PartEffect('die', bias=draw.signed(5.0, 20.0), bias_curvature=draw.normal(0.1)),
        PartEffect('board', 'package', bias=draw.normal(30.0)),
        CreepEffect('package', 4.0 * 3600.0, bias=draw.normal(0.1)),
    )
    gyro = GyroModel(rate, draw.normal(500.0), (5.0, 5.0, 5.0), turn_on=2.0)
    return replace(unit.with_thermometers(noise_sd=0.02), gyro=gyro)


def _demo(draw: Specimen) -> UnitModel:
    """Draw the unit of the sample bags: tempcos, heat loads, and a head that lags the board."""
    # The thermal time constants are short, so that the unit settles in the soaks of the bags.
    board_tau, tau = 0.25 * draw.between(400.0, 900.0), draw.between(500.0, 1500.0)
    # The sensor head has a small heat capacity, so that it hardly affects the board.
    capacity = {'case': draw.between(900.0, 1800.0), 'board': 0.4 * board_tau, 'head': 0.02 * tau}
    ends = Link('case', 'board', 0.4), Link('board', 'head', 0.02)
    links = (*draw.links((AIR, 'case', 4.0)), *ends)
    network = ThermalNetwork(capacity, links, power={'board': draw.between(0.05, 0.15)})
    drift = PartEffect('board', **tempcos(draw))
    # `stress` follows the temperature difference board - head, `load` the heat flow case to board.
    stress = PartEffect('board', 'head', bias=draw.signed(0.5, 1.0), scale=draw.normal(1.0))
    load = FlowEffect('case', 'board', 2.0, 0.5, True, bias=draw.signed(60.0, 120.0))
    return draw.triad(network, (drift, *loads(draw), load, stress))


def tempcos(draw: Specimen) -> dict[str, Any]:
    """Draw temperature coefficients of bias and scale of an accelerometer triad."""
    return {
        'bias': draw.signed(2.0, 12.0),
        'bias_curvature': draw.normal(0.08),
        'scale': draw.axes(60.0, 0.4),
        'scale_curvature': draw.axes(0.2, 0.6),
    }


def loads(draw: Specimen) -> list[Effect]:
    """
    Draw the effect of Golovach's paper: offset, slope and curvature over temperature of bias and
    scale differ between ramp and soak, as with a heat pump at its limit.
    """
    knee, exponent = draw.between(0.4, 0.9), draw.between(1.5, 2.5)
    sizes = ((10.0, 40.0, 20.0), (1.0, 4.0, 5.0), (0.03, 0.1, 0.1))
    return [
        FlowEffect(
            'case', 'board', exponent, knee, True, power,
            bias=draw.signed(low, high), scale=draw.normal(ppm),
        )
        for power, (low, high, ppm) in enumerate(sizes)
    ]  # fmt: skip


_KINDS = {
    'thermostatted': (0, _thermostatted),
    'bare-quartz': (1, _bare_quartz),
    'mems': (2, _mems),
    # The units of benchmarks/triads.py use the random streams of the kinds 3 to 12.
    'demo': (13, _demo),
}
UNIT_NAMES = tuple(_KINDS)


def unit_preset(name: str, seed: int = 0) -> UnitModel:
    """
    Return a simulated unit of the kind `name`, with different constants for each seed (>= 0).

    'thermostatted' (quartz triad in an oven; drift of the converter's board outside the oven
    dominates), 'bare-quartz' (no oven: the scale tempco of the magnet dominates), 'mems', or
    'demo' (the unit of the sample bags: the effect of Golovach's paper, and a lag).
    """
    if name not in UNIT_NAMES:
        raise ValueError(f'`name` must be one of {", ".join(UNIT_NAMES)}, got {name!r}')
    kind, draw = _KINDS[name]
    return draw(Specimen(name, seed, kind))
