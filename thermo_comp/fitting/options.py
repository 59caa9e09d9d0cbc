# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the options of a fit and their checks, normal gravity, and the choice of curve families.

An error of the stated gravity changes all three scale factors by the same ratio, without an effect
on the residuals. The user must state gravity, as a fit cannot estimate it.

References
----------
.. [1] WGS 84 normal gravity: NIMA TR8350.2, 3rd edition, eqs 4-1 and 4-3.

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from ..errors import FitError
from ..quantities import QUANTITIES, NotNegative, Positive, PositiveOrNone, refuse_impossible
from ..recording.stillness import STILL_SD
from ..thermal.settings import DetectorSettings
from ..unit.calibration import Calibration
from ..unit.columns import bank
from ..unit.functions import CubicSpline, Exponential, Polynomial, TemperatureFunction
from ..unit.gravity import STANDARD_GRAVITY
from ..unit.nonlinearity import K2_SD, Kind
from .reduction import ReducedBag
from .windows import Sets

#: Largest code of the converter of the unit in Golovach's paper: 16 bits in two's complement.
COUNTS_FULL_SCALE = 32767.0
# Names of the polynomials over temperature of order 1, 2 and 3.
_POLYNOMIALS = ('linear', 'quadratic', 'cubic')
#: Names of the groups of columns from which the fit selects: curve over the board temperature,
#: difference of the two sets, curves over parts' temperatures, groups of the thermal response.
GROUPS = (
    'curve',
    'set',
    'part',
    *dict.fromkeys(column.group for column in bank(at_rest={'case': 1.0}, span_k=(-9.0, 9.0))),
)
#: Names of the refusals of data that a user can override.
REFUSALS = ('prior', 'saturation', 'units', 'stuck', 'jump', 'swapped', 'compensated')


@dataclass(frozen=True)
class FitOptions:
    """
    Options of a fit; raises ValueError if an option is outside its range.

    gravity: local gravity [m/s^2]; a value that does not occur on Earth raises FitError
    model: 'response' selects from all columns; 'golovach' is the model of Golovach's paper with a
        linear static set, a quadratic dynamic set and no thermal response
    static_curve, dynamic_curve: families of static and dynamic curve; None: default of `model`
    groups, forced: groups of columns that the model may have (None: all); groups it must have
    prior: calibration of this unit or of its type; the fit uses all its columns, with no selection
    ageing_bias, ageing_scale: sd of the change of bias [m/s^2] and relative scale [1] since the
        prior calibration; if both are 0, the fit estimates them from the bags
    mounting_sd: sd of the bias offset of a mounting or turn-on [m/s^2], or None to estimate it
    gravity_sd: standard deviation of `gravity` [m/s^2]
    k2_sd, k3_sd: prior sd of the nonlinear terms K2 [g/g^2] and K3 [g/g^3], from a data sheet;
        None: 100 ug/g^2, 10 ug/g^3; if both are None, bags at 1 g give no nonlinear terms
    serial: serial of the unit, or None for the serial of the sources
    input: unit of the samples
    full_scale: magnitude of a saturated sample [input units]; None: 32767 counts, or in m/s^2 the
        smallest usual range 10 % above all samples
    offset: code at zero force, such as 32768, or None to estimate it from the bags
    reference_temperature: temperature at which bias and scale factor are stated [degC]
    detector: thermometer and detector settings, or None to estimate them from the bags
    min_rest_s: length of the shortest rest [s], or None to choose 1, 2 or 3 s from the data
    still_sd: largest sd of the samples at rest [m/s^2]
    allow: names, listed in `REFUSALS`, of the refusals of data that the user overrides
    """

    gravity: float
    model: Literal['response', 'golovach'] = 'response'
    static_curve: str | None = None
    dynamic_curve: str | None = None
    groups: tuple[str, ...] | None = None
    forced: tuple[str, ...] = ()
    prior: Calibration | None = None
    ageing_bias: NotNegative = 0.0
    ageing_scale: NotNegative = 0.0
    mounting_sd: PositiveOrNone = None
    gravity_sd: NotNegative = 0.0
    k2_sd: Annotated[PositiveOrNone, QUANTITIES['nonlinearity']] = None
    k3_sd: Annotated[PositiveOrNone, QUANTITIES['nonlinearity']] = None
    serial: str | None = None
    input: Literal['counts', 'm/s^2'] = 'counts'
    full_scale: PositiveOrNone = None
    offset: float | None = None
    reference_temperature: float = 20.0
    detector: DetectorSettings | None = None
    min_rest_s: PositiveOrNone = None
    still_sd: Positive = STILL_SD * STANDARD_GRAVITY
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # Range of gravity on land [m/s^2], with a margin: other values are typing errors.
        low, high = 9.76, 9.84
        if not low <= self.gravity <= high:
            raise FitError(
                f'local gravity {self.gravity:g} m/s^2 is not found on Earth ({low}..{high} m/s^2)'
            )
        refuse_impossible(self)
        if self.offset is not None and not math.isfinite(self.offset):
            raise ValueError(f'`offset` must be finite, got {self.offset}')
        allowed: dict[str, tuple[str, ...]] = {
            'input': ('counts', 'm/s^2'),
            'model': ('response', 'golovach'),
            **dict.fromkeys(
                ('static_curve', 'dynamic_curve'), (*_POLYNOMIALS, 'spline', 'exponential')
            ),
            **dict.fromkeys(('groups', 'forced'), GROUPS),
            'allow': REFUSALS,
        }
        for name, words in allowed.items():
            given = getattr(self, name)
            if isinstance(given, str) and name in ('groups', 'forced', 'allow'):
                raise ValueError(f'`{name}` must be a list of names, got {given!r}')
            for word in given if isinstance(given, tuple | list) else (given,):
                if word is not None and word not in words:
                    raise ValueError(f'`{name}` must be one of {", ".join(words)}, got {word!r}')
        if self.prior is not None:
            if not isinstance(self.prior, Calibration):
                raise ValueError(f'`prior` must be a Calibration, see `load`, got {self.prior!r}')
            if self.prior.unit.input != self.input:
                known = self.prior.unit.input
                raise ValueError(
                    f'`prior` is in {known}, the samples are in {self.input}: a prior must be in '
                    'the unit of the samples'
                )

    def nonlinear_sd(self, kind: Kind) -> float:
        """Return the prior sd of a nonlinear term: [g/g^3] for the cube, [g/g^2] for others."""
        if kind == 'cube':
            # Limits of K3 in data sheets of quartz pendulums are a few ug/g^3.
            return 1e-5 if self.k3_sd is None else self.k3_sd
        return K2_SD if self.k2_sd is None else self.k2_sd

    @property
    def saturated_at(self) -> float | None:
        """Magnitude of a saturated sample [input units], or None to choose it from the data."""
        return self.full_scale or (COUNTS_FULL_SCALE if self.input == 'counts' else None)


def sets_of(options: FitOptions, bags: Sequence[ReducedBag]) -> Sets:
    """Choose the families of curves of the static and the dynamic set."""
    celsius = np.concatenate([bag.board.value for bag in bags])
    if not len(celsius):
        line = _family('linear', 0.0, 0.0)
        return Sets(line, line)
    edges = float(celsius.min()), float(celsius.max())
    lower, upper = (edge - options.reference_temperature for edge in edges)
    is_paper = options.model == 'golovach'
    static = options.static_curve or ('linear' if is_paper else 'cubic')
    dynamic = options.dynamic_curve or ('quadratic' if is_paper else None)
    if dynamic is None and static in _POLYNOMIALS:
        return Sets(_family(static, lower, upper), _family('quadratic', lower, upper))
    return Sets(
        _family(static, lower, upper), _family(dynamic or static, lower, upper), is_shared=False
    )


def _family(name: str, lower: float, upper: float) -> TemperatureFunction:
    if name in _POLYNOMIALS:
        return Polynomial((0.0, *[1.0] * (1 + _POLYNOMIALS.index(name))))
    if name == 'exponential':
        # Exponentials grow e-fold in 15 K (leakage currents, which double in 10 K) or in 30 K.
        return Exponential(-2.0, (1.0, 1.0), (15.0, 30.0))
    # The spline has a knot at the reference temperature, and those of five equidistant knots that
    # are farther from the reference temperature than 0.3 of the knot spacing.
    knots = np.linspace(lower, upper, 5)
    step = max((upper - lower) / 4, 1.0)
    kept = sorted([0.0, *(float(k) for k in knots if abs(k) > 0.3 * step)])
    return CubicSpline(tuple(kept), tuple(float(k != 0.0) for k in kept))


def normal_gravity(latitude_deg: float, height_m: float) -> float:
    """
    Return the normal gravity [m/s^2] at a height above the WGS 84 ellipsoid (Somigliana).

    Real gravity differs from normal gravity by 30 mGal (30 ug) RMS, in mountains by about 50 mGal.
    Raises ValueError for a latitude outside -90..90 deg or a height outside -1000..10000 m.
    """
    if not -90.0 <= latitude_deg <= 90.0:
        raise ValueError(f'`latitude_deg` must be within -90..90, got {latitude_deg}')
    if not -1000.0 <= height_m <= 10000.0:
        raise ValueError(f'`height_m` must be within -1000..10000, got {height_m}')
    sine2 = math.sin(math.radians(latitude_deg)) ** 2
    # Constants of WGS 84: gravity at the equator, Somigliana's k, eccentricity squared.
    root = math.sqrt(1.0 - 0.00669437999014 * sine2)
    at_ellipsoid = 9.7803253359 * (1.0 + 0.00193185265241 * sine2) / root
    # Constants of WGS 84: semi-major axis, flattening, centrifugal / gravity at the equator (m).
    relative, flattening, m = height_m / 6378137.0, 1.0 / 298.257223563, 0.00344978650684
    slope = 2.0 * (1.0 + flattening + m - 2.0 * flattening * sine2)
    return at_ellipsoid * (1.0 - slope * relative + 3.0 * relative**2)
