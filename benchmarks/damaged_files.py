# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Damages the file of a bag: flips bits, wipes or cuts off parts, removes rows, makes a zip bomb.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

import zstandard


def damaged(
    make: Callable[[Path], Path], pattern: str, damage: Callable[[Path], object]
) -> Callable[[Path], Path]:
    """Return a function that makes a bag and damages the bag's only file that fits `pattern`."""

    def made(folder: Path) -> Path:
        bag = make(folder)
        (file,) = bag.glob(pattern) if bag.is_dir() else [bag]
        damage(file)
        return bag

    return made


def flip(file: Path, place: float = 0.5) -> None:
    """Flip a bit of the byte at (length of the file) * `place`."""
    data = bytearray(file.read_bytes())
    data[int(len(data) * place)] ^= 4
    file.write_bytes(data)


def wipe(file: Path) -> None:
    """Overwrite 4096 bytes in the middle of a file by zeros."""
    data = bytearray(file.read_bytes())
    half = len(data) // 2
    data[half : half + 4096] = bytes(4096)
    file.write_bytes(data)


def cut(file: Path) -> None:
    """Keep only the first half of a file."""
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])


def delete_rows(file: Path) -> None:
    """Delete the rows 100 to 265 of the table of messages of a .db3 file."""
    with sqlite3.connect(file) as database:
        database.execute('delete from messages where id between 100 and 265')


def flip_message(file: Path) -> None:
    """Change the topic number of all messages of topic 1 to 65, which no topic has."""
    with sqlite3.connect(file) as database:
        database.execute('update messages set topic_id = topic_id + 64 where topic_id = 1')


def bomb(file: Path) -> None:
    """Replace a file by 8 GB of zeros, which zstd compresses to some hundred kB."""
    with file.open('wb') as out, zstandard.ZstdCompressor(19).stream_writer(out) as packed:
        for _ in range(1 << 13):
            packed.write(bytes(1 << 20))
