# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a rosbag2 bag says beside its messages: metadata.yaml, type definitions, QoS profiles.

Written as ROS 2 Jazzy does it (version 9); any version is read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import yaml

from ..errors import RecordingError
from ..files import read_bounded
from ..plain_yaml import PlainYamlError, load_plain_yaml
from .topics import BOOL

_VERSION = 9
_MAX_BYTES = 1 << 24
_COMPRESSIONS = {'none': '', 'file': 'file', 'message': 'message'}
_INFINITE = {'sec': 9223372036, 'nsec': 854775807}


class Definition(NamedTuple):
    """
    A message type's definition with all that it depends on; its hash (RIHS01) empty if not known.
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
    Give the QoS profile that is recorded as offered: reliable, so that any reader matches.

    Flags (std_msgs/Bool) are transient local with depth 1: a late reader gets the last one.
    """
    is_flag = kind == BOOL
    return {
        'history': 'keep_last',
        'depth': 1 if is_flag else 10,
        'reliability': 'reliable',
        'durability': 'transient_local' if is_flag else 'volatile',
        'deadline': _INFINITE,
        'lifespan': _INFINITE,
        'liveliness': 'automatic',
        'liveliness_lease_duration': _INFINITE,
        'avoid_ros_namespace_conventions': False,
    }


def information(
    name: str,
    start_ns: int,
    end_ns: int,
    topics: Iterable[tuple[str, str, str, int]],
    custom: Mapping[str, str],
) -> dict[str, Any]:
    """Build what stands in metadata.yaml; topics are name, type, hash of the type and count."""
    counted: list[dict[str, Any]] = [
        {
            'topic_metadata': {
                'name': topic,
                'type': kind,
                'serialization_format': 'cdr',
                'offered_qos_profiles': [offered_qos(kind)],
                'type_description_hash': type_hash,
            },
            'message_count': count,
        }
        for topic, kind, type_hash, count in topics
    ]
    times = {
        'duration': {'nanoseconds': end_ns - start_ns},
        'starting_time': {'nanoseconds_since_epoch': start_ns},
        'message_count': sum(one['message_count'] for one in counted),
    }
    return {
        'version': _VERSION,
        'storage_identifier': 'mcap',
        **times,
        'topics_with_message_count': counted,
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [name],
        'files': [{'path': name, **times}],
        'custom_data': dict(custom) or None,
        'ros_distro': 'jazzy',
    }


def dump_yaml(content: Any) -> str:
    """Write YAML in block style with the keys in their order."""
    # Values that stand twice are written twice.
    dumper: Any = type('Dumper', (yaml.SafeDumper,), {'ignore_aliases': lambda *_: True})
    text: str = yaml.dump(
        content, Dumper=dumper, sort_keys=False, allow_unicode=True, width=10_000
    )
    return text


@dataclass(frozen=True, slots=True)
class Description:
    """
    What the reader needs of a metadata.yaml.

    `files` are in their order; `compression` is what rosbag2 itself has compressed one by one,
    ``file``, ``message`` or nothing; `counts` are messages per topic, as the recorder counted.
    """

    storage: str
    files: tuple[Path, ...]
    compression: str = ''
    custom: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)


def read_metadata(directory: Path) -> Description | None:
    """Read the metadata.yaml of a bag; None if it is missing or empty: the recorder was killed."""
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
        for one in content.get('topics_with_message_count') or ():
            counts[str(one['topic_metadata']['name'])] += int(one['message_count'])
        description = Description(
            storage=str(content['storage_identifier']),
            files=files,
            compression=_COMPRESSIONS[str(content.get('compression_mode') or 'none').lower()],
            custom={str(k): str(v) for k, v in (content.get('custom_data') or {}).items()},
            counts=counts,
        )
    except PlainYamlError as error:
        raise RecordingError('not valid YAML', path) from error
    except (KeyError, TypeError, AttributeError) as error:
        raise RecordingError('not the metadata of a rosbag2 bag', path) from error
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise RecordingError(f'the file {missing[0]} of the bag is missing', directory)
    return description
