# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the chamber's program: air temperature as ramps and soaks, ready-made or typed in.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..typing import Floats

_STEP = re.compile(
    r'^(?P<target>[+-]?\d+(?:\.\d*)?|[+-]?\.\d+)'
    r'(?:\s*@\s*(?P<rate>\d+(?:\.\d*)?|\.\d+))?'
    r'(?:\s+(?P<soak>\d+(?:\.\d*)?|\.\d+)\s*(?P<unit>h|min|s))?$'
)
_SECONDS = {'h': 3600.0, 'min': 60.0, 's': 1.0}
_PROGRAMS = {
    # The range and the style of the paper's Fig. 3: up, down and back, with long soaks.
    'paper': '20 60min, 35@0.5 90min, 20 60min, 5 90min, 20 60min, 35 60min',
    # Four hours, one bag of a calibration: the whole range, both directions, two ramp rates.
    'chamber': '20 20min, 35@0.75 35min, 5@0.6 45min, 20@0.75 35min, 8@1 23min',
    # The shortest that shows the whole range, both directions and some rest.
    'three-hours': '20 10min, 35@0.8 30min, 5@1.2 40min, 22@0.5 22.25min',
    # Nine hours and a half: slow and quick ramps both ways, so that no other is beyond them.
    'long': '20 30min, 35@0.5 60min, 5@1 60min, 25@0.3 40min, 10@0.7 45min, 33@0.9 40min, '
    '15@0.35 40min, 20@0.5 19.92063492063492min',
    # Other rates, other soak temperatures and another order: what a fit never saw.
    'held-out': '12 40min, 31@0.35 45min, 17@0.9 30min, 26@0.6 50min, 7@0.7 60min, 22@0.25 40min',
    'slow': '20 60min, 35@0.1 60min, 5@0.2 60min, 20@0.15 60min',
    'fast': '20 45min, 35@3 75min, 5@2 90min, 25@1.5 75min, 10@3 60min',
    # Ninety minutes: short enough for a bag that ships, with both regimes and both directions.
    'demo': '15 12min, 30@1 22min, 8@1.1 21min',
    'soak': '20 4h',
}
CYCLOGRAM_NAMES = tuple(_PROGRAMS)


@dataclass(frozen=True)
class Cyclogram:
    """
    Air temperature [degC] in the chamber over time [s]: straight lines between points.

    Before the first point the air rests at the first temperature, after the last one at the last.
    """

    time_s: tuple[float, ...]
    temperature_c: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.time_s) != len(self.temperature_c) or len(self.time_s) < 2:
            raise ValueError(
                '`time_s` and `temperature_c` must have one length of at least 2, got '
                f'{len(self.time_s)} and {len(self.temperature_c)}'
            )
        if not all(math.isfinite(v) for v in self.time_s + self.temperature_c):
            raise ValueError('`time_s` and `temperature_c` must be finite')

    @property
    def duration_s(self) -> float:
        """Length of the program, s."""
        return self.time_s[-1]

    def at(self, time: ArrayLike) -> Floats:
        """Return the programmed air temperature [degC] at times [s] from the start, shape (m,)."""
        air: Floats = np.interp(np.asarray(time, dtype=float), self.time_s, self.temperature_c)
        return air


def parse_cyclogram(text: str) -> Cyclogram:
    """
    Read a program as a user types it, or the name of a ready-made one, `CYCLOGRAM_NAMES`.

    Steps are separated by commas, semicolons or lines: ``TARGET[@RATE] [SOAK]`` with the target in
    degC, the rate in K/min and the soak as ``90min``, ``1.5h`` or ``30s``. The first step is the
    starting temperature and takes no rate; a later one without a rate keeps the last rate (1 K/min
    if none was given). Example: ``20 30min, 35@0.5 1h, 5@1 1h, 20``.
    """
    text = _PROGRAMS.get(text.strip(), text)
    time, temperature, rate = [0.0], list[float](), 1.0
    for number, raw in enumerate(filter(None, map(str.strip, re.split(r'[,;\n]', text))), 1):
        match = _STEP.match(raw)
        is_first = not temperature
        if match is None or (match['rate'] and (is_first or float(match['rate']) == 0.0)):
            raise ValueError(
                f"cyclogram step {number} '{raw}' must read TARGET[@RATE] [SOAK], "
                "e.g. '35@0.5 90min' (the first one without a rate)"
            )
        target, rate = float(match['target']), float(match['rate'] or rate)
        if is_first:
            temperature.append(target)
        elif target != temperature[-1]:
            time.append(time[-1] + abs(target - temperature[-1]) / rate * 60.0)
            temperature.append(target)
        soak = float(match['soak'] or 0.0) * _SECONDS[match['unit'] or 's']
        if soak > 0.0:
            time.append(time[-1] + soak)
            temperature.append(target)
    if not temperature:
        raise ValueError('cyclogram is empty')
    return Cyclogram(tuple(time), tuple(temperature))
