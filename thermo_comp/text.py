# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the safe printing of texts from files and networks, and the plural of counted nouns."""

import os
import sys

# Longest serial of a unit [characters]: serials appear in file names, parameter files and tables.
LONGEST_SERIAL = 64


def counted(n: int, noun: str) -> str:
    """Return a number with its noun, as in ``1 window`` and ``2 windows``."""
    return f'{n} {noun}{"s" * (n != 1)}'


def one_line(text: str) -> str:
    """Return a text as one printable line; control characters become escape sequences."""
    if text.isprintable():
        return text
    return ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def hold_standard_streams() -> None:
    """Open closed standard streams, so that no other file gets their descriptors 0 to 2."""
    for number, name in enumerate(('stdin', 'stdout', 'stderr')):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            os.dup2(descriptor, number)
            if descriptor > 2:
                os.close(descriptor)
            setattr(sys, name, os.fdopen(number, 'r' if number == 0 else 'w'))


def keep_standard_output() -> None:
    """
    Give `sys.stdout` a descriptor of its own; redirect descriptor 1 to standard error.

    Fast DDS prints its errors to descriptor 1, where they would precede the JSON of a command.
    """
    sys.stdout.flush()
    results = os.dup(1)
    os.dup2(2, 1)
    sys.stdout = os.fdopen(
        results, 'w', 1 if os.isatty(results) else -1, sys.stdout.encoding, sys.stdout.errors
    )


def valid_serial(serial: str) -> str:
    """Return a serial if it is one printable line of limited length, else raise ValueError."""
    if not serial or len(serial) > LONGEST_SERIAL or not serial.isprintable():
        shown = one_line(serial[:LONGEST_SERIAL])
        raise ValueError(
            f'`serial` must be one printable line of 1 to {LONGEST_SERIAL} characters, '
            f"got {len(serial)} characters: '{shown}'"
        )
    return serial
