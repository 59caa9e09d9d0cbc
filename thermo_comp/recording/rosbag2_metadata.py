# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a rosbag2 bag says beside its messages: metadata.yaml, type definitions, QoS profiles.

Written as ROS 2 Jazzy does it (version 9); any version is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any, Literal

import yaml

from ..errors import RecordingError
from ..files import read_bounded
from ..plain_yaml import PlainYamlError, load_plain_yaml
from .topics import BOOL

_VERSION = 9
_MAX_BYTES = 1 << 24
_COMPRESSIONS: dict[str, Literal['', 'file', 'message']] = {
    'none': '',
    'file': 'file',
    'message': 'message',
}


_INFINITE = {'sec': 9223372036, 'nsec': 854775807}


@dataclass(frozen=True, slots=True)
class Definition:
    """
    A message type's definition with all that it depends on.

    `encoding` is ``ros2msg`` or ``ros2idl``; `type_hash` the REP 2016 hash (RIHS01), empty where
    it is not known.
    """

    encoding: str
    text: str
    type_hash: str


@lru_cache(maxsize=1)
def typestore() -> Any:
    """Give the message types of ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=64)
def known_definition(kind: str) -> Definition:
    """Look up a message type of ROS 2 Jazzy; RecordingError for one that it does not have."""
    store = typestore()
    if kind not in store.fielddefs:
        raise RecordingError(f'the definition of message type {kind} is not known')
    text, _ = store.generate_msgdef(kind, ros_version=2)
    return Definition('ros2msg', text, store.hash_rihs01(kind))


def offered_qos(kind: str) -> dict[str, Any]:
    """
    Give the QoS profile that is recorded as offered, in the form of metadata version 9.

    Reliable, so that any reader matches; flags (std_msgs/Bool) are transient local with depth 1: a
    late reader gets the last one.
    """
    is_flag = kind == BOOL
    return {
        'history': 'keep_last',
        'depth': 1 if is_flag else 10,
        'reliability': 'reliable',
        'durability': 'transient_local' if is_flag else 'volatile',
        'deadline': dict(_INFINITE),
        'lifespan': dict(_INFINITE),
        'liveliness': 'automatic',
        'liveliness_lease_duration': dict(_INFINITE),
        'avoid_ros_namespace_conventions': False,
    }


@dataclass(frozen=True, slots=True)
class FileSummary:
    """
    What stands in a finished MCAP file; first and last log time are 0 without messages.

    Of each topic there are name, type, hash of the type and number of messages.
    """

    name: str
    start_ns: int
    end_ns: int
    topics: tuple[tuple[str, str, str, int], ...]


def information(summary: FileSummary, custom: Mapping[str, str]) -> dict[str, Any]:
    """Build the content of metadata.yaml below its only key."""
    n_messages = sum(count for *_, count in summary.topics)
    start = {'nanoseconds_since_epoch': summary.start_ns}
    duration = {'nanoseconds': summary.end_ns - summary.start_ns}
    return {
        'version': _VERSION,
        'storage_identifier': 'mcap',
        'duration': duration,
        'starting_time': start,
        'message_count': n_messages,
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': name,
                    'type': kind,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': [offered_qos(kind)],
                    'type_description_hash': type_hash,
                },
                'message_count': count,
            }
            for name, kind, type_hash, count in summary.topics
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [summary.name],
        'files': [
            {
                'path': summary.name,
                'starting_time': dict(start),
                'duration': dict(duration),
                'message_count': n_messages,
            }
        ],
        'custom_data': dict(custom) or None,
        'ros_distro': 'jazzy',
    }


def dump_metadata(summary: FileSummary, custom: Mapping[str, str]) -> str:
    """Write the text of metadata.yaml."""
    return dump_yaml({'rosbag2_bagfile_information': information(summary, custom)})


def dump_yaml(content: Any) -> str:
    """Write YAML in block style with the keys in their order."""
    text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=10_000)
    return text


@dataclass(frozen=True, slots=True)
class Description:
    """
    What the reader needs of a metadata.yaml.

    `files` are in their order, each directly in the bag's directory; `compression` is what rosbag2
    itself has compressed one by one; `counts` are messages per topic, as the recorder counted
    them.
    """

    storage: str
    files: tuple[Path, ...]
    compression: Literal['', 'file', 'message'] = ''
    custom: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)


def read_metadata(directory: Path) -> Description | None:
    """
    Read the metadata.yaml of a bag; None where it is missing or empty: the recorder was killed.

    Raises RecordingError for what is no metadata of a bag, or names files that are not there.
    """
    path = directory / 'metadata.yaml'
    try:
        text = read_bounded(path, _MAX_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordingError(f'cannot be read: {error.strerror}', path) from error
    except ValueError as error:
        raise RecordingError(f'cannot be read: {error}', path) from error
    if not text.strip():
        return None
    try:
        content = load_plain_yaml(text, node_limit=_MAX_BYTES)['rosbag2_bagfile_information']
        files = tuple(directory / PurePath(str(name)).name for name in _names(content))
        description = Description(
            storage=str(content['storage_identifier']),
            files=files,
            compression=_COMPRESSIONS[str(content.get('compression_mode') or 'none').lower()],
            custom={str(k): str(v) for k, v in (content.get('custom_data') or {}).items()},
            counts=_counts(content),
        )
    except PlainYamlError as error:
        raise RecordingError('not valid YAML', path) from error
    except (KeyError, TypeError, AttributeError) as error:
        raise RecordingError('not the metadata of a rosbag2 bag', path) from error
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise RecordingError(f'the file {missing[0]} of the bag is missing', directory)
    return description


def _names(content: Any) -> list[Any]:
    names = content['relative_file_paths']
    if not isinstance(names, list) or not names:
        raise TypeError('no files')
    return names


def _counts(content: Any) -> dict[str, int]:
    counts: dict[str, int] = {}
    for one in content.get('topics_with_message_count') or ():
        name = str(one['topic_metadata']['name'])
        counts[name] = counts.get(name, 0) + int(one['message_count'])
    return counts
