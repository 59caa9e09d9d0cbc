# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the offline run of the node: a whole bag through the compensator into another bag.

The same code corrects, block by block instead of sample by sample, and a temperature counts from
the first sample that stands behind it in the bag: so the values are those, bit for bit, of a node
that got the bag's messages in this order. Memory is bounded by one block.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import __version__
from .errors import CalibrationError
from .online.batch import process_block
from .online.blocks import CompensatedBlock
from .online.compensator import Compensator
from .online.status import CompensatorConfig, Counters
from .recording import (
    BagWriter,
    Block,
    ImuColumns,
    Input,
    RawMessages,
    RecordingInfo,
    RecordingReader,
    Topics,
    open_recording,
)
from .typing import Ints
from .unit.calibration import Calibration

OUTPUT_TOPIC = 'imu/data_raw'
REGIME_TOPIC = 'regime/dynamic'
#: Messages corrected at once: enough that what is done per block costs little beside them.
BLOCK_MESSAGES = 1 << 17


@dataclass(frozen=True)
class CorrectedBlock:
    """
    One block of a recording and what the compensator made of it.

    Parameters
    ----------
    block : Block
        The input.
    corrected : CompensatedBlock
        The samples to be published.
    flags : list of (int, bool)
        Stamp of a case reading and the regime at it (True = dynamic).

    """

    block: Block
    corrected: CompensatedBlock
    flags: list[tuple[int, bool]]


@dataclass(frozen=True)
class ReplayResult:
    """
    The account of a replay.

    Parameters
    ----------
    info : RecordingInfo
        The input.
    output : Path
        The bag written.
    counters : Counters
        What came in, what went out, and why some did not.
    n_flags : int
        Regime flags written.
    switches : list of (int, bool)
        First flag, and each that differs from the one before.

    """

    info: RecordingInfo
    output: Path
    counters: Counters
    n_flags: int
    switches: list[tuple[int, bool]]


def check_unit(calibration: Calibration, info: RecordingInfo, serial: str | None = None) -> None:
    """
    Refuse a calibration that is for another unit, or for another kind of input.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    info : RecordingInfo
        The recording; its metadata may name the unit.
    serial : str or None, optional
        The unit as the user knows it; it wins over the metadata, and an empty text accepts any.

    Raises
    ------
    CalibrationError
        If the serials differ, or the recording is in another unit than the calibration.

    """
    expected = info.metadata.get('serial', '') if serial is None else serial
    if expected and expected != calibration.unit.serial:
        raise CalibrationError(
            f'this calibration is of unit {calibration.unit.serial}, '
            f'the recording {info.path} is of {expected}',
            key='unit.serial',
        )
    if info.input == 'imu' and calibration.unit.input != 'm/s^2':
        raise CalibrationError(
            f'this calibration takes {calibration.unit.input}, '
            f'the recording {info.path} holds sensor_msgs/Imu in m/s^2',
            key='unit.input',
        )


def input_for(calibration: Calibration, asked: Input) -> Input:
    """
    Choose what is read from a recording for a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    asked : {'auto', 'counts', 'imu'}
        The user's word.

    Returns
    -------
    {'counts', 'imu'}
        For ``auto``, counts for a calibration in counts and Imu for one in m/s^2.

    """
    if asked != 'auto':
        return asked
    return 'counts' if calibration.unit.input == 'counts' else 'imu'


def corrected_blocks(
    compensator: Compensator, blocks: Iterable[Block]
) -> Iterable[CorrectedBlock]:
    """
    Run blocks through a compensator.

    Parameters
    ----------
    compensator : Compensator
        Its counters go on counting.
    blocks : iterable of Block
        In file order.

    Yields
    ------
    CorrectedBlock
        One for each block.

    """
    for block in blocks:
        corrected = process_block(compensator, block)
        yield CorrectedBlock(block, corrected, compensator.take_flags())


def replay(
    path: str | Path,
    calibration: Calibration,
    output: str | Path,
    *,
    config: CompensatorConfig | None = None,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    serial: str | None = None,
    frame_id: str = '',
    keep_inputs: bool = False,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> ReplayResult:
    """
    Correct a recording and write what the node would publish.

    Parameters
    ----------
    path : str or Path
        The recording.
    calibration : Calibration
        The unit's calibration.
    output : str or Path
        The bag to write; ``*.mcap`` makes a bare file, anything else a rosbag2 directory.
    config : CompensatorConfig or None, optional
        The node's settings.
    topics : Topics or None, optional
        Names of the inputs.
    input : {'auto', 'counts', 'imu'}, optional
        What is corrected; by default what the calibration is for.
    serial : str or None, optional
        See `check_unit`.
    frame_id : str, optional
        Frame of the output; empty keeps the input's.
    keep_inputs : bool, optional
        Copy the input messages beside the output, at their own stamps.
    overwrite : bool, optional
        Replace an output that is there.
    progress : callable or None, optional
        Called with the fraction done.

    Returns
    -------
    ReplayResult
        The account.

    Raises
    ------
    RecordingError
        If the recording cannot be read or the output cannot be written.
    CalibrationError
        If the calibration is for another unit.

    """
    compensator = Compensator(calibration, config)
    wanted = input_for(calibration, input)
    with open_recording(path, topics, wanted, require=('accel', 'board')) as reader:
        check_unit(calibration, reader.info, serial)
        metadata = {
            'serial': calibration.unit.serial,
            'corrected_from': Path(path).name,
            'corrected_by': f'thermo_comp {__version__}',
        }
        total = reader.info.topics[reader.topics['accel']][1]
        flags: list[tuple[int, bool]] = []
        with BagWriter(output, metadata=metadata, overwrite=overwrite) as writer:
            blocks = reader.blocks(raw=keep_inputs, n_messages=BLOCK_MESSAGES)
            for item in corrected_blocks(compensator, blocks):
                _write_block(writer, item, frame_id)
                if keep_inputs:
                    _write_inputs(writer, item.block, reader)
                writer.flush()
                flags += item.flags
                if progress is not None:
                    progress(compensator.counters.n_in / max(total, 1))
        return ReplayResult(
            info=reader.info,
            output=Path(output),
            counters=compensator.counters,
            n_flags=len(flags),
            switches=switches(flags),
        )


def switches(flags: Iterable[tuple[int, bool]]) -> list[tuple[int, bool]]:
    """
    Keep the first flag and each that differs from the one before.

    Parameters
    ----------
    flags : iterable of (int, bool)
        Stamp and regime.

    Returns
    -------
    list of (int, bool)
        The changes.

    """
    changes: list[tuple[int, bool]] = []
    for stamp_ns, is_dynamic in flags:
        if not changes or changes[-1][1] != is_dynamic:
            changes.append((stamp_ns, is_dynamic))
    return changes


def _write_block(writer: BagWriter, item: CorrectedBlock, frame_id: str) -> None:
    corrected = item.corrected
    if len(corrected.stamp_ns):
        writer.write_imu(
            OUTPUT_TOPIC,
            corrected.stamp_ns,
            corrected.specific_force,
            corrected.covariance,
            frame_id or item.block.frame_id,
            imu=None if item.block.imu is None else _rows(item.block.imu, corrected.index),
        )
    if item.flags:
        stamps, values = zip(*item.flags, strict=True)
        writer.write_bool(REGIME_TOPIC, np.array(stamps, dtype=np.int64), np.array(values))


def _rows(imu: ImuColumns, index: Ints) -> ImuColumns:
    return ImuColumns(
        imu.orientation[index],
        imu.orientation_covariance[index],
        imu.angular_velocity[index],
        imu.angular_velocity_covariance[index],
        imu.linear_acceleration_covariance[index],
    )


def _write_inputs(writer: BagWriter, block: Block, reader: RecordingReader) -> None:
    """
    Copy the inputs; their log time becomes their stamp, as that of the outputs is.

    """
    stamps = {
        reader.topics.get('accel'): block.accel_stamp_ns,
        reader.topics.get('board'): block.board_stamp_ns,
        reader.topics.get('case'): block.case_stamp_ns,
    }
    for raw in block.raw:
        times = stamps[raw.topic]
        copy = RawMessages(raw.topic, raw.type, times, raw.data, raw.ends)
        writer.write_raw(raw.topic, raw.type, times, copy, reader.definitions.get(raw.type))
