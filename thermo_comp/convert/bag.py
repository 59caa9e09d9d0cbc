# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of bags of ROS 1 and 2 with other topics or units than the node's.

Drivers choose their topic names, and some do not publish m/s^2. A topic that the caller does not
name is found by its message type. The temperature topic that shares the most leading namespaces
with the Imu topic is the board's. The case's temperature topic shares more namespaces with a
barometer's topic than with the Imu topic, or is the only temperature topic besides the board's.
"""

from pathlib import Path, PurePosixPath

import numpy as np

from ..errors import RecordingError
from ..recording.reader import inspect_recording, read_recording
from ..recording.topics import Present, Topics, choice_note, of_kind
from ..topics import IMU, TEMPERATURE
from .log import ForeignLog, Unit

_PRESSURE = 'sensor_msgs/msg/FluidPressure'


def bag_log(
    path: Path,
    imu: str | None = None,
    board: str | None = None,
    case: str | None = None,
    unit: Unit = 'm/s^2',
) -> ForeignLog:
    """Read a bag; topics given as None are searched; `unit`: unit of the Imu's acceleration."""
    present = inspect_recording(path).topics
    inputs = find_topics(present, imu, board, case)
    chosen = []
    for (role, name), given in zip(inputs.items(), (imu, board, case), strict=True):
        among = 'only' if role == 'imu' else 'nearest'
        usual = given or getattr(Topics(), role)
        chosen.append(choice_note(name, role, usual, among) if name else '')
    # '/none', which is no topic's name, stands for a missing thermometer.
    names = {role: name or '/none' for role, name in inputs.items()}
    recording = read_recording(path, Topics.named(names, input='imu'), require=('accel',))
    columns = recording.columns
    return ForeignLog(
        str(path),
        columns.accel_stamp_ns,
        columns.accel,
        None if columns.imu is None else columns.imu.angular_velocity,
        {
            name: readings.take(np.isfinite(readings.celsius))
            for name, readings in columns.temperatures.items()
            if name in inputs
        },
        unit=unit,
        frame_id=columns.frame_id,
        serial=recording.info.metadata.get('serial', ''),
        missing=recording.info.truncated,
        chosen='; '.join(filter(None, chosen)) or None,
        metadata={f'topic_{role}': name for role, name in inputs.items() if name},
    )


def find_topics(
    present: Present, imu: str | None, board: str | None, case: str | None
) -> dict[str, str | None]:
    """Find the topics of ``imu``, ``board`` and ``case``; None for a missing thermometer."""
    imu = imu or _only(of_kind(present, IMU), 'Imu')
    if imu is None:
        raise RecordingError(
            'the bag holds no sensor_msgs/msg/Imu, which convert needs; a bag with accel/counts '
            'needs no conversion'
        )

    def free() -> list[str]:
        return [name for name in of_kind(present, TEMPERATURE) if name not in (board, case)]

    if case is None:
        baros = of_kind(present, _PRESSURE)
        nearer = [name for name in free() if _shared(name, baros) > _shared(name, [imu])]
        case = _only(nearer, 'case')
    if board is None:
        most = max((_shared(name, [imu]) for name in free()), default=0)
        board = _only([name for name in free() if _shared(name, [imu]) == most], 'board')
    case = case or _only(free(), 'case')
    return {'imu': imu, 'board': board, 'case': case}


def _shared(name: str, others: list[str]) -> int:
    """Return the largest number of leading namespaces that `name` shares with one of `others`."""
    namespaces, *theirs = (
        {*PurePosixPath('/', topic.strip('/')).parents} for topic in (name, *others)
    )
    return max((len(namespaces & spaces) for spaces in theirs), default=0)


def _only(names: list[str], what: str) -> str | None:
    if len(names) > 1:
        raise RecordingError(
            f'several topics may be the {what}: {", ".join(sorted(names))}; choose one with '
            f'--topic {what.lower()}=TOPIC'
        )
    return names[0] if names else None
