# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the table of the faults around the node and of files; each has a test of its own."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Told:
    """A fault around the node or of a file, with a test of its own."""

    fault: str
    injection: str
    does: str
    says: str
    test: str


_OUTPUTS, _TEXT = 'test_files.py', 'test_text.py'
_PROMISES = 'test_recording_promises.py'
_PROCESS, _FILES = 'test_fault_process.py', 'test_fault_files.py'
_BAD_FILE = (
    'the calibration that was read runs on; setting it again is refused with path and reason'
)
_CALIBRATION_FILES = f'{_PROCESS}::test_calibration_files_that_go_bad'
_DEFENCE, _RELOAD = 'test_node_defence.py', 'test_node_reload.py'
_SOURCES = 'test_node_sources.py'

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
            ('1 GB', 'at most 8 MiB; not read'),
            ('a YAML alias bomb', 'aliases are not accepted; not built'),
            ('a directory', 'not a regular file'),
            ('a FIFO', 'not a regular file; never waited for'),
        )
    ),
    Told(
        'the calibration file is a list of a million empty lists',
        'while the node runs',
        _BAD_FILE,
        'refusal: more than 20000 keys and values; not built',
        f'{_DEFENCE}::test_nothing_of_a_file_that_is_no_calibration_is_told',
    ),
    Told(
        'the calibration file is something else, `/etc/shadow`, say',
        'a request over the network',
        'refused; with `calibration_directory` nothing outside of it is opened, through no link',
        'refusal: the path as given and the rule, nothing of the content',
        f'{_DEFENCE}::test_nothing_of_a_file_that_is_no_calibration_is_told',
    ),
    Told(
        'a request that nobody foresaw',
        'values of no type, unknown users, names and texts of 10 MB, control characters',
        'each is answered, samples go on',
        'refusal: the rule',
        f'{_DEFENCE}::test_any_request_is_answered_and_samples_go_on',
    ),
    Told(
        'a question of 100 000 names',
        'to each service that tells of parameters',
        'answered as one of unknown names; samples go on',
        '',
        f'{_DEFENCE}::test_questions_of_any_length_are_answered',
    ),
    Told(
        'an environment that ROS cannot use',
        'ROS_DOMAIN_ID is no number, the log folder cannot be made, a parameter of another type',
        'exit code 1',
        'one line: what ROS says of it',
        'test_node_startup.py::test_an_environment_that_ros_cannot_use',
    ),
    Told(
        'the node is started with closed streams',
        'no stdin, stdout, stderr',
        'runs, and ends by a signal with exit code 0',
        '',
        'test_node_startup.py::test_closed_streams_are_no_signal',
    ),
    Told(
        'a callback fails',
        'an exception in a timer, a service, the relay itself',
        'samples go on',
        'ERROR "callbacks failed, see the log"; the log has all its lines',
        f'{_DEFENCE}::test_a_callback_that_fails_is_logged_counted_and_survived',
    ),
    Told(
        'the launch file is given a parameter file',
        'and no argument, or some',
        'what was given as an argument counts, everything else stands as the file says',
        '',
        'test_launch.py::test_a_parameter_is_set_only_where_its_argument_was_given',
    ),
    Told(
        'the process that reads calibrations ends',
        'kill -9',
        'the request is refused; the next one begins another process; samples go on',
        'refusal: the process that reads it ended',
        f'{_DEFENCE}::test_a_reader_that_ends_is_begun_anew',
    ),
    Told(
        'a recording is killed',
        'kill -9 of `record` in a position',
        'what was written lies in a hidden file; the next `record` tells of it, `--finish` makes '
        'a bag of it',
        'the file, and what to do',
        'test_record.py::test_what_a_crash_has_left_is_told_and_finished',
    ),
    Told(
        'the samples step away at rest',
        '|f| off by more than `gravity_tolerance` from one sample to the next, and steady there',
        'nothing is published from less than 1 s later on; a lift and a car that shakes are '
        'motion',
        'ERROR "|f| at rest misses gravity by", with what it misses now',
        'test_gravity_check.py::test_what_steps_away_at_rest_is_refuted_within_a_second',
    ),
    Told(
        'the calibration file hangs',
        'its reader is stopped while samples flow, as by a network drive that is gone',
        'other parameters are set, samples go on; the request is answered after 10 s',
        'refusal: cannot be read: no answer within 10 s',
        f'{_DEFENCE}::test_while_a_file_hangs_the_other_parameters_go_on',
    ),
    Told(
        'the node is to end while a file hangs',
        'SIGTERM, and kill -9, while it runs; SIGTERM while it starts',
        'ends within 2 s of the first signal with exit code 0; no process stays behind',
        '',
        f'{_DEFENCE}::test_while_a_file_hangs_the_node_ends_and_nothing_stays',
    ),
    Told(
        'a driver is killed and begun anew',
        'kill -9, another process a second later; the middleware knows the dead one for 20 s yet',
        'the output goes on within 2 s of its first sample; no sample of the other comes between',
        'WARN "2 publishers on /accel/counts, of which one sends"',
        f'{_SOURCES}::test_a_driver_that_was_killed_blinds_for_less_than_two_seconds',
    ),
    Told(
        'a calibration file of any magnitudes',
        '10 000 files, one to three values of each key changed by up to 1e+-308',
        'refused, or every sample over and beyond its range is finite with a covariance that is '
        'positive definite',
        'refusal: the key and its bounds',
        'test_properties.py::'
        'test_whatever_file_is_accepted_gives_finite_numbers_over_its_whole_range',
    ),
    Told(
        'the correction of a second is not finite',
        'NaN, infinity or 1e200 in it, whatever led there',
        'its samples are dropped and counted, live and offline alike',
        'ERROR "samples of which nothing finite can be made"',
        'test_compensator.py::test_what_is_not_finite_is_never_published_whatever_led_to_it',
    ),
    Told(
        'a second publisher of the samples',
        'another attitude under stamps in between',
        'nothing is published until one is left or sends alone, nor what came just after it',
        'ERROR "2 publishers on /accel/counts"',
        f'{_SOURCES}::test_samples_of_a_second_publisher_never_go_out',
    ),
    Told(
        'a second publisher of a temperature',
        'half a degree more',
        'its topic is not used until one is left or sends alone: held, then lost',
        'ERROR "2 publishers on /temperature/board"',
        f'{_SOURCES}::test_readings_of_a_second_publisher_are_not_used',
    ),
    Told(
        'a driver that cannot be heard',
        'best effort for a reliable subscription; a message of another type',
        'nothing comes in',
        'ERROR "no messages of a publisher on", with the policy or the type',
        f'{_SOURCES}::test_a_driver_that_cannot_be_heard_is_named',
    ),
    Told(
        'one temperature stamped a day ahead',
        'among good ones',
        'not used once the next one of its sensor has come',
        'WARN "temperatures are stamped" until then',
        f'{_SOURCES}::test_a_reading_far_ahead_is_forgotten',
    ),
    Told(
        'a change of calibration and parameters fails at any line',
        'an exception at each of some 200 lines between the request and its end',
        'what ran goes on to the bit: calibration, parameters, thermometers, period of reports',
        'refusal: the reason',
        f'{_RELOAD}::test_whatever_line_fails_a_refused_change_is_not_applied',
    ),
    Told(
        'a calibration that cannot be applied',
        'a lag of 1e-300 s, and another bias, while samples flow',
        'nothing of it is applied, and the parameter keeps its value',
        'refusal: the key and its bounds',
        f'{_RELOAD}::test_a_calibration_that_cannot_be_applied_changes_nothing',
    ),
    Told(
        'a storm of reloads',
        '400 settings of `calibration_file`, 20 at a time, while 1 kHz flow',
        'each is answered; no sample is lost',
        '',
        f'{_PROCESS}::test_a_storm_of_reloads_at_1_khz',
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
        'the disk is full in a test',
        '`record` onto a file system of 300 KiB',
        'exit code 1, whole bags stay, the last one can be read as far as it was written',
        'one line: the bag, No space left on device, where what was written is',
        f'{_FILES}::test_a_recording_on_a_full_disk_keeps_what_was_written',
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
        'an output is an input',
        '`-o` names what is read: another spelling, a link, a folder around it; with `--force`',
        'exit code 1, nothing is touched',
        'one line: the output and the input that it is',
        f'{_OUTPUTS}::test_an_output_is_never_an_input',
    ),
    Told(
        'an output is something else',
        '`--force` onto a file of another kind, a device, a folder with other files in it',
        'exit code 1, nothing is touched',
        'one line: the output and what it is not',
        f'{_OUTPUTS}::test_only_the_same_kind_is_replaced',
    ),
    Told(
        'two commands write one output',
        'at the same time, without `--force`',
        'the first has it, whole; the other ends with exit code 1',
        'one line: exists already',
        f'{_OUTPUTS}::test_of_two_writers_one_wins',
    ),
    Told(
        'the output is a link',
        '`-o` names a symbolic link',
        'what it points at is written; the link stays',
        '',
        f'{_OUTPUTS}::test_a_link_is_written_through',
    ),
    Told(
        'the bags of a fleet cannot be read any more',
        '`fleet fit` again after a bad mount',
        'exit code 1; calibrations and certificates of the earlier run stay',
        'the row of the unit: the reason, and what stays',
        'test_fleet_run.py::test_bags_that_cannot_be_read_any_more_take_no_result_away',
    ),
    Told(
        'a serial is no serial',
        'line breaks, escape sequences, 65 characters: file, option, parameter, metadata',
        'refused',
        'one line: one printable line of 1 to 64 characters',
        f'{_TEXT}::test_what_is_no_serial',
    ),
    Told(
        'a recording forges lines',
        'escape sequences and line breaks in its serial, metadata and topics',
        'they are shown as a literal of Python would be',
        '',
        f'{_TEXT}::test_a_recording_forges_no_line',
    ),
    Told(
        'a terminal cannot show a name',
        'a Cyrillic serial on latin-1, a file name that is not UTF-8',
        'what cannot be shown is shown escaped',
        '',
        f'{_TEXT}::test_any_terminal_can_show_it',
    ),
    Told(
        'a command fails unforeseen',
        'an exception that nobody expected',
        'exit code 70, the traceback in a file',
        'one line: the exception and the file',
        f'{_TEXT}::test_what_nobody_has_foreseen',
    ),
    Told(
        'clients of `view` say nothing',
        '300 connections without a request',
        '16 are waited for, 2 s each; no more threads; the page is served afterwards',
        '',
        'test_report_live.py::test_clients_that_say_nothing_grow_no_threads',
    ),
    Told(
        'a recording is torn',
        'cut at every byte of its last chunk, and at random places',
        'every command reads it up to its last whole message, does its work, and ends with 1',
        'one line: the bag, the byte of the cut and what it cut',
        'test_recording_damage.py::test_cut_at_every_byte_of_the_last_chunk',
    ),
    Told(
        'rows are missing in a database',
        'deleted from a .db3 of which metadata.yaml promises 400',
        'every command does its work with what is there, and ends with 1',
        'one line: the topic, how many of how many messages are there',
        f'{_PROMISES}::test_rows_deleted_from_a_database_are_missed',
    ),
    Told(
        'a compressed file is damaged',
        'a .mcap.zstd cut off, and wiped in the middle',
        'read up to there, and what came is held against metadata.yaml; ends with 1',
        'one line: the file, the byte, how many of how many messages are there',
        f'{_PROMISES}::test_a_compressed_file_is_read_up_to_its_damage',
    ),
    Told(
        'a compressed file is a bomb',
        'zeros that expand a thousandfold, in a file, in a message, in a chunk of a ROS 1 bag',
        'refused at the limit that chunks have; what was expanded is removed',
        'one line: the file, and how much it holds',
        f'{_PROMISES}::test_a_compressed_file_expands_within_limits_and_leaves_nothing',
    ),
    Told(
        'a FIFO or a device in a bag',
        'as metadata.yaml, as its file, beside its files',
        'refused, or passed over; never waited for',
        'one line: not a regular file',
        f'{_PROMISES}::test_a_fifo_or_a_device_is_never_waited_for',
    ),
    Told(
        'the clock of a recording jumps by a year',
        'forward (1970, then NTP) or back, in the middle',
        'for whatever walks its time the jump is an hour: below 300 MB; stamps that jump all the '
        'time are refused',
        '`info`: gaps, and the longest',
        'test_recording_clock.py::test_a_jump_becomes_an_hour_and_the_rest_stays',
    ),
    Told(
        'stamps that no ROS message can hold in a table',
        'before 1970, after January 2038, beyond 64 bits; as CSV and Parquet',
        'those rows are left out and counted; refused where all are',
        'how many rows, and which lines',
        'test_convert_table.py::test_stamps_that_ros_cannot_hold',
    ),
    Told(
        'degenerate recordings',
        'equal, reversed or single stamps, values near 1e308, all zeros, names that are no UTF-8',
        'every command ends within a minute, below 300 MB, without a traceback',
        'one line, or the result',
        'test_degenerate.py::test_it_ends_with_a_sentence_in_bounded_memory',
    ),
]

#: What was tried beside all rows: how, how often, what came of it.
ATTACKS: list[tuple[str, str, str]] = [
    (
        '`use_sim_time` set while it runs; `/clock` on, back by an hour, still, '
        'forward by a year, set back',
        '9 steps, 20 samples in each',
        'every sample comes out; only the header of the diagnostics follows the clock',
    ),
    (
        '100 Hz, 2000 Hz and back',
        '6 times, 1000 samples in each',
        'every sample comes out, in order',
    ),
    (
        '20 clients set parameters at once, good and bad ones, calibrations among them',
        '300 requests of up to 3',
        'all answered; parameters and what runs agree',
    ),
    (
        'folders and links exchanged below `calibration_directory` while files are read',
        '400 readings',
        'none came from outside: the file that was opened is asked where it lies',
    ),
    (
        'a full disk under `convert` and `fleet fit`',
        'once each (`record`, `fit`, `report`, `replay`: above)',
        'exit code 1, the reason in a line, no draft stays',
    ),
    (
        'a calibration killed (kill -9) at each line of its writing, as by `fit --force`',
        'each of more than 30 lines',
        'the old file or the new one',
    ),
    (
        'crafted ULog and DataFlash logs: bytes cut, exchanged and put in',
        '150 each',
        'read, or refused in a line; formats that contradict their messages '
        'ended in a traceback before',
    ),
    (
        'paths that climb: `..` in the folder of a fleet, names like `..two`, requests of `view`',
        '3 folders, 5 requests',
        'nothing is written outside of the output, nothing is served',
    ),
    (
        'Python 3.13, and Python 3.10 with the oldest versions that `setup.py` allows',
        'each push (`make oldest`)',
        'the same suite',
    ),
]
