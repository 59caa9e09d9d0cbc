# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fast path: the MCAP files of a bag to parts, chunk by chunk, in bounded memory.

Reading order within a file is log time and, for equal log times, the place in the file: what a
ROS player gives. It needs the time spans in the heads of the chunks to be true, which is checked.
A file with messages outside chunks, or with chunks above 64 MiB, has no such index of times: it
is read in the order of the file, each ordinary chunk sorted by log time.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np

from ..errors import RecordingError
from ..typing import Bytes
from .assemble import Part
from .chunk import Windows, load_chunk, load_run
from .columns import RawMessages, Role
from .decode import Decoder, Feed, pack
from .mcap_records import ChunkSpan, DamagedError
from .random_access import LocalFile, OpenFile, RandomAccess
from .survey import Survey
from .sweep import in_log_order
from .topics import shown
from .walk import MESSAGE_HEAD_BYTES, Messages
from .wire import Encoding

_N_LOADERS = 2
#: Pieces under way: what two threads read and decode while the caller works on one block.
_N_AHEAD = 8
_AHEAD_BYTES = 1 << 26
_GROUP_BYTES = 1 << 20
#: Places of one chunk are below this, so a chunk's number times it plus a place is unique.
_PLACES = 1 << 32


class McapSource:
    """
    The MCAP files of one bag.

    Parameters
    ----------
    files : sequence of Path
        In the order in which they follow each other.
    metadata : mapping of str to str, optional
        Key-value pairs that stand beside the files.
    note : str or None, optional
        What is missing beside the files.
    open_file : callable, optional
        Opens each where it lies.

    Raises
    ------
    RecordingError
        A file that is no MCAP file or damaged.

    """

    storage = 'mcap'

    def __init__(
        self,
        files: Sequence[Path],
        metadata: Mapping[str, str] | None = None,
        note: str | None = None,
        open_file: OpenFile = LocalFile,
    ) -> None:
        self._is_closed = False
        self._pool = ThreadPoolExecutor(_N_LOADERS, 'recording')
        self._surveys: list[Survey] = []
        try:
            for file in files:
                self._surveys.append(Survey(file, open_file))
        except BaseException:
            self.close()
            raise
        surveys = self._surveys
        counts: Counter[str] = Counter()
        types: dict[str, list[str]] = {}
        for survey in surveys:
            for number, channel in survey.channels.items():
                counts[channel.topic] += survey.counts[number]
                known = types.setdefault(channel.topic, [])
                if channel.type not in known:
                    known.append(channel.type)
        self.topics: Mapping[str, tuple[str, int]] = {
            topic: (' | '.join(known), counts[topic]) for topic, known in types.items()
        }
        self.definitions: Mapping[str, tuple[str, str]] = {
            schema.name: (schema.encoding, schema.text)
            for survey in surveys
            for schema in survey.schemas.values()
            if schema.text
        }
        self.start_ns = min((s.start_ns for s in surveys if s.start_ns is not None), default=0)
        self.end_ns = max((s.end_ns for s in surveys if s.end_ns is not None), default=0)
        self.metadata: Mapping[str, str] = {
            key: value
            for pairs in (metadata or {}, *(survey.metadata for survey in surveys))
            for key, value in pairs.items()
        }
        notes = [note] if note else []
        for survey in surveys:
            if survey.truncated is not None:
                name = f'{survey.path.name}: ' if len(surveys) > 1 else ''
                notes.append(name + survey.truncated)
        self.truncated: str | None = '; '.join(notes) or None

    def parts(self, selection: dict[Role, str], *, raw: bool) -> Iterator[Part]:
        """
        Read the chosen topics.

        Parameters
        ----------
        selection : dict of role to str
            Topic per role.
        raw : bool
            Keep the serialized messages too.

        Yields
        ------
        Part
            With ranks that go on from part to part.

        Raises
        ------
        RecordingError
            Damaged data.

        """
        n_ranks = 0
        if self._is_closed:
            raise RecordingError('the recording is closed', self._surveys[0].path)
        for survey in self._surveys:
            with _translated(survey.path):
                for part in _read(self._pool, survey, selection, raw):
                    last = n_ranks
                    for rows in part.values():
                        rows.rank = rows.rank + n_ranks
                        last = max(last, int(rows.rank[-1]) + 1)
                    n_ranks = last
                    yield part

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """
        Read topics as they are, in the order of the file.

        Raises
        ------
        RecordingError
            Damaged data, or messages that are no CDR.

        """
        for survey in self._surveys:
            own = {n: one for n, one in survey.channels.items() if one.topic in topics}
            with _translated(survey.path):
                for channel in own.values():
                    if channel.encoding != 'cdr':
                        raise RecordingError(_no_cdr(channel.encoding), topic=shown(channel.topic))
                for data, messages, _ in _stretches(survey):
                    for number, channel in own.items():
                        rows = np.flatnonzero(messages.channel == number)
                        if len(rows):
                            start = messages.at[rows] + MESSAGE_HEAD_BYTES
                            packed = pack(data, start, messages.size[rows])
                            log_ns = messages.log_ns[rows]
                            yield RawMessages(channel.topic, channel.type, log_ns, *packed)

    def close(self) -> None:
        """Close the files."""
        if not self._is_closed:
            self._is_closed = True
            self._pool.shutdown(wait=True, cancel_futures=True)
            for survey in self._surveys:
                survey.close()


def _read(
    pool: ThreadPoolExecutor, survey: Survey, selection: dict[Role, str], raw: bool
) -> Iterator[Part]:
    decoder = _decoder(survey, selection, raw)
    if decoder is None:
        return
    chunks = [span for span in survey.spans if isinstance(span, ChunkSpan)]
    if len(chunks) < len(survey.spans):
        yield from _in_file_order(survey, decoder)
        return
    order = sorted(range(len(chunks)), key=lambda row: (chunks[row].start_ns, row))
    is_overlapping = any(
        chunks[later].start_ns < chunks[earlier].end_ns or later < earlier
        for earlier, later in pairwise(order)
    )
    ordered = [chunks[row] for row in order]
    if is_overlapping:
        jobs = [_Job([span], row * _PLACES) for span, row in zip(ordered, order, strict=True)]
        following = [*(span.start_ns for span in ordered[1:]), None]
        parts = _decoded(pool, survey.handle, decoder, jobs)
        yield from in_log_order(zip(parts, following, strict=True))
    else:
        jobs = [_Job(group, None) for group in _grouped(ordered)]
        yield from filter(None, _decoded(pool, survey.handle, decoder, jobs))


@dataclass(frozen=True, slots=True)
class _Job:
    """Chunks that are read as one, and their place as `Decoder.part` takes it."""

    spans: list[ChunkSpan]
    place: int | None

    @property
    def size(self) -> int:
        return sum(span.size for span in self.spans)


def _grouped(spans: Sequence[ChunkSpan]) -> list[list[ChunkSpan]]:
    """Put small chunks together: array passes and threads are for many messages at a time."""
    groups: list[list[ChunkSpan]] = []
    size = _GROUP_BYTES
    for span in spans:
        if size + span.size > _GROUP_BYTES:
            groups.append([])
            size = 0
        groups[-1].append(span)
        size += span.size
    return groups


def _decoder(survey: Survey, selection: dict[Role, str], raw: bool) -> Decoder | None:
    roles_by_topic = {topic: role for role, topic in selection.items()}
    roles: dict[int, Role] = {}
    feeds: dict[Role, Feed] = {}
    for number, channel in survey.channels.items():
        role = roles_by_topic.get(channel.topic)
        if role is None:
            continue
        if channel.encoding not in {'cdr', 'ros1'}:
            raise RecordingError(_no_cdr(channel.encoding), topic=shown(channel.topic))
        feed = Feed(channel.topic, channel.type, cast(Encoding, channel.encoding))
        if feeds.setdefault(role, feed) != feed:
            raise RecordingError('its messages have several encodings', topic=shown(channel.topic))
        roles[number] = role
    return Decoder(feeds, roles, raw) if roles else None


def _no_cdr(encoding: str) -> str:
    return f'its messages are encoded as {shown(encoding)!r}, expected cdr'


def _in_file_order(survey: Survey, decoder: Decoder) -> Iterator[Part]:
    yield from filter(None, (decoder.part(*stretch) for stretch in _stretches(survey)))


def _stretches(survey: Survey) -> Iterator[tuple[Bytes, Messages, int | None]]:
    """Read a file stretch by stretch, each with its place as `Decoder.part` takes it."""
    for span in survey.spans:
        if isinstance(span, ChunkSpan):
            yield *load_chunk(survey.handle, span, _ignore), None
        else:
            for data, messages in Windows(survey.handle, span, _ignore):
                yield data, messages, 0


def _decoded(
    pool: ThreadPoolExecutor, handle: RandomAccess, decoder: Decoder, jobs: Sequence[_Job]
) -> Iterator[Part]:
    """
    Read, decompress and decode ahead in threads; most of what they do needs no interpreter lock.

    What one thread has decompressed it decodes, too: then the bytes are in its processor's cache.
    The pool belongs to the source, not to this generator: a generator that is given up is closed
    by the garbage collector, anywhere, where waiting for a thread may be a deadlock.
    """
    waiting: deque[tuple[int, Future[Part]]] = deque()
    n_ahead = 0
    following = iter(jobs)
    upcoming = next(following, None)
    try:
        while waiting or upcoming is not None:
            while upcoming is not None:
                size = upcoming.size
                if waiting and (len(waiting) == _N_AHEAD or n_ahead + size > _AHEAD_BYTES):
                    break
                waiting.append((size, pool.submit(_decode, handle, decoder, upcoming)))
                n_ahead += size
                upcoming = next(following, None)
            size, future = waiting.popleft()
            n_ahead -= size
            yield future.result()
    finally:
        for _, future in waiting:
            future.cancel()


def _decode(handle: RandomAccess, decoder: Decoder, job: _Job) -> Part:
    return decoder.part(*_load(handle, job.spans), job.place)


def _load(handle: RandomAccess, spans: list[ChunkSpan]) -> tuple[Bytes, Messages]:
    """Read chunks that follow each other in log time as if they were one."""
    joined = load_run(handle, spans, _ignore) if len(spans) > 1 else None
    if joined is not None:
        return joined
    pieces: list[tuple[Bytes, Messages]] = []
    for span in spans:
        data, messages = load_chunk(handle, span, _ignore)
        if len(messages.log_ns) and not (
            span.start_ns <= int(np.min(messages.log_ns))
            and int(np.max(messages.log_ns)) <= span.end_ns
        ):
            raise DamagedError(
                f'chunk at byte {span.position}: its messages are outside the time it claims'
            )
        pieces.append((data, messages))
    if len(pieces) == 1:
        return pieces[0]
    begins = np.cumsum([0, *(len(data) for data, _ in pieces)])
    return np.concatenate([data for data, _ in pieces]), Messages(
        np.concatenate([m.at + begin for (_, m), begin in zip(pieces, begins, strict=False)]),
        np.concatenate([m.size for _, m in pieces]),
        np.concatenate([m.channel for _, m in pieces]),
        np.concatenate([m.log_ns for _, m in pieces]),
    )


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Say which file it is that is damaged."""
    try:
        yield
    except DamagedError as error:
        raise RecordingError(f'damaged: {error}', path) from error
    except RecordingError as error:
        raise RecordingError(error.message, path, error.topic) from error
    except OSError as error:
        raise RecordingError(f'cannot be read: {error.strerror}', path) from error


def _ignore(opcode: int, content: bytes) -> None:
    """Pass over a record; the survey has read those that matter."""
