# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the additions to the pages of the site during its build: the options of all commands."""

from __future__ import annotations

import re
from typing import Any

import typer
from typer.cli import get_docs_for_click

from thermo_comp.cli.app import app


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Append the options of every command to the page of the command line."""
    if page.file.src_uri != 'cli.md':
        return markdown
    command = typer.main.get_command(app)
    text = get_docs_for_click(obj=command, ctx=typer.Context(command), name='thermo_comp')
    # Drop the text before the first command: the page of the command line has it already.
    commands = text[text.index('\n## ') :]
    return markdown + re.sub(
        r'^Examples?:\n((?: +.*\n)+)', r'Example:\n\n```sh\n\1```\n', commands, flags=re.MULTILINE
    )
