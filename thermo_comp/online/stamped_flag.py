# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the regime flag with its stamp, as the bytes that node and replay both write."""

from __future__ import annotations

from struct import pack

STAMPED_TOPIC = 'regime/stamped'
STAMPED_TYPE = 'diagnostic_msgs/msg/DiagnosticArray'

_ENCAPSULATION = b'\0\1\0\0'


def stamped_flag(stamp_ns: int, is_dynamic: bool, serial: str) -> bytes:
    """Serialize a DiagnosticArray of one status, stamped as the reading which decided."""
    status = b''
    for text in ('regime', 'dynamic' if is_dynamic else 'static', serial):
        # The level is one byte, and a length stands at a multiple of four.
        status += bytes(-(1 + len(status)) % 4) + pack('<I', len(text.encode()) + 1)
        status += text.encode() + b'\0'
    status += bytes(-(1 + len(status)) % 4) + pack('<I', 0)  # no key and value
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    # An empty frame_id with its NUL, padding, one status, its level.
    head = pack('<iII4xIb', sec, nanosec, 1, 1, 0)
    return _ENCAPSULATION + head + status
