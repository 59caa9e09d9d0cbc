# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the style of pages and figures. The content policy of a page forbids scripts and external
files. Lines of a figure differ in dashes and in colours (from the palette of Okabe and Ito).
"""

import datetime as dt
import io
import math
import re
from contextlib import AbstractContextManager
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler

from .. import __version__
from ..text import counted
from ..typing import Floats, Ints
from ..unit.gravity import MICRO_G
from .evidence import CHOSEN, RAW

Line = dict[str, Any]

BLACK, BLUE, RED, GREEN, GREY = '#000000', '#0072B2', '#D55E00', '#007A5A', '#8A8A8A'
_DASHED, _DOTTED = (0, (5, 2)), (0, (1.2, 1.6))

#: Colours and dashes of x, y, z for `set_prop_cycle`, so that one plot call draws all three.
AXIS_CYCLE = cycler(
    color=(BLUE, RED, GREEN), linestyle=('-', _DASHED, _DOTTED), linewidth=(1.1, 1.1, 1.5)
)
AXIS_LINES: tuple[Line, ...] = tuple(AXIS_CYCLE)
CORRECTION_LINES: dict[str, Line] = {
    RAW: {'color': GREY, 'linestyle': '-', 'linewidth': 0.9},
    CHOSEN: {'color': BLACK, 'linestyle': '-', 'linewidth': 1.3},
}
BOARD_LINE: Line = {'color': BLACK, 'linestyle': '-', 'linewidth': 1.4}
CASE_LINE: Line = {'color': RED, 'linestyle': _DASHED, 'linewidth': 1.2}
STATIC_LINE: Line = {'color': BLUE, 'linestyle': '-', 'linewidth': 1.4}
DYNAMIC_LINE: Line = {'color': RED, 'linestyle': _DASHED, 'linewidth': 1.4}

_RC: dict[str, Any] = {
    'font.sans-serif': ['DejaVu Sans', 'Verdana', 'Helvetica', 'Arial', 'sans-serif'],
    'font.size': 8.5,
    'axes.titlesize': 8.5,
    'axes.titlelocation': 'left',
    'axes.linewidth': 0.7,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.grid': True,
    'axes.axisbelow': True,
    'xtick.labelsize': 8,
    'ytick.labelsize': 8,
    'grid.color': '#DDDDDD',
    'grid.linewidth': 0.5,
    'legend.frameon': False,
    'legend.handlelength': 2.8,
    'legend.borderaxespad': 0.0,
    'legend.borderpad': 0.0,
    'hatch.linewidth': 0.5,
    # Names in figures come from files: a dollar sign must not start a formula.
    'text.parse_math': False,
    'svg.fonttype': 'none',
    'svg.hashsalt': 'thermo_comp',
    # Simplify lines: drop vertices within half a pixel of the line.
    'path.simplify_threshold': 0.5,
}
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
# Largest number of characters in the margin of a printed page.
_LONGEST_MARGIN = 90
_PNG_DPI = 160
_WIDTH = 7.1  # width of a figure and of the text of a printed page [in]


def drawing() -> AbstractContextManager[None]:
    """Return a context in which matplotlib uses the report's style, not the user's settings."""
    return style.context(_RC, after_reset=True)


def new_figure(height: float) -> Figure:
    """Return an empty figure as wide as a printed page, `height` inches high."""
    return Figure(figsize=(_WIDTH, height), layout='constrained')


def svg(figure: Figure, name: str, label: str) -> str:
    """Return a figure as an SVG element with id prefix `name` and ARIA label `label`."""
    buffer = io.StringIO()
    nothing = {'Date': None, 'Creator': None, 'Format': None, 'Type': None}
    figure.savefig(buffer, format='svg', metadata=nothing)
    text = re.sub(r'>\s+<', '><', buffer.getvalue().replace('xlink:', ''))
    text = re.sub(r'\b(id="|href="#|url\(#)', rf'\g<1>{name}-', text)
    # Coordinates with two decimals, a hundredth of a point, keep the file small.
    text = re.sub(r' d="[^"]*"', lambda path: re.sub(r'(\.\d\d)\d+|\n', r'\1', path[0]), text)
    about = f'role="img" aria-label="{escape(label)}"'
    return text[text.index('<svg') :].replace('<svg', f'<svg {about}', 1).strip()


def png(figure: Figure) -> bytes:
    """Return a figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=_PNG_DPI, metadata={'Software': None})
    return buffer.getvalue()


def time_unit(duration_s: float) -> tuple[float, str]:
    """Return the unit of a time axis: length of the unit [s], and label of the axis."""
    if duration_s >= 2.5 * 3600.0:
        return 3600.0, 'time, h'
    if duration_s >= 300.0:
        return 60.0, 'time, min'
    return 1.0, 'time, s'


def broken(time: Floats, value: Floats, position: Ints) -> tuple[Floats, Floats]:
    """Insert NaN into a series of windows at each change of position and each pause."""
    if len(time) < 2:
        return time, value
    steps = np.diff(time)
    gap = (np.diff(position) != 0) | (steps > 5.0 * np.median(steps))
    at = np.flatnonzero(gap) + 1
    return np.insert(time, at, time[at - 1]), np.insert(value, at, np.nan, axis=0)


def legend_above(axes: Axes, title: str | None = None) -> None:
    """Put the legend above axes, in as many columns as fit."""
    if labels := axes.get_legend_handles_labels()[1]:
        # Width of a legend entry: its label, and a handle as wide as eight letters.
        n = min(max(1, int(100 / (8 + max(map(len, labels))))), len(labels))
        look: Line = {'ncols': n, 'title': title, 'alignment': 'left'}
        axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.01), **look)


def shared_legend(figure: Figure, axes: Axes, n_columns: int) -> None:
    """Put the common legend of a figure's panels above the figure."""
    handles, labels = axes.get_legend_handles_labels()
    place: Any = 'outside upper left'
    figure.legend(handles, labels, loc=place, borderaxespad=0.5, ncols=n_columns)


def render(template: str, **context: Any) -> str:
    """Fill a template that extends ``page.html``."""
    now = f'{dt.datetime.now(dt.timezone.utc):%Y-%m-%d %H:%M}'
    known = {'margin': '', 'is_simulated': False, 'now': now, 'version': __version__, **context}
    return _templates().get_template(template).render(known, policy=_POLICY)


def caption(figure: str, *data: Any) -> tuple[str, str]:
    """Return the question that a figure of `data` answers, and how to read the figure."""
    macro = getattr(_templates().get_template('captions.html').module, figure)
    question, _, reading = macro(*data).unescape().strip().partition('\n')
    return question, ' '.join(reading.split())


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
        'label': label_text,
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
    """Format a number with `digits` significant digits, but with at most `digits` decimals."""
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
    """Round an uncertainty to two digits ('–': unknown), and the value to the same place."""
    if not 0.0 < expanded < math.inf:
        return number(value, 6), '–'
    place = 1 - math.floor(math.log10(expanded))
    if round(expanded, place) >= 10.0 ** (2 - place):  # 0.0996 rounds to 0.100: print 0.10
        place -= 1
    texts = (f'{round(x, place) + 0.0:.{max(place, 0)}f}' for x in (value, expanded))
    return minus(next(texts)), next(texts)


def label_text(value: str, limit: int = 40) -> str:
    """Make a text from a file printable for a figure, with at most `limit` characters."""
    clean = ''.join(c if c.isprintable() else ' ' for c in value).strip()
    return clean if len(clean) <= limit else f'{clean[: limit - 1]}…'
