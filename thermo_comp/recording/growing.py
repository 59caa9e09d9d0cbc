# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns live recording: reads a bag that another program is writing, and writes numbered bags.

Each pass reads the growing bag from its beginning; the pause after a pass is at least five times
as long as the pass. New messages are written with the node's topic names to numbered bags, from
`01.mcap` on. New messages are held in memory until it is known to which position they belong.
"""

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..errors import OutputError, RecordingError
from ..files import MCAP, check_output
from ..topics import COUNTS, IMU_IN, TEMPERATURE, thermometer
from .blocks import Block, RecordingInfo, Role
from .reader import open_recording
from .topics import Topics
from .writer import BagWriter

_CHUNK_BYTES = 1 << 17  # chunk size [bytes]; a killed process loses up to 17 s of counts at 100 Hz
_PERIOD_S = 1.0  # shortest pause between two passes over the growing bag [s]
_NEVER_NS = 2**63 - 1
#: Hidden name of an unfinished bag: number of the bag, and id of the process that writes the bag.
_LEFT = re.compile(r'\.(?P<number>\d+)\.(?P<process>\d+)-[0-9a-f]+\.partial\.mcap')
_SHARE = 0.2  # largest ratio of the duration of a pass over the bag to the pause after the pass

#: A block of new messages, also serialized, and the description of its bag (live topics: None).
News = tuple[Block, RecordingInfo | None]


def growing_blocks(
    path: Path, topics: Topics, wait: Callable[[float], bool]
) -> Iterator[News | None]:
    """Yield new blocks, and None after each pass, until the bag ends or `wait(s)` returns True."""
    if not path.exists():
        raise RecordingError('no such file or directory', path)
    n_seen: Counter[Role] = Counter()
    size = 0
    while True:
        began = time.monotonic()
        try:
            reader = open_recording(path, topics, require=())
        except RecordingError:
            # A recorder creates a file before it writes: wait while the file is empty or grows.
            files = path.iterdir() if path.is_dir() else [path]
            before, size = size, sum(file.stat().st_size for file in files)
            if n_seen or 0 < size == before:
                raise
            is_whole = False
        else:
            with reader:
                n_read: Counter[Role] = Counter()
                for block in reader.blocks(raw=True):
                    n_new = {role: len(log_ns) for role, log_ns in block.log_ns.items()}
                    is_new = {
                        role: n_read[role] + np.arange(n) >= n_seen[role]
                        for role, n in n_new.items()
                    }
                    n_read.update(n_new)
                    yield block.take(is_new), reader.info
                n_seen = n_read
                is_whole = reader.info.truncated is None and bool(n_seen)
        yield None
        if is_whole or wait(max(_PERIOD_S, (time.monotonic() - began) / _SHARE)):
            return


def numbered_bags(folder: Path) -> list[Path]:
    """List the bags of a folder that are named by a number, in the order of the numbers."""
    bags = {int(path.stem): path for path in folder.glob('*.mcap') if path.stem.isdecimal()}
    return [bags[number] for number in sorted(bags)]


def leftovers(folder: Path) -> dict[Path, int]:
    """List the unfinished bags left by crashed runs, with their numbers."""
    unfinished: dict[Path, int] = {}
    for path in sorted(folder.glob('.*.partial.mcap')):
        named = _LEFT.fullmatch(path.name)
        if named and not Path(f'/proc/{named["process"]}').exists():
            unfinished[path] = int(named['number'])
    return unfinished


def finish(path: Path, number: int) -> Path | None:
    """
    Move the messages of an unfinished bag to the bag `number` or, if that bag exists, to the
    largest number + 1. Return the new bag, None without messages; RecordingError for damage.
    """
    with open_recording(path, require=()) as reader:
        numbers = {int(bag.stem) for bag in numbered_bags(path.parent)}
        number = max(numbers) + 1 if number in numbers else number
        bags = PositionBags(path.parent, None, number)
        try:
            for block in reader.blocks(raw=True):
                bags.add(block, reader.info)
                bags.release(_NEVER_NS)
        finally:
            bags.close()
    path.unlink()
    return bags.written[0] if bags.written else None


class PositionBags:
    """Writes one bag per position; a bag gets its number when its first message is written."""

    def __init__(self, folder: Path, serial: str | None, number: int | None = None) -> None:
        self._folder, self._serial = folder, serial
        last = max((int(bag.stem) for bag in numbered_bags(folder)), default=0)
        self._number = number or last + 1
        check_output(folder / f'{self._number:02d}.mcap', MCAP)
        self._writer: BagWriter | None = None
        self._held: list[Block] = []
        self.written: list[Path] = []  # files of the bags begun so far

    def add(self, block: Block, info: RecordingInfo | None) -> None:
        """Hold a block with its serialized messages; `info` describes the bag of the block."""
        if info is not None and self._serial is None:
            self._serial = info.metadata.get('serial')
        self._held.append(block)

    def release(self, stamp_ns: int) -> None:
        """Write the held messages before the first message stamped `stamp_ns` or later."""
        held, self._held = self._held, []
        try:
            for block in held:
                is_late = {
                    role: np.maximum.accumulate(stamps >= stamp_ns)
                    for role, stamps in block.stamp_ns.items()
                }
                self._write(block.take({role: ~late for role, late in is_late.items()}))
                if any(late.any() for late in is_late.values()):
                    self._held.append(block.take(is_late))
            if self._writer is not None:
                self._writer.flush()
        except OutputError:
            self._writer, self._held = None, []  # after a failed write, write no further message
            raise

    def _write(self, block: Block) -> None:
        if not block.n_messages:
            return
        if self._writer is None:
            path = self._folder / f'{self._number:02d}.mcap'
            facts = {} if self._serial is None else {'serial': self._serial}
            self._writer = BagWriter(
                path, metadata=facts, chunk_bytes=_CHUNK_BYTES, is_precious=True
            )
            self.written.append(path)
            self._number += 1
        accel = COUNTS if block.imu is None else IMU_IN
        for role, messages in block.raw.items():
            topic = accel.name if role == 'accel' else thermometer(role)
            kind = accel.type if role == 'accel' else TEMPERATURE
            if len(messages):
                self._writer.write_raw(topic, kind, messages.log_ns, messages)

    def close(self, before_ns: int = _NEVER_NS) -> None:
        """Write the held messages stamped before `before_ns`, by default all; close the bag."""
        self.release(before_ns)
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
