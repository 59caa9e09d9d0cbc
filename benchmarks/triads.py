# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns simulated units for tests and benchmarks: triads of several kinds (docs/accuracy.md describes
them), which differ in their thermal effects, and siblings of a unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from thermo_comp.simulation.drift import (
    ZERO,
    Effect,
    FlowEffect,
    PartEffect,
    PartHistory,
    Triple,
    triple,
)
from thermo_comp.simulation.network import AIR, Link, ThermalNetwork
from thermo_comp.simulation.presets import Specimen, loads, tempcos, unit_preset
from thermo_comp.simulation.unit import Stream, SwitchedLoad, UnitModel, generator
from thermo_comp.typing import Floats
from thermo_comp.unit.gravity import MICRO_G

#: Kinds of triads; the index of a kind here plus `FIRST_KIND` is the number of its random stream.
TRIAD_NAMES = (
    *('own-lags', 'between', 'products', 'hysteresis', 'even', 'convection', 'switched-load'),
    *('paper', 'slow-noise', 'plain'),
)
FIRST_KIND = 3


@dataclass(frozen=True)
class LeakageEffect(Effect):
    """Leakage of a junction: ``exp(d / growth) - 1``, d: part's temperature less reference [K]."""

    part: str
    growth: float

    def _signals(self, history: PartHistory) -> tuple[Floats, float]:
        return np.expm1(history.of(self.part) / self.growth), 0.0


@dataclass(frozen=True)
class SlipEffect(Effect):
    """
    A slipping joint, strained by the temperature of a part. The joint's stress [K of free
    strain] depends on the path of the temperature, not on time, and is 0 at the start. The joint
    slips abruptly at a stress of `width` [K] (Jenkins) or gradually up to it (Dahl, Bouc-Wen).
    """

    part: str
    width: float
    is_gradual: bool = False

    def _signals(self, history: PartHistory) -> tuple[Floats, float]:
        strain = np.diff(history.of(self.part), prepend=history.of(self.part)[:1])
        width, now = self.width, 0.0
        kept = np.exp(-np.abs(strain) / width).tolist()
        stress = np.empty(len(strain))
        for k, step in enumerate(strain.tolist()):
            if self.is_gradual and step:
                limit = width if step > 0.0 else -width
                now = limit + (now - limit) * kept[k]
            else:
                now = min(max(now + step, -width), width)
            stress[k] = now
        return stress, 0.0


def _only(axis: int, value: float) -> Triple:
    x, y, z = (value * (i == axis) for i in range(3))
    return x, y, z


def triad(kind: str, seed: int = 0) -> UnitModel:
    """
    Return a triad whose sensor heads lag the board's temperature. Bias and scale are constant in
    the kind 'plain'. Except in 'plain', bias and scale depend on the heads' temperatures (kind
    'paper': the board's) and, in the kinds of `_EXTRA`, on further effects.
    """
    draw = Specimen(kind, seed, FIRST_KIND + TRIAD_NAMES.index(kind))
    heads = ['head-x', 'head-y', 'head-z'] if kind in _OWN_HEADS else ['head']
    board_tau, taus = draw.between(400.0, 900.0), [draw.between(500.0, 1500.0) for _ in heads]
    capacity = {'case': draw.between(900.0, 1800.0), 'board': 0.4 * board_tau}
    links = [*draw.links((AIR, 'case', 4.0)), Link('case', 'board', 0.4)]
    for head, tau in zip(heads, taus, strict=True):
        # A head has a small heat capacity, so that it hardly changes the board's temperature.
        to_case = draw.between(0.2, 0.8) if kind in _BETWEEN else 0.0
        capacity[head] = 0.02 * tau
        links.append(Link('board', head, 0.02 * (1.0 - to_case)))
        if to_case:
            links.append(Link('case', head, 0.02 * to_case))
    if kind == 'convection':
        # Part of the heat between case and board flows by convection, as (T_case - T_board)^1.25.
        links[1] = Link('case', 'board', 0.15)
        links.append(Link('case', 'board', draw.between(0.15, 0.35), exponent=1.25))
    network = ThermalNetwork(capacity, tuple(links), power={'board': draw.between(0.05, 0.15)})
    drift = _tempcos(draw, ['board'] if kind == 'paper' else heads)
    if kind in _EXTRA:
        drift += _EXTRA[kind](draw)
    load = SwitchedLoad('board', draw.between(0.3, 0.8)) if kind == 'switched-load' else None
    return draw.triad(
        network,
        drift if kind != 'plain' else (),
        bias_walk=(3.0, 3.0, 3.0) if kind == 'slow-noise' else ZERO,
        load=load,
    )


def unit_of(kind: str, seed: int = 0) -> UnitModel:
    """Return a triad of a kind of this module, or a unit of the package's presets."""
    return triad(kind, seed) if kind in TRIAD_NAMES else unit_preset(kind, seed)


def _tempcos(draw: Specimen, parts: list[str]) -> list[Effect]:
    values = tempcos(draw)
    if len(parts) == 1:
        return [PartEffect(parts[0], **values)]
    return [
        PartEffect(part, **{name: _only(i, value[i]) for name, value in values.items()})
        for i, part in enumerate(parts)
    ]


def _slips(draw: Specimen) -> list[Effect]:
    # Each axis has a joint that slips abruptly and a joint that slips gradually.
    effects: list[Effect] = []
    for i in range(3):
        for is_gradual in (False, True):
            width = draw.between(0.5, 1.5)
            stress = draw.signed(1.5, 4.0)[i] / width
            effects.append(SlipEffect('head', width, is_gradual, bias=_only(i, stress)))
    return effects


# Kinds with a head per axis; kinds whose heads exchange heat with both the board and the case.
_OWN_HEADS = ('own-lags', 'between', 'switched-load')
_BETWEEN = ('between', 'switched-load')
_EXTRA: dict[str, Callable[[Specimen], list[Effect]]] = {
    # Stress between quartz and metal: the expansion coefficients differ more at high temperature.
    'products': lambda draw: [
        PartEffect(
            'board', 'head', bias=draw.signed(3.0, 12.0), bias_curvature=draw.signed(0.1, 0.5),
            scale=draw.signed(10.0, 40.0), scale_curvature=draw.signed(0.3, 1.5),
        )
    ],
    'hysteresis': _slips,
    # Flow ~ |T_case - T_board|^n: load (n = 1) and losses (2) of a heat pump, convection (1.25).
    'even': lambda draw: [
        FlowEffect('case', 'board', 1.0, bias=draw.signed(3.0, 12.0), scale=draw.normal(10.0)),
        FlowEffect('case', 'board', 2.0, bias=draw.signed(0.2, 1.0)),
        FlowEffect('case', 'board', 1.25, bias=draw.normal(2.0), bias_curvature=draw.normal(0.05)),
    ],
    # The leakage is 1 to 5 ug at the reference temperature, and doubles every 7 to 10 K.
    'convection': lambda draw: [
        LeakageEffect('board', draw.between(10.0, 14.5), bias=draw.signed(1.0, 5.0))
    ],
    'paper': loads,
}  # fmt: skip


def sibling(unit: UnitModel, seed: int, spread: float = 0.15) -> UnitModel:
    """
    Return a unit of the type of `unit` with other constants and misalignment; its thermal
    coefficients, widths and heat capacities are those of `unit` times 1 +- `spread` at most.
    """
    rng = generator(seed, Stream.SIBLING)

    def near(value: float) -> float:
        return float(value * (1.0 + spread * rng.uniform(-1.0, 1.0)))

    def changed(effect: Effect) -> Effect:
        values: dict[str, float | Triple] = {}
        for name, value in vars(effect).items():
            if isinstance(value, tuple):
                values[name] = near(value[0]), near(value[1]), near(value[2])
            elif isinstance(value, float) and name != 'exponent':
                values[name] = near(value)
        return replace(effect, **values)

    capacity = {name: near(value) for name, value in unit.network.capacity.items()}
    K = np.array(unit.scale_factor) * (1.0 + 0.005 * rng.standard_normal(3))
    bias = np.array(unit.bias_at_reference) + 200.0 * MICRO_G * K * rng.standard_normal(3)
    M = unit.M + 1e-3 * np.tril(rng.standard_normal((3, 3)), -1)
    return replace(
        unit,
        serial=f'{unit.serial}-{seed:02d}',
        network=replace(unit.network, capacity=capacity),
        drift=tuple(changed(effect) for effect in unit.drift),
        scale_factor=triple(K),
        bias_at_reference=triple(bias),
        misalignment=(triple(M[0]), triple(M[1]), triple(M[2])),
    )
