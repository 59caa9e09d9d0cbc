# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the user may say of a fit: options, local gravity, families of curves.

A wrong gravity scales all three scale factors by the same ratio and leaves no trace in the
residuals, so the fit never guesses it.

References
----------
.. [1] WGS 84 normal gravity: NIMA TR8350.2, 3rd edition, eqs 4-1 and 4-3.

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import FitError
from ..recording.stillness import STILL_SD
from ..thermal.settings import DetectorSettings
from ..unit.calibration import Calibration
from ..unit.functions import CubicSpline, Exponential, Polynomial, TemperatureFunction
from ..unit.gravity import STANDARD_GRAVITY
from ..unit.nonlinearity import Kind
from .reduction import ReducedBag
from .windows import Sets

_EQUATORIAL_GRAVITY = 9.7803253359
_SOMIGLIANA_K = 0.00193185265241
_ECCENTRICITY_SQUARED = 0.00669437999014
_SEMI_MAJOR_AXIS = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_M_RATIO = 0.00344978650684
#: Gravity found anywhere on land, with some room; outside it the number is a slip of the pen.
PLAUSIBLE_GRAVITY = (9.76, 9.84)
#: The converter of the paper's unit: 16 bits in two's complement.
COUNTS_FULL_SCALE = 32767.0
#: Families of the curve over temperature.
CURVES = ('linear', 'quadratic', 'cubic', 'spline', 'exponential')
#: What evidence judges: curve and set of the two sets, then the groups of the response.
GROUPS = (
    'curve', 'set', 'gradient', 'board', 'gradient_lag', 'product', 'gradient_x_temperature',
    'square', 'gradient_even', 'gradient_even_about_rest', 'play', 'bend',
)  # fmt: skip
# Prior sd of the nonlinear terms, above the limits of quartz pendulums (some 20 .. 60 ug/g^2 and
# some ug/g^3): [g/g^2] and [g/g^3].
_K2_SD, _K3_SD = 1e-4, 1e-5
_ORDERS = {'linear': 1, 'quadratic': 2, 'cubic': 3}
_SPLINE_PIECES = 4
# Knots nearer to the reference than this part of their distance fall on it.
_NEAR = 0.3
# Semiconductors double their leakage in some 10 K: an e-fold of 15 K, and of twice that.
_E_FOLDS_K = (15.0, 30.0)
#: What is refused, and may be allowed by its name.
REFUSALS = ('prior', 'saturation', 'units', 'stuck', 'jump', 'swapped', 'compensated')
_WORDS: dict[str, tuple[str, ...]] = {
    'input': ('counts', 'm/s^2'),
    'model': ('response', 'golovach'),
    **dict.fromkeys(('static_curve', 'dynamic_curve'), CURVES),
    **dict.fromkeys(('groups', 'forced'), GROUPS),
    'allow': REFUSALS,
}


@dataclass(frozen=True)
class FitOptions:
    """
    Options of a fit; ValueError if one is outside its range.

    gravity: local gravity; FitError if it is none of the Earth's
    model: the whole bank, thinned by evidence; or the paper: a linear static and a quadratic
        dynamic set, without a response
    static_curve, dynamic_curve: one of `CURVES`; None takes the model's own
    groups, forced: groups of columns that may take part (None: all); that stay whatever they earn
    prior: what is known beforehand, of the type or of this unit; its columns are the model
    ageing_bias, ageing_scale: sd of what each has changed by since the prior [m/s^2], [1]; both 0:
        what the bags show
    mounting_sd: how well mounting and turn-on repeat, sd of the bias [m/s^2]; None: not known
    gravity_sd: standard deviation of `gravity` [m/s^2]
    k2_sd, k3_sd: prior sd of the nonlinear terms K2 [g/g^2] and K3 [g/g^3], as of a data sheet;
        None: 100 ug/g^2 and 10 ug/g^3, where positions are not at 1 g, else no such terms
    serial: unit serial; None takes the sources'
    input: unit of the samples
    full_scale: magnitude of a saturated sample; None takes 32767 for counts, and for m/s^2 the
        smallest usual range that holds the data
    offset: what raw words read without a force, as 32768; None finds it out
    reference_temperature: T_ref; the paper uses 20
    detector: thermometer and detector settings; None learns them from the bags
    min_rest_s: length of the shortest rest; None chooses, see `reduction`
    still_sd: largest scatter of the samples at rest [m/s^2]
    allow: names of refusals that the user overrides, see `data_checks`
    """

    gravity: float
    model: Literal['response', 'golovach'] = 'response'
    static_curve: str | None = None
    dynamic_curve: str | None = None
    groups: tuple[str, ...] | None = None
    forced: tuple[str, ...] = ()
    prior: Calibration | None = None
    ageing_bias: float = 0.0
    ageing_scale: float = 0.0
    mounting_sd: float | None = None
    gravity_sd: float = 0.0
    k2_sd: float | None = None
    k3_sd: float | None = None
    serial: str | None = None
    input: Literal['counts', 'm/s^2'] = 'counts'
    full_scale: float | None = None
    offset: float | None = None
    reference_temperature: float = 20.0
    detector: DetectorSettings | None = None
    min_rest_s: float | None = None
    still_sd: float = STILL_SD * STANDARD_GRAVITY
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        low, high = PLAUSIBLE_GRAVITY
        if not low <= self.gravity <= high:
            raise FitError(
                f'local gravity {self.gravity:g} m/s^2 is not found on Earth ({low}..{high} m/s^2)'
            )
        for name in ('min_rest_s', 'still_sd', 'full_scale', 'mounting_sd', 'k2_sd', 'k3_sd'):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f'`{name}` must be positive, got {value}')
        for name in ('ageing_bias', 'ageing_scale', 'gravity_sd'):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f'`{name}` must be 0 or positive, got {getattr(self, name)}')
        if self.offset is not None and not math.isfinite(self.offset):
            raise ValueError(f'`offset` must be finite, got {self.offset}')
        known = self.prior and self.prior.unit.input
        if known and known != self.input:
            raise ValueError(f'`prior` is in {known}, the samples are in {self.input}')
        for name, words in _WORDS.items():
            given = getattr(self, name)
            for word in given if isinstance(given, tuple) else (given,):
                if word is not None and word not in words:
                    raise ValueError(f'`{name}` must be of {", ".join(words)}, got {word!r}')

    def nonlinear_sd(self, kind: Kind) -> float:
        """Prior sd of the coefficients of a nonlinear term."""
        if kind == 'cube':
            return _K3_SD if self.k3_sd is None else self.k3_sd
        return _K2_SD if self.k2_sd is None else self.k2_sd

    @property
    def saturated_at(self) -> float | None:
        """Magnitude of a saturated sample, where it is known before the samples are."""
        return self.full_scale or (COUNTS_FULL_SCALE if self.input == 'counts' else None)


def sets_of(options: FitOptions, bags: Sequence[ReducedBag]) -> Sets:
    """Choose the curves of the two sets."""
    readings = [bag.board.value for bag in bags if len(bag.board.value)]
    if not readings:
        line = _family('linear', 0.0, 0.0)
        return Sets(line, line)
    span = (min(float(r.min()) for r in readings), max(float(r.max()) for r in readings))
    lower, upper = (edge - options.reference_temperature for edge in span)
    is_paper = options.model == 'golovach'
    static = options.static_curve or ('linear' if is_paper else 'cubic')
    dynamic = options.dynamic_curve or ('quadratic' if is_paper else None)
    if dynamic is None and static in _ORDERS:
        return Sets(_family(static, lower, upper), _family('quadratic', lower, upper))
    return Sets(
        _family(static, lower, upper), _family(dynamic or static, lower, upper), is_shared=False
    )


def _family(name: str, lower: float, upper: float) -> TemperatureFunction:
    if name in _ORDERS:
        return Polynomial((0.0, *[1.0] * _ORDERS[name]))
    if name == 'exponential':
        return Exponential(-float(len(_E_FOLDS_K)), (1.0,) * len(_E_FOLDS_K), _E_FOLDS_K)
    knots = np.linspace(lower, upper, _SPLINE_PIECES + 1)
    step = max((upper - lower) / _SPLINE_PIECES, 1.0)
    kept = sorted([0.0, *(float(k) for k in knots if abs(k) > _NEAR * step)])
    return CubicSpline(tuple(kept), tuple(float(k != 0.0) for k in kept))


def normal_gravity(latitude_deg: float, height_m: float) -> float:
    """
    Gravity of the WGS 84 ellipsoid (Somigliana) at a height above it.

    Real gravity differs by up to some 30 mGal (30 ug) in mountains. Raises ValueError for a
    latitude outside -90..90 deg or a height outside -1000..10000 m.
    """
    if not -90.0 <= latitude_deg <= 90.0:
        raise ValueError(f'`latitude_deg` must be within -90..90, got {latitude_deg}')
    if not -1000.0 <= height_m <= 10000.0:
        raise ValueError(f'`height_m` must be within -1000..10000, got {height_m}')
    sine2 = math.sin(math.radians(latitude_deg)) ** 2
    at_ellipsoid = (
        _EQUATORIAL_GRAVITY
        * (1.0 + _SOMIGLIANA_K * sine2)
        / math.sqrt(1.0 - _ECCENTRICITY_SQUARED * sine2)
    )
    relative = height_m / _SEMI_MAJOR_AXIS
    slope = 2.0 * (1.0 + _FLATTENING + _M_RATIO - 2.0 * _FLATTENING * sine2)
    return at_ellipsoid * (1.0 - slope * relative + 3.0 * relative**2)
