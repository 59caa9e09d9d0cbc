# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the typography of pages and figures, and HTML pages that cannot run or load code."""

import datetime as dt
import math
import re
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from .. import __version__
from ..text import counted
from ..unit.gravity import MICRO_G

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
# Largest number of characters in the margin of a printed page.
_LONGEST_MARGIN = 90


def render(template: str, **context: Any) -> str:
    """Fill a template that extends ``page.html``."""
    now = f'{dt.datetime.now(dt.timezone.utc):%Y-%m-%d %H:%M}'
    known = {'margin': '', 'is_simulated': False, 'now': now, 'version': __version__, **context}
    return _templates().get_template(template).render(known, policy=_POLICY)


@cache
def _templates() -> Environment:
    made = Environment(
        loader=FileSystemLoader(Path(__file__).with_name('templates')),
        autoescape=True,
        finalize=lambda value: '–' if value is None else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        'number': number,
        'cell': lambda value: number(value) if isinstance(value, float) else value,
        'counted': counted,
        'spelt': spelt,
        'minus': minus,
        'fixed': lambda value, form: minus(format(value, form)),
        'ug': lambda acceleration, digits=3: number(acceleration / MICRO_G, digits),
        'of': lambda key, values: values.get(key, math.nan),
        'utc': lambda ns: f'{utc(ns):%Y-%m-%d %H:%M}',
        'css': _css_text,
    }
    return made


def utc(stamp_ns: int) -> dt.datetime:
    """Return a stamp as date and time, in UTC."""
    return dt.datetime.fromtimestamp(stamp_ns // 10**9, dt.timezone.utc)


def _css_text(value: str) -> Markup:
    """Return a quoted text for a style sheet; only ASCII letters and digits stay unescaped."""
    text = ''.join(
        c if c.isalnum() and c.isascii() else f'\\{ord(c):06x}'
        for c in label_text(value, _LONGEST_MARGIN)
    )
    return Markup(f'"{text}"')  # noqa: S704 - everything is escaped


def number(value: float, digits: int = 3) -> str:
    """Format a number with `digits` significant digits, at most `digits` of them decimals."""
    if not math.isfinite(value):
        return '–'
    if value == 0.0:
        return '0'
    size = math.floor(math.log10(abs(value)))
    if size > 8:
        return f'{value:.{digits - 1}e}'
    decimals = min(digits - 1 - size, digits)
    return minus(f'{round(value, decimals) + 0.0:.{max(decimals, 0)}f}')  # + 0.0: no minus zero


def minus(text: str) -> str:
    """Replace hyphens by minus signs."""
    return text.replace('-', '−')


def spelt(text: str) -> str:
    """Replace ASCII spellings by typographic signs."""
    text = re.sub(r'\bug\b', 'µg', text.replace('degC', '°C'))
    return text.replace('|f| - g', '|f| − g').replace('+-', '±')


def rounded(value: float, expanded: float) -> tuple[str, str]:
    """Round an uncertainty to two digits, the value to the same place; '–' if unknown."""
    if not 0.0 < expanded < math.inf:
        return number(value, 6), '–'
    place = 1 - math.floor(math.log10(expanded))
    if round(expanded, place) >= 10.0 ** (2 - place):  # 0.0996 rounds to 0.10: one place less
        place -= 1
    texts = (f'{round(x, place) + 0.0:.{max(place, 0)}f}' for x in (value, expanded))
    return minus(next(texts)), next(texts)


def label_text(value: str, limit: int = 40) -> str:
    """Make a text from a file printable for a figure, with at most `limit` characters."""
    clean = ''.join(c if c.isprintable() else ' ' for c in value).strip()
    return clean if len(clean) <= limit else f'{clean[: limit - 1]}…'
