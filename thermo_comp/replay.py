# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the offline run of the node: the correction of a whole bag into another bag or a table.

The correction is the node's code, applied to blocks of samples instead of single samples. A
temperature reading applies from the first sample that follows the reading in the bag and whose
stamp is equal or later. The output equals, bit for bit, the output of a node that receives the
messages in the bag's order. Only one block of the bag is in memory at a time.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from itertools import groupby
from math import inf
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import __version__
from .errors import CalibrationError, OutputError
from .files import shown_name
from .online.batch import CompensatedBlock, process_block
from .online.compensator import CONTINUED, SWAPPED, Compensator
from .online.status import CompensatorConfig, Counters
from .recording.blocks import Block, ImuColumns, RecordingInfo, Role
from .recording.reader import RecordingReader, open_recording
from .recording.serialized import Messages
from .recording.topics import Topics
from .recording.writer import TABLES, BagWriter, WriteRows, table_writer
from .thermal.thermometer import COLDEST, HOTTEST
from .topics import FLAGS, IMU_OUT, OUTPUTS, TEMPERATURE, thermometer
from .typing import Ints
from .unit.calibration import Calibration

# Quantiles of the board readings that are compared with the calibrated range: extreme readings may
# be wrong.
_BULK = 0.01, 0.99
_NOISE_K = 0.1  # largest excess of a quantile over the range that counts as reading noise [K]
_REGIMES = np.array(['unknown', 'static', 'dynamic'])


@dataclass(frozen=True)
class ReplayResult:
    """Summary of a replay: input, output, numbers of samples and flags, changes of regime."""

    info: RecordingInfo
    output: Path
    counters: Counters
    n_flags: int
    #: Stamp [ns] and value of the first regime flag, and of each flag unlike the flag before it.
    switches: list[tuple[int, bool]]
    #: Warnings of exchanged thermometers, and of temperatures outside the calibrated range.
    notes: list[str]


#: Writes a block of a recording with its corrected samples and regime flags (stamp, is dynamic).
WriteBlock = Callable[[Block, CompensatedBlock, list[tuple[int, bool]]], None]


def check_unit(calibration: Calibration, info: RecordingInfo, serial: str | None = None) -> None:
    """Refuse a calibration of another unit or input; an empty `serial` accepts any unit."""
    expected = info.metadata.get('serial', '') if serial is None else serial
    if expected and expected != calibration.unit.serial:
        other = 'the given serial is' if serial else f'the recording {info.path} is of unit'
        raise CalibrationError(
            f'this calibration is of unit {calibration.unit.serial}, {other} {expected} '
            "(--serial '' accepts any calibration)",
            key='unit.serial',
        )
    if info.input == 'imu' and calibration.unit.input != 'm/s^2':
        raise CalibrationError(
            f'this calibration takes samples in {calibration.unit.input}, but those read from '
            f'{info.path} are sensor_msgs/Imu in m/s^2: if the recording has counts, too, choose '
            '--input counts',
            key='unit.input',
        )


def topics_for(calibration: Calibration, topics: Topics | None) -> Topics:
    """Return the input topics: ``auto`` reads counts for a calibration in counts, else Imu."""
    topics = topics or Topics()
    if topics.input != 'auto':
        return topics
    return replace(topics, input='counts' if calibration.unit.input == 'counts' else 'imu')


def needed_roles(*calibrations: Calibration) -> tuple[Role, ...]:
    """Return the needed inputs: samples, and board temperature if a calibration depends on it."""
    needs_board = any(calibration.needs_temperature for calibration in calibrations)
    return ('accel', 'board') if needs_board else ('accel',)


def replay(
    path: str | Path,
    calibration: Calibration,
    output: str | Path,
    *,
    config: CompensatorConfig | None = None,
    topics: Topics | None = None,
    serial: str | None = None,
    frame_id: str = '',
    keep_inputs: bool = False,
    all_topics: bool = False,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> ReplayResult:
    """
    Correct a recording and write the output of the node, as a bag or (by suffix) a table.

    `keep_inputs` also copies the input messages, with their stamps as log times. `all_topics` also
    copies all further topics, except topics of outputs, with the log times of the recording.
    """
    compensator = Compensator(calibration, config)
    wanted = topics_for(calibration, topics)
    with open_recording(path, wanted, require=needed_roles(calibration)) as reader:
        check_unit(calibration, reader.info, serial)
        metadata = {
            'serial': calibration.unit.serial,
            'corrected_from': shown_name(path),
            'corrected_by': f'thermo_comp {__version__}',
        }
        total = reader.info.topics[reader.topics['accel']][1]
        flags: list[tuple[int, bool]] = []
        is_swapped, beyond = False, 0.0
        is_raw = keep_inputs or all_topics
        if Path(output).suffix in TABLES:
            if is_raw:
                raise OutputError('a table can only contain the corrected samples', output)
            sink = _rows_of(table_writer(output, metadata, overwrite=overwrite))
        else:
            bag = BagWriter(output, metadata=metadata, overwrite=overwrite)
            sink = _messages_of(bag, reader, metadata['serial'], frame_id, all_topics)
        with sink as write:
            for block in reader.blocks(raw=is_raw):
                rate = None if block.imu is None else block.imu.angular_velocity
                corrected = process_block(compensator, block, rate)
                new = compensator.take_flags()
                write(block, corrected, new)
                flags += new
                is_swapped |= compensator.thermal.tracker.lead.is_reversed
                beyond = max(beyond, _beyond(calibration, block), key=abs)
                if progress is not None:
                    progress(compensator.counters.n_in / max(total, 1))
        notes = [SWAPPED] if is_swapped else []
        notes += [f'board temperature {beyond:+.2f} K {CONTINUED}'] if beyond else []
        counters, changes = compensator.counters, switches(flags)
        return ReplayResult(reader.info, Path(output), counters, len(flags), changes, notes)


def _beyond(calibration: Calibration, block: Block) -> float:
    """Return how far the 1 % or 99 % quantile of T_board is outside the calibrated ranges [K]."""
    ranges = [regime_set.temperature_range_c for regime_set in calibration.regime_sets()]
    lower, upper = min(bounds[0] for bounds in ranges), max(bounds[1] for bounds in ranges)
    celsius = block.temperatures['board'].celsius
    celsius = celsius[(celsius >= COLDEST) & (celsius <= HOTTEST)]
    bulk = np.quantile(celsius, _BULK) if len(celsius) else np.array([lower])
    excess = float(max(bulk - np.clip(bulk, lower, upper), key=abs))
    return excess if calibration.needs_temperature and abs(excess) > _NOISE_K else 0.0


def switches(flags: Iterable[tuple[int, bool]]) -> list[tuple[int, bool]]:
    """Return the first regime flag (stamp, is dynamic) and each flag unlike the flag before it."""
    return [next(run) for _, run in groupby(flags, key=itemgetter(1))]


@contextmanager
def _messages_of(
    bag: BagWriter, reader: RecordingReader, serial: str, frame_id: str, all_topics: bool
) -> Iterator[WriteBlock]:
    """Yield a function that writes a block as messages of the node, with the copied messages."""
    with bag as writer:
        taken = {topic.name for topic in OUTPUTS}
        taken |= {reader.topics[role].strip('/') for role in reader.topics.keys() - reader.fields}
        others = {topic for topic in reader.info.topics if topic.strip('/') not in taken}
        following = reader.raw(others if all_topics else ())
        waiting = next(following, None)

        def copy(topic: str, kind: str, messages: Messages, times: Ints) -> None:
            writer.write_raw(topic, kind, times, messages, reader.definitions.get(kind))

        def copy_others(until_ns: float) -> None:
            nonlocal waiting
            while waiting is not None and waiting[1].log_ns[0] <= until_ns:
                topic, messages = waiting
                copy(topic.name, topic.type, messages, messages.log_ns)
                waiting = next(following, None)

        def write(block: Block, corrected: CompensatedBlock, new: list[tuple[int, bool]]) -> None:
            if len(corrected.stamp_ns):
                writer.write_imu(
                    IMU_OUT.name,
                    corrected.stamp_ns,
                    corrected.specific_force,
                    corrected.covariance,
                    frame_id or block.frame_id,
                    imu=_imu_of(block, corrected),
                )
            if new:
                times = np.array([stamp for stamp, _ in new], dtype=np.int64)
                for topic, pack in FLAGS.items():
                    packed = [pack(*flag, serial) for flag in new]
                    writer.write_raw(topic.name, topic.type, times, packed)
            # Copied input messages, like output messages, get their stamps as log times.
            for role, messages in block.raw.items():
                name = thermometer(role) if role in reader.fields else reader.topics[role]
                kind = TEMPERATURE if role in reader.fields else reader.info.topics[name][0]
                copy(name, kind, messages, block.stamp_ns[role])
            if len(block):
                copy_others(block.log_ns['accel'][-1])
            writer.flush()

        yield write
        copy_others(inf)


@contextmanager
def _rows_of(table: AbstractContextManager[WriteRows]) -> Iterator[WriteBlock]:
    """Write blocks as rows of a table, one for each corrected sample."""
    regime = 0

    def write(block: Block, corrected: CompensatedBlock, flags: list[tuple[int, bool]]) -> None:
        nonlocal regime
        columns: dict[str, NDArray[Any]] = {'stamp_ns': corrected.stamp_ns}
        for axis, name in enumerate('xyz'):
            columns[f'specific_force_{name}_m_s2'] = corrected.specific_force[:, axis]
        for name, at in (('xx', 0), ('xy', 1), ('xz', 2), ('yy', 4), ('yz', 5), ('zz', 8)):
            columns[f'covariance_{name}_m2_s4'] = corrected.covariance[:, at]
        regimes = [regime, *(1 + is_dynamic for _, is_dynamic in flags)]
        switched = np.array([stamp for stamp, _ in flags], np.int64)
        after = np.searchsorted(switched, corrected.stamp_ns, 'right')
        columns['regime'] = _REGIMES[np.array(regimes)[after]]
        regime = regimes[-1]
        imu = _imu_of(block, corrected)
        if imu is not None:
            for axis, name in enumerate('xyz'):
                columns[f'angular_velocity_{name}_rad_s'] = imu.angular_velocity[:, axis]
        write_rows(columns)

    with table as write_rows:
        yield write


def _imu_of(block: Block, corrected: CompensatedBlock) -> ImuColumns | None:
    """Return all Imu fields but the force; a rate marked absent (covariance[0] = -1) stays raw."""
    if block.imu is None:
        return None
    imu = block.imu.take(corrected.index)
    if corrected.angular_rate is None or corrected.angular_rate_variance is None:
        return imu
    before = imu.angular_velocity_covariance
    is_rate = before[:, :1] != -1.0
    covariance = np.zeros_like(before)
    covariance[:, ::4] = corrected.angular_rate_variance
    return imu._replace(
        angular_velocity=np.where(is_rate, corrected.angular_rate, imu.angular_velocity),
        angular_velocity_covariance=np.where(is_rate, covariance, before),
    )
