# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the table of the faults around the node and of files; each has a test of its own.

"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Told:
    """
    A fault around the node or of a file, with a test of its own.

    """

    fault: str
    injection: str
    does: str
    says: str
    test: str


_PROCESS, _FILES = 'test_fault_process.py', 'test_fault_files.py'
_BAD_FILE = (
    'the calibration that was read runs on; setting it again is refused with path and reason'
)
_CALIBRATION_FILES = f'{_PROCESS}::test_calibration_files_that_go_bad'

TOLD = [
    Told(
        'a publisher restarts',
        'all three drivers end and others begin, in the ramp',
        'goes on: the same bits as without',
        '',
        f'{_PROCESS}::test_a_publisher_restarts',
    ),
    Told(
        'the node is killed and restarts in the ramp',
        'kill -9, then a new process',
        'regime unknown, memory unsettled: larger covariance until both are known',
        'WARN or OK: `regime` unknown, `memory settled` False',
        f'{_PROCESS}::test_the_node_is_killed_and_restarts_in_the_ramp',
    ),
    *(
        Told(
            f'the calibration file is {what}',
            'while the node runs',
            _BAD_FILE,
            f'refusal: {reason}',
            _CALIBRATION_FILES,
        )
        for what, reason in (
            ("replaced by another unit's", 'unit.serial'),
            ('truncated', 'the first key or line that fails'),
            ('deleted', 'No such file or directory'),
            ('made unreadable', 'cannot be read'),
            ('1 GB', 'at most 2 MiB; not read'),
            ('a YAML alias bomb', 'aliases are not accepted; not built'),
            ('a directory', 'not a regular file'),
            ('a FIFO', 'not a regular file; never waited for'),
        )
    ),
    Told(
        'a storm of reloads',
        '1000 settings of `calibration_file`, 20 at a time, while 1 kHz flow',
        'each is answered; no sample is lost',
        '',
        f'{_PROCESS}::test_a_thousand_reloads_at_1_khz',
    ),
    *(
        Told(
            f'{name} while samples flow',
            'a signal',
            'ends with exit code 0 and says nothing',
            '',
            f'{_PROCESS}::test_a_signal_while_samples_flow',
        )
        for name in ('SIGINT', 'SIGTERM')
    ),
    Told(
        'the disk is full',
        '`fit`, `report` and `replay` onto a file system of 4 KiB',
        'exit code 1, an old output untouched, nothing left behind',
        'one line: the output, No space left on device',
        f'{_FILES}::test_a_full_disk',
    ),
    Told(
        'the output folder is read-only',
        '`fit`, `report` and `replay`',
        'exit code 1',
        'one line: the output and the reason',
        f'{_FILES}::test_a_folder_that_is_read_only',
    ),
    Told(
        'a command is killed while it writes',
        'kill -9 of `fit`, `report`, `replay` before and at the end',
        'the old output is whole; the new one lies beside it under a hidden name and can be read',
        '',
        f'{_FILES}::test_a_killed_command_leaves_the_old_file',
    ),
    Told(
        'a recording is torn',
        'cut at every byte of its last chunk, and at random places',
        'every command reads it up to its last whole message, does its work, and ends with 1',
        'one line: the bag, the byte of the cut and what it cut',
        'test_recording_damage.py::test_cut_at_every_byte_of_the_last_chunk',
    ),
]
