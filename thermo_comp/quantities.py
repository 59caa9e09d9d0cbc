# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the table of the physical bounds of every quantity in a calibration.

The bounds are far wider than any instrument needs and far narrower than the range of a float, so
that a calibration within them gives finite results. Bounds that depend on the unit's full scale
and temperature range (bias, curves, weights and their deviations) are in `unit.limits`.
"""

import math
import operator
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, Final

from .text import counted

#: For each kind of bound: the test of a value, and the words of the error message.
_RULES: dict[str, tuple[Callable[[Any, Any], bool], str]] = {
    'above': (operator.gt, 'be greater than'),
    'at_least': (operator.ge, 'be at least'),
    'nil_or': (lambda value, limit: value == 0 or value >= limit, 'be 0 or at least'),
    'below': (operator.lt, 'be less than'),
    'at_most': (operator.le, 'be at most'),
    'shortest': (operator.ge, 'have at least'),
    'longest': (operator.le, 'have at most'),
}


@dataclass(frozen=True)
class Bounds:
    """Bounds of a number, or of the length of a text or list; `why`: reason for the bounds."""

    above: float | None = None
    at_least: float | None = None
    nil_or: float | None = None
    below: float | None = None
    at_most: float | None = None
    shortest: int | None = None
    longest: int | None = None
    unit: str = ''
    why: str = ''

    def fault(self, value: Any) -> str | None:
        """Return the violated rule as text, None if the value is within the bounds."""
        is_sized = isinstance(value, str | tuple)
        what = 'character' if isinstance(value, str) else 'number'
        for name, (is_kept, rule) in _RULES.items():
            limit = getattr(self, name)
            if limit is not None and not is_kept(len(value) if is_sized else value, limit):
                shown = counted(limit, what) if is_sized else f'{limit:g}'
                return 'must be finite' if shown == 'inf' else f'must {rule} {shown}'
        return None


def _between(lower: float, upper: float, unit: str, why: str) -> Bounds:
    return Bounds(at_least=lower, at_most=upper, unit=unit, why=why)


def _positive(lower: float, upper: float, unit: str, why: str) -> Bounds:
    return Bounds(above=0.0, at_least=lower, at_most=upper, unit=unit, why=why)


def _nil_or(lower: float, upper: float, unit: str, why: str) -> Bounds:
    return Bounds(at_least=0.0, nil_or=lower, at_most=upper, unit=unit, why=why)


_PREPARED: dict[str, Bounds] = {
    # Bounds of the constants of the unit.
    'full scale': _positive(1e-6, 1e16, 'input units', 'float64 holds integers to 9e15'),
    'full-scale force': _positive(1e-3, 1e7, 'm/s^2', 'from a gravimeter to a gun launch'),
    'scale factor': _positive(1e-9, 1e9, 'input units per m/s^2', 'nine decades either side of 1'),
    'cycle time': _positive(1e-7, 1e5, 's', 'from 10 MHz to one sample a day'),
    'gravity': Bounds(above=9.0, below=10.5, unit='m/s^2', why='on Earth 9.76 to 9.84'),
    'angular rate': _between(-1e3, 1e3, 'rad/s', '1000 rad/s are 57000 deg/s'),
    # Bounds of temperatures, rates and times.
    'temperature': Bounds(at_least=-273.15, below=1000.0, unit='degC', why='from 0 K to red heat'),
    'temperature difference': _between(-1273.15, 1273.15, 'K', 'difference of valid temperatures'),
    'temperature span': _positive(1e-2, 1273.15, 'K', 'a smaller span is reading noise'),
    'temperature rate': _between(-1e5, 1e5, 'K/min', '100 times a thermal shock of 1000 K/min'),
    'rate span': _positive(1e-6, 2e5, 'K/min', 'no ramp is slower than 1 K in two years'),
    'time constant': _positive(1e-3, 1e8, 's', 'from a bare thermocouple to three years'),
    'lag': _nil_or(1e-3, 1e8, 's', 'bounds of a time constant; 0: no lag'),
    # Bounds of the columns of the thermal response, and of their weights.
    'value of a column': _between(-1e10, 1e10, 'of the column', 'the cube of 1273 K is 2e9'),
    'span of a column': _positive(1e-9, 2e10, 'of the column', 'a millionth of 0.1 K/min, in K/s'),
    'share': _between(-10.0, 10.0, '', 'no part amplifies a temperature difference tenfold'),
    'width': _nil_or(1e-4, 1e4, 'K', 'a smaller width is reading noise'),
    'gradient': _between(-1273.15, 1273.15, 'K', 'the largest temperature difference'),
    'power': Bounds(at_least=0, at_most=4, why='no unit has shown a power above 3'),
    # Bounds of noises and standard deviations.
    'noise density': _positive(1e-12, 1e3, 'm/s^2/sqrt(Hz)', 'from far below any sensor to 100 g'),
    'rate noise density': _positive(
        1e-12, 1e3, 'rad/s/sqrt(Hz)', 'from far below any sensor to 57000 deg/s'
    ),
    'slow noise': _between(0.0, 1e3, 'm/s^2/sqrt(h)', 'a random walk of 100 g in an hour'),
    'rate slow noise': _between(
        0.0, 1e3, 'rad/s/sqrt(h)', 'a random walk of 57000 deg/s in an hour'
    ),
    'deviation': _between(0.0, 1e4, 'm/s^2', 'an sd of 1000 g is no information'),
    'rate deviation': _between(0.0, 1e3, 'rad/s', 'an sd of 57000 deg/s is no information'),
    'misalignment deviation': _between(0.0, 1.0, 'rad', 'an sd of 1 rad is no information'),
    'nonlinearity': _between(0.0, 1.0, 'g/g^2 or g/g^3', 'at the bound an axis reads 2 g at 1 g'),
    # Bounds of the results of a fit, and of numbers of samples.
    'error': _between(0.0, 1e7, 'm/s^2', 'the largest full-scale force'),
    'number': _between(0.0, 1e15, '', 'a float64 holds integers up to 9e15 exactly'),
    'log evidence': _between(-1e15, 1e15, '', 'a sum over at most 1e15 samples'),
    'deviation of a weight': _between(0.0, 1e16, 'of the weight', 'the largest full scale'),
    # Bounds of the settings of thermometers and of the regime detector.
    'reading noise': _positive(1e-6, 1e2, 'K', 'an sd above 100 K is no measurement'),
    'quantum': _between(0.0, 1e2, 'K', 'no sensor has coarser steps'),
    'ramp': _positive(1e-6, 1e5, 'K/min', 'from 1 K in two years to 100 K in 60 ms'),
    'false alarms': _positive(1e-12, 1e4, '1/h', 'from one alarm in 1e8 years to three a second'),
    'ripple': _between(0.0, 1e3, 'K', 'the ripple of any chamber is smaller'),
    'dwell': _between(0.0, 1e7, 's', 'no soak lasts four months'),
    # Bounds of the lengths of lists in a calibration file.
    'coefficients': Bounds(shortest=1, longest=12, why='powers up to t^11 follow any curve'),
    'knots': Bounds(longest=100, why='one knot per kelvin over 100 K'),
    'columns': Bounds(longest=2000, why='the columns of ten thermometers'),
}
Positive = Annotated[float, Bounds(above=0.0, below=math.inf)]
PositiveOrNone = Annotated[float | None, Bounds(above=0.0, below=math.inf)]
NotNegative = Annotated[float, Bounds(at_least=0.0, below=math.inf)]
#: Bounds by the name of the quantity; the keys of a calibration refer to these names.
QUANTITIES: Final[Mapping[str, Bounds]] = MappingProxyType(_PREPARED)


@cache
def _bounds_of(cls: type) -> dict[str, tuple[Bounds, ...]]:
    return {
        name: tuple(note for note in getattr(hint, '__metadata__', ()) if isinstance(note, Bounds))
        for name, hint in typing.get_type_hints(cls, include_extras=True).items()
    }


def refuse_impossible(value: Any) -> None:
    """Raise ValueError with the name of the key if a field of a dataclass violates its bounds."""
    cls: type = type(value)
    for name, bounds in _bounds_of(cls).items():
        given = getattr(value, name)
        is_optional = getattr(cls, name, 0) is None  # None is the default
        for bound in () if given is None and is_optional else bounds:
            if fault := bound.fault(given):
                raise ValueError(f'`{name}` {fault}, got {given}')
