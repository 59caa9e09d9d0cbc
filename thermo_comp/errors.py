# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the exceptions for errors that a user can cause and correct, with one-line messages.

The exceptions are raised for files and bags that cannot be used, and for data that do not suffice
for a fit. A wrong argument of a numeric function is a plain `ValueError`. The command line prints
`str(error)` and nothing else.
"""

from pathlib import Path

from .text import one_line


class ThermoCompError(Exception):
    """An error that a user can correct; its text is one line: file, key, message."""

    # `rule` is the message without any content of the file, for a client without permission to
    # read the file.
    def __init__(
        self,
        message: str,
        path: str | Path | None = None,
        key: str | None = None,
        rule: str | None = None,
    ) -> None:
        self.message, self.key, self.rule = message, key, rule
        self.path = None if path is None else str(path)
        # The error text may contain control characters from a file, a bag or the network.
        super().__init__(one_line(': '.join(part for part in (self.path, key, message) if part)))


class CalibrationError(ThermoCompError):
    """A calibration that cannot be used, with the file and the dotted path of the wrong key."""


class RecordingError(ThermoCompError):
    """A recording that cannot be read or written, with the file and the topic or column."""


class OutputError(ThermoCompError):
    """An output file that may not or cannot be written, with the file's name."""


class FitError(ThermoCompError):
    """Data that do not suffice for a fit, or that contradict an option of the fit."""


class UndeterminedError(FitError):
    """Data that do not determine all parameters, so that an estimate is outside its range."""
