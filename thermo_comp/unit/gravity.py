# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns standard gravity, the unit g, and the formatting and parsing of accelerations."""

import math
import re

#: Standard gravity [m/s^2], defined by the 3rd General Conference on Weights and Measures, 1901.
STANDARD_GRAVITY = 9.80665
#: Angular rate of the Earth's rotation [rad/s]: WGS 84, NIMA TR8350.2.
EARTH_RATE = 7.292115e-5
#: One micro-g, a unit of accelerometer errors [m/s^2].
MICRO_G = 1e-6 * STANDARD_GRAVITY

_UNITS = {
    'ug': MICRO_G,
    'µg': MICRO_G,
    'mg': 1e-3 * STANDARD_GRAVITY,
    'g': STANDARD_GRAVITY,
    'm/s^2': 1.0,
    'm/s²': 1.0,
}


def ug_text(acceleration: float) -> str:
    """Format an error in ug, or in mg from 1 mg on: two digits below 99.5, else an integer."""
    value, unit = acceleration / MICRO_G, 'ug'
    if abs(value) >= 999.5:
        value, unit = value / 1e3, 'mg'
    return f'{value:.2g} {unit}' if abs(value) < 99.5 else f'{value:.0f} {unit}'


def parse_acceleration(text: str) -> float:
    """Parse a positive acceleration with unit, like ``100ug``, ``0.5 mg`` or ``1e-3 m/s^2``."""
    match = re.fullmatch(r'\s*(\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+)\s*(\S+)\s*', text)
    value = float(match[1]) * _UNITS.get(match[2].replace('\u03bc', 'µ'), 0.0) if match else 0.0
    if not 0.0 < value < math.inf:
        raise ValueError(
            f'expected a positive number with its unit, like 100ug or 1e-3m/s^2, got {text!r}'
        )
    return value
