# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the functions for scripts: read a recording as arrays, correct samples, fit a calibration.

Times are seconds since any origin, or datetime64. Anything that numpy converts to an array is
accepted: lists, pandas columns, xarray arrays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from .files import shown_name
from .online.batch import process_block
from .online.compensator import Compensator
from .online.status import CompensatorConfig, Counters
from .recording.blocks import Block, Readings
from .recording.topics import Topics
from .typing import Bools, Floats, Ints
from .unit.calibration import Calibration

#: A thermometer's readings: one value for each sample, or (time_s, value) with separate times.
Temperature: TypeAlias = npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike]

#: `Columns.start_ns` is a multiple of this time [ns], so that times count from a whole minute.
_MINUTE_NS = 60_000_000_000
_LONGEST_S = 4e9  # largest time accepted [s]; a larger number is most likely not in seconds


@dataclass(frozen=True, eq=False)
class Columns:
    """
    A recording as arrays, returned by `read` and accepted by `fit`.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Time of each sample since `start_ns` [s]. `fit` needs times that rise strictly; remove a
        sample whose time does not exceed the time of the sample before.
    counts : ndarray, shape (n, 3)
        The raw samples: counts per conversion cycle, or m/s^2 from a unit that reports m/s^2.
    temperatures : dict of str to (ndarray, ndarray)
        Times since `start_ns` [s], which rise strictly, and readings [degC] of each thermometer,
        by its name.
    start_ns : int, optional
        Stamp of time 0 [ns]: the whole minute before the first message.
    serial : str or None, optional
        Serial of the unit, if the recording contains it.
    name : str, optional
        Name of the recording in messages.
    specific_force : str, optional
        Known |f| of rests, in the form of the key `specific_force_magnitude_m_s2` of a bag's
        metadata; if empty, |f| at rest is gravity.

    """

    time_s: Floats
    counts: Floats
    temperatures: Mapping[str, tuple[Floats, Floats]]
    start_ns: int = 0
    serial: str | None = None
    name: str = 'arrays'
    specific_force: str = ''


@dataclass(frozen=True, eq=False)
class Corrected:
    """
    Result of `Calibration.correct`, one row for each sample.

    Attributes
    ----------
    specific_force : ndarray, shape (n, 3)
        Corrected specific force [m/s^2]; NaN for samples that the node would not publish.
    covariance : ndarray, shape (n, 3, 3)
        Covariance of the specific force [m^2/s^4]; NaN where the force is NaN.
    dynamic : ndarray of bool, shape (n,)
        Whether the regime was dynamic; False while the regime is unknown.
    counters : Counters
        Numbers of samples and readings used, and of samples and readings dropped for each reason.

    """

    specific_force: Floats
    covariance: Floats
    dynamic: Bools
    counters: Counters = field(default_factory=Counters)


def correct(
    calibration: Calibration,
    time_s: npt.ArrayLike,
    counts: npt.ArrayLike,
    *,
    board: Temperature = ([], []),
    config: CompensatorConfig | None = None,
    **sensors: Temperature,
) -> Corrected:
    """
    Correct arrays of samples, bit for bit as node and ``replay`` correct samples of equal stamps.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the unit; its method `correct` gives the same result.
    time_s : array_like, shape (n,)
        Time of each sample, strictly rising: seconds since any origin, or datetime64.
    counts : array_like, shape (n, 3)
        The raw samples, in the calibration's input unit.
    board : array_like, shape (n,), or (array_like, array_like), optional
        Board temperature [degC]: a value for each sample (NaN where there was no reading), or
        (time_s, value) with separate times. A reading applies from the first sample with an equal
        or later time. A calibration that does not depend on temperature needs no reading.
    config : CompensatorConfig or None, optional
        Settings of the compensator; None: the defaults of the node's parameters.
    **sensors : as `board`
        The other thermometers that the calibration names, in most calibrations ``case`` only.

    Returns
    -------
    Corrected
        A row for each sample.

    Raises
    ------
    ValueError
        If shapes do not fit, times do not rise, or the calibration lacks one of `sensors`.

    """
    unknown = sorted(set(sensors) - set(calibration.sensors))
    if unknown:
        known = ', '.join(('board', *calibration.sensors))
        text = f'`{unknown[0]}` is not a thermometer of the calibration, which has {known}'
        raise ValueError(text)
    given = _block(time_s, counts, {'board': board, **sensors}, 0)
    compensator = Compensator(calibration, config)
    block = process_block(compensator, given)
    stamps = given.accel_stamp_ns
    force = np.full((len(stamps), 3), np.nan)
    covariance = np.full((len(stamps), 3, 3), np.nan)
    force[block.index] = block.specific_force
    covariance[block.index] = block.covariance.reshape(-1, 3, 3)
    flags = compensator.take_flags()
    switched = np.array([stamp for stamp, _ in flags], dtype=np.int64)
    regimes = np.array([False, *(is_dynamic for _, is_dynamic in flags)])
    dynamic = regimes[np.searchsorted(switched, stamps, 'right')]
    return Corrected(force, covariance, dynamic, compensator.counters)


def read(path: str | Path, topics: Topics | None = None) -> Columns:
    """
    Read a bag, a table or a PX4 or ArduPilot log into arrays.

    Parameters
    ----------
    path : str or Path
        A rosbag2 folder, ``*.mcap``, ``*.db3`` or a ROS 1 ``*.bag``; a table of numbers whose
        columns can be guessed; a PX4 ``*.ulg`` or ArduPilot ``*.bin``.
    topics : recording.topics.Topics or None, optional
        Topics of the inputs, if their names differ from the node's default names.

    Returns
    -------
    Columns
        Samples and readings in the order of recording.

    Raises
    ------
    RecordingError
        If the file cannot be read, or holds no samples.

    """
    from .convert.readers import as_bags
    from .fitting.sources import MAGNITUDE, ROTATION
    from .recording.reader import read_recording

    with as_bags([Path(path)]) as (bag,):
        recording = read_recording(bag, topics, require=['accel'])
    block = recording.columns
    readings = {name: pair for name, pair in block.temperatures.items() if len(pair[0])}
    stamps = [block.accel_stamp_ns, *(reading[0] for reading in readings.values())]
    first_ns = min((int(stamp.min()) for stamp in stamps if len(stamp)), default=0)
    start_ns = first_ns // _MINUTE_NS * _MINUTE_NS
    metadata = recording.info.metadata
    # `Columns` cannot hold the bag's rotation rate: `fit` refuses this text, as it is no number.
    force = f'{ROTATION} {metadata[ROTATION]}' if ROTATION in metadata else ''
    return Columns(
        time_s=_seconds(block.accel_stamp_ns, start_ns),
        counts=block.accel,
        temperatures={
            name: (_seconds(stamps, start_ns), value)
            for name, (stamps, value, _) in readings.items()
        },
        start_ns=start_ns,
        serial=metadata.get('serial'),
        name=shown_name(path),
        specific_force=force or metadata.get(MAGNITUDE, ''),
    )


def _seconds(stamps: Ints, start_ns: int) -> Floats:
    return np.multiply(stamps - start_ns, 1e-9, dtype=np.float64)


def fit(
    recordings: str | Path | Columns | Sequence[str | Path | Columns],
    *,
    gravity: float,
    **options: Any,
) -> Calibration:
    """
    Fit a calibration to recordings of a thermal test, at rest in several positions.

    Parameters
    ----------
    recordings : str, Path or Columns, or sequence of them
        Bags, tables or logs, or arrays with the temperatures of ``'board'``, ``'case'`` and any
        further thermometers.
    gravity : float
        Local gravity [m/s^2].
    **options
        Fields of `fitting.FitOptions`: `serial`, `model`, `prior`, ...; for arrays in m/s^2,
        `input` must be ``'m/s^2'``.

    Returns
    -------
    Calibration
        Calibration of the unit; `thermo_comp.save` writes the calibration to a file, the method
        `correct` of the calibration corrects samples.

    Raises
    ------
    ValueError
        If an option is out of its range, or arrays do not fit together.
    RecordingError
        If a file cannot be read.
    FitError
        If the data do not suffice for a fit, or `gravity` is outside the range on Earth.

    """
    from .convert.readers import as_bags
    from .fitting import FitOptions, FitSource
    from .fitting import fit as run
    from .fitting.sources import KnownForce, fit_sources, parse_sections

    items = [recordings] if isinstance(recordings, (str, Path, Columns)) else list(recordings)
    with as_bags([Path(item) for item in items if not isinstance(item, Columns)]) as paths:
        sources, kind = fit_sources(paths)
        if paths:
            options.setdefault('input', 'counts' if kind == 'counts' else 'm/s^2')
        for item in items:
            if isinstance(item, Columns):
                nothing: Temperature = ([], [])
                readings = {'board': nothing, 'case': nothing, **item.temperatures}
                block = _block(item.time_s, item.counts, readings, item.start_ns)
                name, text = item.name, item.specific_force
                known = KnownForce(name, parse_sections(text)) if text else None
                sources.append(FitSource(name, partial(list, [block]), None, item.serial, known))
        return run(sources, FitOptions(gravity=gravity, **options)).calibration


def _block(
    time_s: npt.ArrayLike, counts: npt.ArrayLike, given: Mapping[str, Temperature], start_ns: int
) -> Block:
    """Make a block from arrays; a reading applies from the first sample of equal or later time."""
    stamps = _stamps('time_s', time_s)
    samples = _numbers('counts', counts)
    if samples.shape != (len(stamps), 3):
        raise ValueError(
            f'`counts` must have the shape ({len(stamps)}, 3), a row for each time, '
            f'got {samples.shape}'
        )
    readings = {}
    for name, value in given.items():
        reading_ns, celsius = _readings(name, value, stamps, _is_date(time_s))
        first = np.searchsorted(stamps, reading_ns)
        readings[name] = Readings(reading_ns + start_ns, celsius, first)
    return Block(stamps + start_ns, samples, '', None, readings, {})


def _is_date(value: object) -> bool:
    return np.asarray(value).dtype.kind in 'Mm'


def _numbers(name: str, value: npt.ArrayLike) -> Floats:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f'`{name}` must be numbers: {error}') from error


def _stamps(name: str, value: npt.ArrayLike) -> Ints:
    """Convert times to nanoseconds; ValueError if the times do not rise strictly."""
    given = np.asarray(value)
    if given.ndim != 1:
        raise ValueError(f'`{name}` must have one dimension, got the shape {given.shape}')
    if _is_date(given):
        wrong = np.isnat(given)
        nanoseconds = given.astype(f'{given.dtype.kind}8[ns]')
    else:
        given = _numbers(name, given)
        wrong = ~(np.abs(given) <= _LONGEST_S)
        nanoseconds = np.rint(np.where(wrong, 0.0, given) * 1e9)
    if wrong.any():
        raise ValueError(
            f'`{name}` must be finite seconds, or datetime64, got {given[wrong][0]} '
            f'at index {wrong.argmax()}'
        )
    stamps: Ints = nanoseconds.astype(np.int64)
    falls = np.flatnonzero(np.diff(stamps) <= 0)
    if len(falls):
        at = int(falls[0])
        raise ValueError(
            f'`{name}` must rise, got {given[at]} at index {at} and then {given[at + 1]}'
        )
    return stamps


def _readings(name: str, value: Temperature, stamps: Ints, is_date: bool) -> tuple[Ints, Floats]:
    """Return stamps and values of a thermometer's readings."""
    if isinstance(value, tuple) and len(value) == 2:
        if np.size(value[0]) and _is_date(value[0]) != is_date:
            raise ValueError(
                f'the times of `{name}` must be seconds or datetime64, as those of `time_s`'
            )
        reading_ns = _stamps(f'{name} time_s', value[0])
        values = _numbers(name, value[1])
        if values.shape != reading_ns.shape:
            raise ValueError(
                f'`{name}` must have as many values as times, {len(reading_ns)}, '
                f'got {values.shape}'
            )
        return reading_ns, values
    values = _numbers(name, cast('npt.ArrayLike', value))
    if values.shape != stamps.shape:
        raise ValueError(
            f'`{name}` must have a value for each of the {len(stamps)} times, or be a pair '
            f'(time_s, value), got {values.shape}'
        )
    return Readings(stamps, values).thinned()[:2]
