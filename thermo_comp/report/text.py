# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns how numbers and other people's names are spelt, the same in page, figures and verdict."""

from __future__ import annotations

import math


def number(value: float, digits: int = 3) -> str:
    """Give a number in significant digits, with no more decimals than those."""
    if not math.isfinite(value):
        return '–'
    if value == 0.0:
        return '0'
    size = math.floor(math.log10(abs(value)))
    if size > 8:
        return f'{value:.{digits - 1}e}'
    decimals = digits - 1 - size
    text = f'{round(value, decimals):.{min(max(decimals, 0), digits)}f}'
    return text.replace('-', '−')


def label_text(value: str, limit: int = 40) -> str:
    """Make text that others wrote fit for a figure: one line, printable, not too long."""
    clean = ''.join(c if c.isprintable() else ' ' for c in value).strip()
    return clean if len(clean) <= limit else f'{clean[: limit - 1]}…'
