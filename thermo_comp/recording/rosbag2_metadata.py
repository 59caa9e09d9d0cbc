# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns rosbag2's metadata.yaml: written as ROS 2 Jazzy does it (version 9), any version read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Literal

import yaml

from ..errors import RecordingError
from ..files import read_bounded
from ..plain_yaml import PlainYamlError, load_plain_yaml
from .definitions import offered_qos

_VERSION = 9
_MAX_BYTES = 1 << 24
_COMPRESSIONS: dict[str, Literal['', 'file', 'message']] = {
    'none': '',
    'file': 'file',
    'message': 'message',
}


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a finished file."""

    name: str
    type: str
    type_hash: str
    n_messages: int


@dataclass(frozen=True, slots=True)
class FileSummary:
    """
    What stands in a finished MCAP file.

    Attributes
    ----------
    name : str
        The file's name without directories.
    start_ns, end_ns : int
        First and last log time; 0 and 0 without messages.
    topics : tuple of TopicSummary

    """

    name: str
    start_ns: int
    end_ns: int
    topics: tuple[TopicSummary, ...]


def information(summary: FileSummary, custom: Mapping[str, str]) -> dict[str, Any]:
    """
    Build the content of metadata.yaml below its only key.

    Parameters
    ----------
    summary : FileSummary
        What the file holds.
    custom : mapping of str to str
        Kept as ``custom_data``.

    """
    n_messages = sum(topic.n_messages for topic in summary.topics)
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
                    'name': topic.name,
                    'type': topic.type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': [offered_qos(topic.type)],
                    'type_description_hash': topic.type_hash,
                },
                'message_count': topic.n_messages,
            }
            for topic in summary.topics
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

    Attributes
    ----------
    storage : str
        E.g. ``mcap``.
    files : tuple of Path
        In their order, each directly in the bag's directory.
    compression : {'', 'file', 'message'}
        What rosbag2 itself has compressed one by one.
    custom : dict of str to str
    counts : dict of str to int
        Messages per topic, as the recorder counted them.

    """

    storage: str
    files: tuple[Path, ...]
    compression: Literal['', 'file', 'message']
    custom: dict[str, str]
    counts: dict[str, int]


def read_metadata(directory: Path) -> Description | None:
    """
    Read the metadata.yaml of a bag.

    Returns
    -------
    Description or None
        None where the file is missing or empty: the recorder was killed.

    Raises
    ------
    RecordingError
        A file that is no metadata of a bag, or names files that are not there.

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
