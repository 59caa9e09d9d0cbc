# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns how numbers and other people's names are spelt, the same in page, figures and verdict."""

from __future__ import annotations

import math
import re


def number(value: float, digits: int = 3) -> str:
    """Give a number in significant digits, with no more decimals than those."""
    if not math.isfinite(value):
        return '–'
    if value == 0.0:
        return '0'
    size = math.floor(math.log10(abs(value)))
    if size > 8:
        return f'{value:.{digits - 1}e}'
    decimals = min(digits - 1 - size, digits)
    # Not -0.
    return minus(f'{round(value, decimals) + 0.0:.{max(decimals, 0)}f}')


def minus(text: str) -> str:
    """Put the sign of a printed number for the hyphen."""
    return text.replace('-', '−')


def spelt(text: str) -> str:
    """Put the signs of print for those that a terminal shows."""
    text = re.sub(r'\bug\b', 'µg', text.replace('degC', '°C'))
    return text.replace('|f| - g', '|f| − g').replace('+-', '±')


def rounded(value: float, expanded: float) -> tuple[str, str]:
    """Round an uncertainty to two digits, its value to that place; an unknown one is a dash."""
    if not 0.0 < expanded < math.inf:
        return number(value, 6), '–'
    place = 1 - math.floor(math.log10(expanded))
    if round(expanded, place) >= 10.0 ** (2 - place):  # 0.0996 is 0.10
        place -= 1
    # Not -0.
    said = (f'{round(one, place) + 0.0:.{max(place, 0)}f}' for one in (value, expanded))
    return minus(next(said)), next(said)


def label_text(value: str, limit: int = 40) -> str:
    """Make text that others wrote fit for a figure: one line, printable, not too long."""
    clean = ''.join(c if c.isprintable() else ' ' for c in value).strip()
    return clean if len(clean) <= limit else f'{clean[: limit - 1]}…'
