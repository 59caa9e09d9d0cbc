# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the parts of a page that needs nothing else: the document, its tables, its figures.

What comes from a bag or a calibration is text that somebody else wrote: it passes through
`html.escape` on its way into the page, and the page's own policy forbids it to run or load
anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from .plates import DrawnPlate

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
# A table of at most so many rows is not torn apart in print.
_SHORT = 16
_STYLE = Path(__file__).with_name('page.css')


def document(title: str, parts: Sequence[str], *, script: str = '', nonce: str = '') -> str:
    """
    Put a page together.

    Parameters
    ----------
    title : str
        Its title; escaped here.
    parts : sequence of str
        HTML, in order; empty ones are left out.
    script : str, optional
        Script of the viewer that serves the page; a page in a file has none.
    nonce : str, optional
        Makes the page's policy let this one script run, and talk to its server.

    Returns
    -------
    str
        The HTML document.

    """
    policy = _POLICY
    if script:
        policy += f"; script-src 'nonce-{nonce}'; connect-src 'self'"
    lines = [
        '<!DOCTYPE html>',
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<title>{escape(title)}</title>',
        f'<style>{_STYLE.read_text(encoding="utf-8")}</style></head><body>',
        *parts,
        f'<script nonce="{nonce}">{script}</script>' if script else '',
        '</body></html>\n',
    ]
    return '\n'.join(line for line in lines if line)


def table(
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    texts: int = 1,
    caption: str = '',
    chosen: Sequence[bool] = (),
    links: Sequence[str] = (),
) -> str:
    """
    Write a table whose first `texts` columns are text and whose others are numbers.

    Parameters
    ----------
    headings : sequence of str
        The columns.
    rows : sequence of sequence of str
        The cells.
    texts : int, optional
        Columns of text.
    caption : str, optional
        A note above it.
    chosen : sequence of bool, optional
        Rows in bold.
    links : sequence of str, optional
        Where the first cell of each row leads; empty for nowhere.

    Returns
    -------
    str
        The element; everything in it is escaped.

    """

    def cells(row: Sequence[str], tag: str, link: str = '') -> str:
        said = [escape(cell) for cell in row]
        if link:
            said[0] = f'<a href="{escape(link)}">{said[0]}</a>'
        return ''.join(
            f'<{tag}{"" if i < texts else " class=number"}>{cell}</{tag}>'
            for i, cell in enumerate(said)
        )

    body = ''.join(
        f'<tr{" class=chosen" if i < len(chosen) and chosen[i] else ""}>'
        f'{cells(row, "td", links[i] if i < len(links) else "")}</tr>'
        for i, row in enumerate(rows)
    )
    kind = 'scroll short' if len(rows) <= _SHORT else 'scroll'
    note = f'<p class="note">{escape(caption)}</p>' if caption else ''
    return (
        f'{note}<div class="{kind}"><table><thead><tr>{cells(headings, "th")}</tr></thead>'
        f'<tbody>{body}</tbody></table></div>'
    )


def figure(plate: DrawnPlate) -> str:
    """Write a figure with its caption, for paper and for a phone."""
    return (
        f'<figure id="figure-{plate.number}"><div class="wide">{plate.wide}</div>'
        f'<div class="narrow">{plate.narrow}</div>'
        f'<figcaption><strong>{plate.number}. {escape(plate.question)}</strong> '
        f'{escape(plate.reading)}</figcaption></figure>'
    )
