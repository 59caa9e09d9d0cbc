# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reader of recordings: opens a bag of any storage, describes it, reads it as columns.

Messages are read in the order of a ROS player: by log time, and in file order if log times are
equal. The files of a split bag are read in the order in its metadata.yaml.
"""

import re
from collections import ChainMap, Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from ..errors import RecordingError
from ..files import read_bounded
from ..plain_yaml import PlainYamlError, load_plain_yaml
from .blocks import (
    NO_STAMP_NS,
    ROLES,
    BagFile,
    Block,
    Recording,
    RecordingInfo,
    Role,
    Topic,
    clocks_apart,
    gathered,
    joined,
    with_stamps,
    without_jumps,
)
from .chunks import MAX_CHUNK_BYTES, expand, inflate, inflate_ros1_chunk, translated
from .fields import Field, definitions_of
from .mcap_file import McapFile
from .serialized import Messages
from .topics import WHOLE, Selected, Topics, select_topics, shown
from .wire import decode_blocks

_MAX_BYTES = 1 << 24  # largest size of metadata.yaml [bytes], and its largest number of YAML nodes
#: What is compressed (file, message, or nothing), by the `compression_mode` of metadata.yaml.
_COMPRESSIONS = {'none': '', 'file': 'file', 'message': 'message'}
#: Largest batch that is decoded at a time from a `ForeignFile`: messages, bytes, time [ns].
_BATCH_MESSAGES, _BATCH_BYTES, _BATCH_NS = 1 << 14, 1 << 23, 10 * 10**9


class RecordingReader(ExitStack):
    """
    An open bag: a rosbag2 directory, a bare ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``.
    A role is ``accel`` or the name of a thermometer; the bag must have topics for the roles in
    `require`. After all blocks are read, `info.truncated` names the missing messages. The keys of
    `topics` and `fields` are roles; `definitions` has encoding and text of each message type.
    Raises RecordingError if the file is not a bag, is damaged, or a topic is missing or ambiguous.
    """

    def __init__(
        self, path: str | Path, topics: Topics | None = None, *, require: Collection[Role] = ROLES
    ) -> None:
        super().__init__()
        path, topics = Path(path), topics or Topics()
        self._files: list[McapFile | ForeignFile] = []
        self.callback(self._files.clear)
        try:
            self.info = self._open(path)
            self.definitions = {k: d for file in self._files for k, d in file.definitions.items()}
            with translated(path):
                selected = select_topics(self.info.topics, topics, require, self.info.metadata)
                self.topics: Mapping[Role, str] = selected.topics
                self.fields = dict(self._fields(selected))
            bare = ', '.join(role for role, field in self.fields.items() if not field.header)
            note = f'readings of {bare} have no stamp: each gets the stamp of the sample before it'
            chosen = _notes(selected.chosen, note if bare else '')
            self.info = replace(self.info, input=selected.input, chosen=chosen)
        except BaseException as error:
            self.close()
            if isinstance(error, OSError):
                raise RecordingError(f'cannot be opened: {error.strerror}', path) from error
            raise
        self._part = topics.part
        self.since_s = 0.0  # time from the bag's first sample to the first sample read [s]
        self.apart = ''  # warning about equal stamps, or about two clocks (`clocks_apart`)

    def _fields(self, selected: Selected) -> Iterator[tuple[Role, Field]]:
        for role, path in selected.fields.items():
            topic = selected.topics[role]
            kind = self.info.topics[topic][0]
            try:
                yield role, Field(kind, path, definitions_of(kind, self.definitions))
            except RecordingError as error:
                raise RecordingError(error.message, key=shown(f'{topic}:{path}')) from error

    def _open(self, path: Path) -> RecordingInfo:
        """Open the files; first expand files that rosbag2 has compressed as a whole."""
        described = _described(path)
        folder = ''
        if described.compression == 'file':
            folder = self.enter_context(TemporaryDirectory(prefix='thermo_comp-'))
        notes = [described.note]
        is_packed = described.compression == 'message'
        for name in described.files:
            file = name
            if folder:
                file = Path(folder, name.stem)
                with translated(name):
                    notes.append(expand(name, file))
            is_foreign = described.storage != 'mcap' or is_packed
            opened = ForeignFile(file, name, is_packed) if is_foreign else McapFile(file, name)
            self.callback(opened.close)
            self._files.append(opened)
            if opened.truncated is not None:
                front = f'{name.name}: ' if len(described.files) > 1 else ''
                notes.append(front + opened.truncated)
        kinds: dict[str, dict[str, None]] = {}  # the types of each topic, without repetitions
        counts: Counter[str] = Counter()
        for topic in (topic for file in self._files for topic in file.topics.values()):
            kinds.setdefault(topic.name, {})[topic.type] = None
            counts[topic.name] += topic.n_messages
        topics = {name: (' | '.join(types), counts[name]) for name, types in kinds.items()}
        notes += [_loss(name, counts[name], n) for name, n in described.counts.items()]
        start_ns = min((f.start_ns for f in self._files if f.start_ns is not None), default=0)
        end_ns = max((f.end_ns for f in self._files if f.end_ns is not None), default=0)
        metadata = dict(ChainMap(*(f.metadata for f in self._files[::-1]), described.custom))
        storage, missing = self._files[0].storage, _notes(*notes)
        return RecordingInfo(path, storage, topics, start_ns, end_ns, missing, metadata)

    def blocks(self, *, raw: bool = False) -> Iterator[Block]:
        """Read the selected part of the bag (`Topics.part`), in blocks."""
        return self._cut(self._blocks(raw))

    def _blocks(self, raw: bool = False) -> Iterator[Block]:
        def decoded() -> Iterator[Block]:
            for path, topics, messages in self._read(set(self.topics.values()), {'cdr', 'ros1'}):
                channels = {
                    role: {number: topic for number, topic in topics.items() if topic.name == name}
                    for role, name in self.topics.items()
                }
                with translated(path):
                    blocks = decode_blocks(messages, channels, self.fields, keep_raw=raw)
                yield from blocks

        n_read = dict.fromkeys(self.topics, 0)
        last_ns = NO_STAMP_NS
        for each in gathered(decoded()):
            block, last_ns = with_stamps(each, last_ns)
            self.apart = self.apart or clocks_apart(block)
            for role in n_read:
                n_read[role] += len(block.log_ns[role])
            if block.n_messages:
                yield block
        info = replace(self.info, chosen=_notes(self.info.chosen, self.apart))
        for role, topic in self.topics.items():
            loss = _loss(topic, n_read[role], info.topics[topic][1])
            if loss and loss not in (info.truncated or ''):
                info = replace(info, truncated=_notes(info.truncated, loss))
        self.info = info

    def raw(self, topics: Collection[str]) -> Iterator[tuple[Topic, Messages]]:
        """Read serialized messages of topics, named as in the bag, in batches of one topic."""
        for _, channels, messages in self._read(topics, {'cdr'}):
            for number, topic in channels.items():
                if len(batch := messages.of_channels([number])):
                    yield topic, batch.packed()

    def _read(
        self, names: Collection[str], encodings: Collection[str]
    ) -> Iterator[tuple[Path, Mapping[int, Topic], Messages]]:
        """Read serialized messages of topics: yield path, channels and messages of each file."""
        if not self._files:
            raise RecordingError('the recording is closed', self.info.path)
        for file in self._files:
            channels = {k: topic for k, topic in file.topics.items() if topic.name in names}
            for topic in channels.values():
                if topic.encoding not in encodings:
                    reason = f'its messages are encoded as {shown(topic.encoding)!r}, expected cdr'
                    raise RecordingError(reason, file.path, shown(topic.name))
            with translated(file.path, is_foreign=isinstance(file, ForeignFile)):
                for messages in file.read(channels) if channels else ():
                    yield file.path, channels, messages

    def blocks_on_one_clock(self) -> Iterator[Block]:
        """Read the bag; a jump of the stamps by over an hour becomes a gap of an hour."""
        if self._part.is_stamped:
            return without_jumps(self.blocks(), self.info.path)
        return self._cut(without_jumps(self._blocks(), self.info.path))

    def _cut(self, blocks: Iterator[Block]) -> Iterator[Block]:
        """Drop messages outside the selected part; RecordingError if no sample is left."""
        if self._part == WHOLE:
            yield from blocks
            return
        first_ns: float = inf
        last_ns = n_kept = 0
        for block in blocks:
            if len(block):
                first_ns = int(block.accel_stamp_ns[0]) if first_ns == inf else first_ns
                last_ns = int(block.accel_stamp_ns[-1])
            begin, end = self._part.limits_ns(first_ns)
            is_in = {role: (ns >= begin) & (ns < end) for role, ns in block.stamp_ns.items()}
            left = block.take(is_in)
            if len(left) and not n_kept:
                self.since_s = (int(left.accel_stamp_ns[0]) - first_ns) * 1e-9
            n_kept += len(left)
            if left.n_messages:
                yield left
        if not n_kept and first_ns < inf:
            raise RecordingError(
                f'no sample is in {self._part} (--from, --to): the samples are stamped from '
                f'{first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s, which is '
                f'{(last_ns - first_ns) * 1e-9:.1f} s',
                self.info.path,
            )


open_recording = RecordingReader


def read_recording(
    path: str | Path, topics: Topics | None = None, *, require: Collection[Role] = ROLES
) -> Recording:
    """Read a whole bag into memory; raises as `open_recording` does, also for damaged data."""
    with open_recording(path, topics, require=require) as reader:
        blocks = list(reader.blocks()) or decode_blocks(Messages.of([], [], []), {}, {})
        return Recording(reader.info, joined(blocks))


def inspect_recording(path: str | Path) -> RecordingInfo:
    """Describe a bag without reading its messages; raises as `open_recording` does."""
    with open_recording(path, require=()) as reader:
        return reader.info


@dataclass(frozen=True, slots=True)
class _Description:
    """Files of a bag, compression, `counts` of messages by topic, `note` on missing parts."""

    storage: str
    files: tuple[Path, ...]
    compression: str = ''
    custom: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    note: str | None = None


def _described(path: Path) -> _Description:
    """Find the files of a bag; RecordingError if the path is not a bag."""
    if not path.exists():
        raise RecordingError('no such file or directory', path)
    if path.is_dir():
        described = _read_metadata(path)
        if described is not None:
            return described
        for suffix in ('.mcap', '.db3'):
            files = [file for file in path.iterdir() if file.suffix == suffix and file.is_file()]
            if files:
                if len({re.sub(r'_[0-9]+$', '', file.stem) for file in files}) > 1:
                    raise RecordingError(
                        f'a folder of several bags: name its {len(files)} *{suffix} files', path
                    )
                note = 'metadata.yaml is missing, the recording was not finished'
                return _Description(suffix[1:], tuple(sorted(files, key=_place_of)), note=note)
        raise RecordingError('not a bag: the directory has no metadata.yaml', path)
    if not path.is_file():
        raise RecordingError('not a bag: neither a file nor a directory', path)
    if path.suffix not in {'.mcap', '.db3', '.bag'}:
        raise RecordingError(
            'not a bag: expected a directory, .mcap, .db3 or .bag; `thermo_comp convert` makes a '
            'bag of a table or log',
            path,
        )
    return _Description(path.suffix[1:], (path,))


def _read_metadata(directory: Path) -> _Description | None:
    """Read a bag's metadata.yaml; None if the file is missing or empty (recorder killed)."""
    path = directory / 'metadata.yaml'
    try:
        text = read_bounded(path, _MAX_BYTES)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        reason = getattr(error, 'strerror', None) or error
        raise RecordingError(f'cannot be read: {reason}', path) from error
    if not text.strip():
        return None
    try:
        content = load_plain_yaml(text, node_limit=_MAX_BYTES)['rosbag2_bagfile_information']
        names = content['relative_file_paths']
        if not isinstance(names, list) or not names:
            raise TypeError('no files')
        files = tuple(directory / PurePath(str(name)).name for name in names)
        counts: Counter[str] = Counter()
        for entry in content.get('topics_with_message_count') or ():
            counts[str(entry['topic_metadata']['name'])] += int(entry['message_count'])
        description = _Description(
            storage=str(content['storage_identifier']),
            files=files,
            compression=_COMPRESSIONS[str(content.get('compression_mode') or 'none').lower()],
            custom={str(k): str(v) for k, v in (content.get('custom_data') or {}).items()},
            counts=counts,
        )
    except PlainYamlError as error:
        raise RecordingError('not valid YAML', path) from error
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise RecordingError('not the metadata of a rosbag2 bag', path) from error
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise RecordingError(f'the file {missing[0]} of the bag is missing', directory)
    return description


def _place_of(file: Path) -> tuple[int, str]:
    """Return the sort key of a file of a split bag: number at the end of its name, its name."""
    number = re.search(r'_([0-9]+)$', file.stem)
    return (int(number[1]) if number else 0, file.name)


def _notes(*notes: str | None) -> str | None:
    return '; '.join(filter(None, notes)) or None


def _loss(topic: str, n_read: int, n_promised: int) -> str:
    text = f'{shown(topic)}: {n_read} of {n_promised} listed messages are in the bag'
    return text if n_read < n_promised else ''


class ForeignFile(BagFile):
    """A file read by `rosbags`: SQLite, ROS 1, or MCAP with compressed messages (`is_packed`)."""

    def __init__(self, path: Path, name: Path, is_packed: bool) -> None:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        super().__init__(name)
        self._is_packed = is_packed
        is_ros1 = path.suffix == '.bag'
        encoding = 'ros1' if is_ros1 else 'cdr'
        self.storage = {'.bag': 'ros1', '.mcap': 'mcap'}.get(path.suffix, 'sqlite3')
        with translated(name, is_foreign=True):
            reader: Any = Reader1(path) if is_ros1 else Reader2(path)
            self._reader, self.close = reader, reader.close
            reader.open()
            for at, chunk in reader.chunks.items() if is_ros1 else ():
                reader.chunks[at] = chunk._replace(decompressor=inflate_ros1_chunk)
            if reader.message_count:
                self.start_ns = int(reader.start_time)
                self.end_ns = int(reader.end_time) - 1
            for number, link in enumerate(reader.connections):
                # Columns of an SQLite database have no fixed type: a name may be a number.
                if not (isinstance(link.topic, str) and isinstance(link.msgtype, str)):
                    raise RecordingError('a topic has no name or no type')
                self.topics[number] = Topic(link.topic, link.msgtype, encoding, link.msgcount)
                if link.msgdef.data and not is_ros1:
                    kind = f'ros2{link.msgdef.format.name.lower()}'
                    self.definitions[link.msgtype] = kind, link.msgdef.data

    def read(self, channels: Collection[int]) -> Iterator[Messages]:
        """Read the messages of some channels (connections of `rosbags`), sorted by log time."""
        chosen = [self._reader.connections[number] for number in channels]
        known = {(link.topic, link.msgtype): n for n, link in zip(channels, chosen, strict=True)}
        batch: list[tuple[bytes, int, int]] = []
        n_bytes = 0
        for channel, log_ns, packed in self._reader.messages(connections=chosen):
            data = packed
            if self._is_packed:
                data = inflate('zstd', packed, MAX_CHUNK_BYTES).tobytes()
            batch.append((data, known[channel.topic, channel.msgtype], log_ns))
            n_bytes += len(data)
            is_long = n_bytes >= _BATCH_BYTES or log_ns - batch[0][2] > _BATCH_NS
            if is_long or len(batch) >= _BATCH_MESSAGES:
                yield Messages.of(*zip(*batch, strict=True))
                batch, n_bytes = [], 0
        if batch:
            yield Messages.of(*zip(*batch, strict=True))
