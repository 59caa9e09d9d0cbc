# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns local gravity: the one number that the norm constraint takes from outside.

A wrong value scales all three scale factors by the same ratio and leaves no trace in the
residuals, so the fit never guesses it.

References
----------
.. [1] WGS 84 normal gravity: NIMA TR8350.2, 3rd edition, eqs 4-1 and 4-3.

"""

from __future__ import annotations

import math

from ..errors import FitError

_EQUATORIAL_GRAVITY = 9.7803253359
_SOMIGLIANA_K = 0.00193185265241
_ECCENTRICITY_SQUARED = 0.00669437999014
_SEMI_MAJOR_AXIS = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_M_RATIO = 0.00344978650684
#: Gravity found anywhere on land, with some room; outside it the number is a slip of the pen.
PLAUSIBLE_GRAVITY = (9.76, 9.84)


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


def resolve_gravity(
    gravity: float | None, latitude_deg: float | None, height_m: float | None
) -> float:
    """Take local gravity from what the user gave; FitError if that is none of the Earth's."""
    if gravity is None:
        if latitude_deg is None or height_m is None:
            raise FitError(
                'local gravity is needed (a wrong value shifts all scale factors and leaves no '
                'trace): give `--gravity` in m/s^2, or `--latitude` and `--height`'
            )
        gravity = normal_gravity(latitude_deg, height_m)
    low, high = PLAUSIBLE_GRAVITY
    if not low <= gravity <= high:
        raise FitError(
            f'local gravity {gravity:g} m/s^2 is not found on Earth ({low}..{high} m/s^2)'
        )
    return gravity
