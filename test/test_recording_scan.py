# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A scan of a chunk, with or without an index, finds the same messages as a plain loop."""

import struct

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from thermo_comp.recording.chunks import locate, scan_records

MESSAGE, CHANNEL = 5, 4


def message(channel, log_ns, content):
    body = struct.pack('<HIQQ', channel, 0, log_ns, log_ns) + content
    return struct.pack('<BQ', MESSAGE, len(body)) + body


def other(content):
    return struct.pack('<BQ', CHANNEL, len(content)) + content


def one_by_one(data):
    """Scan in a loop; return (place, size, channel, log time) of messages, other records, end."""
    at, messages, others = 0, [], []
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from('<BQ', data, at)
        if opcode == 0 or at + 9 + length > len(data) or (opcode == MESSAGE and length < 22):
            break
        if opcode == MESSAGE:
            channel, _, log_ns, _ = struct.unpack_from('<HIQQ', data, at + 9)
            messages.append((at, length - 22, channel, log_ns))
        else:
            others.append(data[at + 9 : at + 9 + length])
        at += 9 + length
    return messages, others, at


def listed(messages):
    columns = (messages.start - 31, messages.size, messages.channel, messages.log_ns)
    return list(zip(*(column.tolist() for column in columns), strict=True))


#: Contents of messages that look like records.
DECEITFUL = [
    b'\x05' * 40, message(1, 5, b'\x05' * 9), (message(1, 7, b'') * 3)[:40],
    struct.pack('<BQ', MESSAGE, 22 + 40) * 4, bytes(40),
]  # fmt: skip


@st.composite
def records(draw):
    pieces = []
    for _ in range(draw(st.integers(1, 6))):
        content = draw(st.sampled_from(DECEITFUL) | st.binary(max_size=60))
        pattern = [
            message(draw(st.integers(0, 9)), draw(st.integers(0, 2**63 - 1)), content),
            message(draw(st.integers(0, 9)), 3, draw(st.binary(max_size=8))),
        ]
        if draw(st.booleans()):
            pattern.append(other(draw(st.binary(max_size=20))))
        for _ in range(draw(st.sampled_from([1, 3, 60]))):
            pieces += draw(st.permutations(pattern)) if draw(st.booleans()) else pattern
    return b''.join(pieces)


def index_of(entries):
    pieces = []
    for channel in sorted({entry[2] for entry in entries}):
        rows = b''.join(
            struct.pack('<QQ', log_ns, at) for at, _, own, log_ns in entries if own == channel
        )
        pieces.append(struct.pack('<BQHI', 7, len(rows) + 6, channel, len(rows)) + rows)
    return b''.join(pieces)


@settings(max_examples=120, deadline=None)
@given(data=records(), cut=st.integers(0, 200), tail=st.binary(max_size=30), drawn=st.data())
def test_a_scan_with_a_right_or_false_index_equals_a_plain_loop(data, cut, tail, drawn):
    """WHY: an index that points into the content of a message could give false samples."""
    torn = data[: len(data) - cut] + tail
    wanted, wanted_others, wanted_end = one_by_one(torn)
    if all(log_ns < 2**63 for _, _, _, log_ns in wanted):
        others = []
        messages, reason = scan_records(
            np.frombuffer(torn, np.uint8), lambda _, content: others.append(content)
        )
        # If zeros follow a message, its end may be lost, too, so the scan leaves it out.
        is_wiped = len(torn) >= wanted_end + 9 and torn[wanted_end] == 0
        assert listed(messages) == (wanted[:-1] if is_wiped else wanted)
        assert others == wanted_others
        assert (reason == '') == (wanted_end == len(torn))
    wanted, wanted_others, _ = one_by_one(data)
    places = drawn.draw(
        st.lists(st.integers(0, len(data)) | st.sampled_from([e[0] for e in wanted]), max_size=20)
    )
    kept = drawn.draw(st.sampled_from([wanted, wanted[:-1], wanted[1:], []]))
    index = index_of([*kept, *((at, 0, 1, 0) for at in places)])
    others = []
    messages = locate(
        np.frombuffer(data, np.uint8), memoryview(index), lambda _, content: others.append(content)
    )
    assert listed(messages) == wanted
    assert others == wanted_others
