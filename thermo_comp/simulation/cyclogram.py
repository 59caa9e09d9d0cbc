# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the chamber's program: air temperature as ramps and soaks, ready-made, random or typed in.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..typing import Floats

_MINUTE = 60.0
_STEP = re.compile(
    r'^(?P<target>[+-]?\d+(?:\.\d*)?|[+-]?\.\d+)'
    r'(?:\s*@\s*(?P<rate>\d+(?:\.\d*)?|\.\d+))?'
    r'(?:\s+(?P<soak>\d+(?:\.\d*)?|\.\d+)\s*(?P<unit>h|min|s))?$'
)
_SECONDS = {'h': 3600.0, 'min': _MINUTE, 's': 1.0}


@dataclass(frozen=True)
class Cyclogram:
    """
    Air temperature [degC] in the chamber over time [s]: straight lines between points.

    Before the first point the air rests at the first temperature, after the last one at the last.

    Raises ValueError if there are fewer than two points, the lengths differ, a value is not
    finite, or the times do not start at 0 and increase.
    """

    time_s: tuple[float, ...]
    temperature_c: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, 'time_s', tuple(float(t) for t in self.time_s))
        object.__setattr__(self, 'temperature_c', tuple(float(c) for c in self.temperature_c))
        if len(self.time_s) != len(self.temperature_c) or len(self.time_s) < 2:
            raise ValueError(
                '`time_s` and `temperature_c` must have one length of at least 2, got '
                f'{len(self.time_s)} and {len(self.temperature_c)}'
            )
        if not all(math.isfinite(v) for v in self.time_s + self.temperature_c):
            raise ValueError('`time_s` and `temperature_c` must be finite')
        if self.time_s[0] != 0.0 or any(np.diff(self.time_s) <= 0.0):
            raise ValueError('`time_s` must start at 0 and increase')

    @property
    def duration_s(self) -> float:
        """Length of the program, s."""
        return self.time_s[-1]

    def at(self, time: ArrayLike) -> Floats:
        """Return the programmed air temperature [degC] at times [s] from the start, shape (m,)."""
        air: Floats = np.interp(np.asarray(time, dtype=float), self.time_s, self.temperature_c)
        return air


def ramps_and_soaks(start: float, soak: float, steps: Sequence[Sequence[float]]) -> Cyclogram:
    """
    Build a program from a first soak [min] and steps: target [degC], rate [K/min], soak [min].

    Raises ValueError if a rate is 0 or a soak is negative.
    """
    time, temperature = [0.0], [float(start)]

    def hold(minutes: float) -> None:
        if not minutes >= 0.0:
            raise ValueError(f'`soak` must not be negative, got {minutes}')
        if minutes > 0.0:
            time.append(time[-1] + minutes * _MINUTE)
            temperature.append(temperature[-1])

    hold(soak)
    for target, rate, rest in steps:
        if not abs(rate) > 0.0:
            raise ValueError(f'`rate` must be positive, got {rate}')
        if target != temperature[-1]:
            time.append(time[-1] + abs(target - temperature[-1]) / abs(rate) * _MINUTE)
            temperature.append(float(target))
        hold(rest)
    return Cyclogram(tuple(time), tuple(temperature))


def parse_cyclogram(text: str) -> Cyclogram:
    """
    Read a program that a user typed, or the name of a ready-made one.

    Steps are separated by commas, semicolons or lines: ``TARGET[@RATE] [SOAK]`` with the target in
    degC, the rate in K/min and the soak as ``90min``, ``1.5h`` or ``30s``. The first step is the
    starting temperature and takes no rate; a later one without a rate keeps the last rate (1 K/min
    if none was given). Example: ``20 30min, 35@0.5 1h, 5@1 1h, 20``.

    Raises ValueError if a step cannot be read, with its number and text, or the program has no
    duration.
    """
    if text.strip() in _PROGRAMS:
        return cyclogram_preset(text.strip())
    steps: list[tuple[float, float, float]] = []
    rate = 1.0
    for number, raw in enumerate(filter(None, map(str.strip, re.split(r'[,;\n]', text))), 1):
        match = _STEP.match(raw)
        if match is None or _is_rate_wrong(number, match['rate']):
            raise ValueError(
                f"cyclogram step {number} '{raw}' must read TARGET[@RATE] [SOAK], "
                "e.g. '35@0.5 90min' (the first one without a rate)"
            )
        rate = float(match['rate']) if match['rate'] else rate
        soak = float(match['soak']) * _SECONDS[match['unit']] / _MINUTE if match['soak'] else 0.0
        steps.append((float(match['target']), rate, soak))
    if not steps:
        raise ValueError('cyclogram is empty')
    return ramps_and_soaks(steps[0][0], steps[0][2], steps[1:])


def _is_rate_wrong(number: int, rate: str | None) -> bool:
    return rate is not None and (number == 1 or float(rate) == 0.0)


# First temperature, first soak [min], then target, rate [K/min] and soak [min] of each step.
_Steps = tuple[float, float, list[tuple[float, float, float]]]
_PROGRAMS: dict[str, _Steps] = {
    # The range and the style of the paper's Fig. 3: up, down and back, with long soaks.
    'paper': (
        20, 60, [(35, 0.5, 90), (20, 0.5, 60), (5, 0.5, 90), (20, 0.5, 60), (35, 0.5, 60)]
    ),
    # Four hours, one bag of a calibration: the whole range, both directions, two ramp rates.
    'chamber': (20, 20, [(35, 0.75, 35), (5, 0.6, 45), (20, 0.75, 35), (8, 1, 23)]),
    # The shortest that shows the whole range, both directions and some rest.
    'three-hours': (20, 10, [(35, 0.8, 30), (5, 1.2, 40), (22, 0.5, 22.25)]),
    # Nine hours and a half: slow and quick ramps both ways, so that no other is beyond them.
    'long': (20, 30, [(35, 0.5, 60), (5, 1, 60), (25, 0.3, 40), (10, 0.7, 45), (33, 0.9, 40),
                      (15, 0.35, 40), (20, 0.5, 20 - 1 / 12.6)]),
    # Other rates, other soak temperatures and another order: what a fit never saw.
    'held-out': (
        12, 40, [(31, 0.35, 45), (17, 0.9, 30), (26, 0.6, 50), (7, 0.7, 60), (22, 0.25, 40)]
    ),
    'slow': (20, 60, [(35, 0.1, 60), (5, 0.2, 60), (20, 0.15, 60)]),
    'fast': (20, 45, [(35, 3, 75), (5, 2, 90), (25, 1.5, 75), (10, 3, 60)]),
    # Ninety minutes: short enough for a bag that ships, with both regimes and both directions.
    'demo': (15, 12, [(30, 1, 22), (8, 1.1, 21)]),
    'soak': (20, 240, []),
}  # fmt: skip
CYCLOGRAM_NAMES = tuple(_PROGRAMS)


def cyclogram_preset(name: str) -> Cyclogram:
    """
    Return one of the ready-made programs, `CYCLOGRAM_NAMES`.

    Raises ValueError if there is no such program.
    """
    if name not in _PROGRAMS:
        raise ValueError(f'`name` must be one of {", ".join(CYCLOGRAM_NAMES)}, got {name!r}')
    return ramps_and_soaks(*_PROGRAMS[name])
