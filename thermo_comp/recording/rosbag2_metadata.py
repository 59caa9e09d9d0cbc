# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns rosbag2's metadata.yaml: written as ROS 2 Jazzy does it (version 9).

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from .definitions import offered_qos

_VERSION = 9


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """
    One topic of a finished file.

    """

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
    The content of metadata.yaml below its only key.

    Parameters
    ----------
    summary : FileSummary
    custom : mapping of str to str
        Kept as ``custom_data``.

    Returns
    -------
    dict

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
    """
    The text of metadata.yaml.

    """
    return dump_yaml({'rosbag2_bagfile_information': information(summary, custom)})


def dump_yaml(content: Any) -> str:
    """
    YAML in block style with the keys in their order.

    """
    text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=10_000)
    return text
