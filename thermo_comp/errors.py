# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the exception tree: everything the world can do wrong, said in one line.

A caller's mistake in the numeric core is a plain `ValueError`; the classes here are for what
comes from outside: files, bags, data that cannot carry a fit. The command line prints
`str(error)` and nothing else.
"""

from __future__ import annotations

from pathlib import Path

from .text import one_line


class ThermoCompError(Exception):
    """Any failure that a user can cause and mend; its text is one line: file, key, message."""

    # `rule` is for those who may not read the file, where message or key quote one that is none.
    def __init__(
        self,
        message: str,
        path: str | Path | None = None,
        key: str | None = None,
        rule: str | None = None,
    ) -> None:
        self.message, self.key, self.rule = message, key, rule
        self.path = None if path is None else str(path)
        # A file, a bag or the network may have chosen some of it.
        super().__init__(one_line(': '.join(part for part in (self.path, key, message) if part)))


class CalibrationError(ThermoCompError):
    """A calibration that cannot be used, with the file and the dotted path of the wrong key."""


class RecordingError(ThermoCompError):
    """A recording that cannot be read or written, with the file and the topic or column."""


class OutputError(ThermoCompError):
    """An output that may not or cannot be written, with its name."""


class FitError(ThermoCompError):
    """Data that cannot carry the fit asked of it: what is missing, and what to record."""
