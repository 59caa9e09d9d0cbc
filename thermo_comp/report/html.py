# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way into HTML: templates that escape every text, because others wrote it, and the policy
by which the page can neither run nor load anything.
"""

from __future__ import annotations

import datetime as dt
import math
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from ..text import counted
from ..unit.gravity import MICRO_G
from .text import label_text, minus, number, spelt

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
# What stands in the margin of a printed page has no more letters.
_LONGEST_MARGIN = 90


def render(template: str, *, script: str = '', nonce: str = '', **context: Any) -> str:
    """
    Fill a template that extends ``page.html``; `title` at least.

    A viewer's page has a script, and a nonce by which the policy lets this one run.
    """
    policy = _POLICY
    if script:
        policy += f"; script-src 'nonce-{nonce}'; connect-src 'self'"
    found = _templates().get_template(template)
    return found.render(
        {'margin': '', 'is_simulated': False}
        | context
        | {'policy': Markup(policy), 'script': Markup(script), 'nonce': nonce}  # noqa: S704 - our own
    )


@cache
def _templates() -> Environment:
    made = Environment(
        loader=FileSystemLoader(Path(__file__).with_name('templates')),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        'number': number,
        'cell': _cell,
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


def _cell(value: object) -> str:
    if value is None:
        return '–'
    return number(value) if isinstance(value, float) else str(value)


def utc(stamp_ns: int) -> dt.datetime:
    """Give a stamp as a date with time, in UTC."""
    return dt.datetime.fromtimestamp(stamp_ns // 10**9, dt.timezone.utc)


def _css_text(value: str) -> Markup:
    """Write a text as a string of a style sheet: all but letters and digits by their numbers."""
    said = ''.join(
        c if c.isalnum() and c.isascii() else f'\\{ord(c):06x}'
        for c in label_text(value, _LONGEST_MARGIN)
    )
    return Markup(f'"{said}"')  # noqa: S704 - nothing of it is markup any more
