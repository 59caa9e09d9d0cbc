# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fast path: the MCAP files of a bag to blocks, chunk by chunk, in bounded memory.

Reading order within a file is log time and, for equal log times, the place in the file: what a
ROS player gives. It needs the time spans in the heads of the chunks to be true, which is checked.
A file with messages outside chunks has no such spans: it is read in the order of the file.
"""

from __future__ import annotations

from collections import ChainMap, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import TypeVar, cast

import numpy as np

from ..errors import RecordingError
from ..typing import Ints
from .chunks import Messages, Span, join_messages, load, pack
from .columns import Block, RawMessages, RecordingInfo, Role, count_topics
from .decode import Decoder, Feed
from .mcap_file import McapFile, translated
from .topics import shown
from .unpack import DamagedError
from .wire import Encoding

_Done = TypeVar('_Done')
_N_LOADERS = 2
#: Chunks under way: what two threads read and decode while the caller works on one block.
_N_AHEAD = 8
_AHEAD_BYTES = 1 << 26
#: Messages of overlapping chunks that are held back at most [bytes].
_MAX_HELD_BYTES = 1 << 26
#: Places in one chunk are below this, so a chunk's number times it plus a place is unique.
_PLACES = 1 << 32


class McapSource:
    """
    The MCAP files of one bag, in the order in which they follow each other.

    `metadata` are key-value pairs that stand beside them, `note` what is missing beside them.
    Raises RecordingError for a file that is no MCAP file or damaged.
    """

    def __init__(
        self,
        files: Sequence[Path],
        metadata: Mapping[str, str] | None = None,
        note: str | None = None,
    ) -> None:
        self._is_closed = False
        self._pool = ThreadPoolExecutor(_N_LOADERS, 'recording')
        self._files: list[McapFile] = []
        try:
            for path in files:
                self._files.append(McapFile(path))
        except BaseException:
            self.close()
            raise
        self.definitions: Mapping[str, tuple[str, str]] = {
            kind: text for file in self._files for kind, text in file.definitions.items()
        }
        notes = [note] if note else []
        for file in self._files:
            if file.truncated is not None:
                name = f'{file.path.name}: ' if len(self._files) > 1 else ''
                notes.append(name + file.truncated)
        channels = (
            (topic.name, topic.type, file.counts[number])
            for file in self._files
            for number, topic in file.topics.items()
        )
        self.info = RecordingInfo(
            files[0],
            'mcap',
            count_topics(channels),
            min((f.start_ns for f in self._files if f.start_ns is not None), default=0),
            max((f.end_ns for f in self._files if f.end_ns is not None), default=0),
            '; '.join(notes) or None,
            dict(ChainMap(*(file.metadata for file in self._files[::-1]), dict(metadata or {}))),
        )

    def blocks(
        self, selection: Mapping[Role, str], names: Collection[str], *, raw: bool
    ) -> Iterator[Block]:
        """Read the topic of each role, in reading order."""
        if self._is_closed:
            raise RecordingError('the recording is closed', self._files[0].path)
        for file in self._files:
            with translated(file.path):
                decoder = _decoder(file, selection, names, raw)
                if decoder is not None:
                    yield from self._read(file, decoder)

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """Read topics as they are, in the order of the file."""
        for file in self._files:
            own = {n: one for n, one in file.topics.items() if one.name in topics}
            with translated(file.path):
                for topic in own.values():
                    if topic.encoding != 'cdr':
                        raise RecordingError(_no_cdr(topic.encoding), topic=shown(topic.name))
                for span in file.spans:
                    messages = load(file.handle, span, _ignore)
                    for number, topic in own.items():
                        one = messages.take(np.flatnonzero(messages.channel == number))
                        if len(one):
                            packed = pack(one.data, one.start, one.size)
                            yield RawMessages(topic.name, topic.type, one.log_ns, *packed)

    def close(self) -> None:
        """Close the files."""
        if not self._is_closed:
            self._is_closed = True
            self._pool.shutdown(wait=True, cancel_futures=True)
            for file in self._files:
                file.close()

    def _read(self, file: McapFile, decoder: Decoder) -> Iterator[Block]:
        if any(span.kind == 'loose' for span in file.spans):
            for span in file.spans:
                messages = load(file.handle, span, _ignore)
                yield from decoder.blocks(messages if span.kind == 'loose' else _sorted(messages))
            return
        order = sorted(range(len(file.spans)), key=lambda row: (file.spans[row].start_ns, row))
        spans = [file.spans[row] for row in order]
        if any(
            file.spans[later].start_ns < file.spans[earlier].end_ns or later < earlier
            for earlier, later in pairwise(order)
        ):
            loaded = self._ahead(spans, lambda span: _chosen(file, decoder, span))
            following = [*(span.start_ns for span in spans[1:]), None]
            for messages in _in_log_order(zip(order, loaded, following, strict=True)):
                yield from decoder.blocks(messages)
        else:
            for blocks in self._ahead(spans, lambda span: _decoded(file, decoder, span)):
                yield from blocks

    def _ahead(self, spans: Sequence[Span], work: Callable[[Span], _Done]) -> Iterator[_Done]:
        """
        Read, decompress and decode ahead in threads; most of it needs no interpreter lock.

        What one thread has decompressed it decodes, too: then the bytes are in its processor's
        cache. The pool belongs to the source, not to this generator: one that is given up is
        closed by the garbage collector, anywhere, where waiting for a thread may be a deadlock.
        """
        waiting: deque[tuple[int, Future[_Done]]] = deque()
        try:
            for span in spans:
                while waiting and (
                    len(waiting) == _N_AHEAD
                    or sum(n_bytes for n_bytes, _ in waiting) + span.size > _AHEAD_BYTES
                ):
                    yield waiting.popleft()[1].result()
                waiting.append((span.size, self._pool.submit(work, span)))
            while waiting:
                yield waiting.popleft()[1].result()
        finally:
            for _, future in waiting:
                future.cancel()


def _chosen(file: McapFile, decoder: Decoder, span: Span) -> Messages:
    return decoder.chosen(load(file.handle, span, _ignore)).packed()


def _decoded(file: McapFile, decoder: Decoder, span: Span) -> list[Block]:
    return list(decoder.blocks(_sorted(load(file.handle, span, _ignore))))


def _sorted(messages: Messages) -> Messages:
    """Put messages in order of log time and, for equal ones, of their places."""
    log_ns = messages.log_ns
    if (log_ns[1:] >= log_ns[:-1]).all():
        return messages
    return messages.take(np.argsort(log_ns, kind='stable'))


def _in_log_order(pieces: Iterable[tuple[int, Messages, int | None]]) -> Iterator[Messages]:
    """
    Merge chunks that overlap, given with their numbers and the first log time of what follows.

    Once the next one begins at time t, whatever was read before t is final. So only the messages
    of chunks that overlap at one instant are ever held back.
    """
    held: list[tuple[Ints, Messages]] = []
    for row, piece, next_ns in pieces:
        held.append((row * _PLACES + piece.start, piece))
        if sum(len(messages.data) for _, messages in held) > _MAX_HELD_BYTES:
            raise DamagedError(
                'too many of its chunks overlap in time to be read in bounded memory; '
                'sort it by time with another tool'
            )
        if next_ns is not None and not any((m.log_ns < next_ns).any() for _, m in held):
            continue
        place = np.concatenate([one for one, _ in held])
        messages = join_messages([m for _, m in held])
        order = np.lexsort((place, messages.log_ns))
        messages = messages.take(order)
        n_done = len(order)
        if next_ns is not None:
            n_done = int(np.searchsorted(messages.log_ns, next_ns))
        yield messages.take(slice(0, n_done))
        held = [(place[order][n_done:], messages.take(slice(n_done, None)).packed())]


def _decoder(
    file: McapFile, selection: Mapping[Role, str], names: Collection[str], raw: bool
) -> Decoder | None:
    """Prepare to read a file; None where it has none of the topics."""
    roles = {topic: role for role, topic in selection.items()}
    channels: dict[int, Role] = {}
    feeds: dict[Role, Feed] = {}
    for number, topic in file.topics.items():
        role = roles.get(topic.name)
        if role is None:
            continue
        if topic.encoding not in {'cdr', 'ros1'}:
            raise RecordingError(_no_cdr(topic.encoding), topic=shown(topic.name))
        feed = Feed(topic.name, topic.type, cast(Encoding, topic.encoding))
        if feeds.setdefault(role, feed) != feed:
            raise RecordingError('its messages have several encodings', topic=shown(topic.name))
        channels[number] = role
    return Decoder(feeds, channels, names, raw) if channels else None


def _no_cdr(encoding: str) -> str:
    return f'its messages are encoded as {shown(encoding)!r}, expected cdr'


def _ignore(opcode: int, content: bytes) -> None:
    """Pass over a record; those that matter were read when the file was opened."""
