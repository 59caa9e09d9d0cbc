# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns bags: recordings to columns and columns to recordings, streaming, in bounded memory.

The only package that knows `rosbags` and `mcap`.
"""

from __future__ import annotations

from .columns import ROLES, Block, ImuColumns, Input, Messages, Recording, RecordingInfo, Role
from .reader import RecordingReader, inspect_recording, open_recording, read_recording
from .topics import Part, Topics
from .writer import STAMP_END_NS, BagWriter

__all__ = [
    'ROLES',
    'STAMP_END_NS',
    'BagWriter',
    'Block',
    'ImuColumns',
    'Input',
    'Messages',
    'Part',
    'Recording',
    'RecordingInfo',
    'RecordingReader',
    'Role',
    'Topics',
    'inspect_recording',
    'open_recording',
    'read_recording',
]
