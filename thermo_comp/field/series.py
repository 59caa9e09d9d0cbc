# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns rests as measurements of the error of a calibration: ``|f| - g`` and its derivatives.

A rest at an unknown attitude measures one number, |f|. Let x be the forces along the axes, f = M
x, u = f / |f| and v = M^T u. If the bias of axis i is d_bias [input units] too large, and its
scale K_i d_scale too large, |f| changes by ``-v_i (d_bias + K_i x_i d_scale) / scale_i``; K_i and
scale_i are the scale factors at the reference temperature and at the rest. To first order,
``|f| - g`` is noise plus H times the errors of all parameters (true less calibrated); H has the
derivatives of |f| by these errors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import RecordingError
from ..files import read_bounded
from ..text import counted
from ..thermal.lags import MemorySpec
from ..thermal.state import BOARD, RATE, UNKNOWN, WEIGHT, StateLayout
from ..typing import Bools, Floats, Ints
from ..unit.calibration import Calibration, parameter_layout
from ..unit.correction import Correction
from ..unit.covariance import covariance_at
from ..unit.metrics import means_by
from ..unit.nonlinearity import nonlinear_covariance
from ..unit.prediction import SlowUncertainty
from ..unit.provenance import Source
from .rest import SUFFIX, Rest, Start, rests_of

_DAY_NS = 86_400e9
_UNTIL = 'rests until '  # text before the time of the last rest in the name of an update's source
_AGED = ', claim aged '  # text before the days of ageing in the name of an update's source


@dataclass(frozen=True)
class RestSeries:
    """
    n rests in the order of the node's starts; accelerations and their sd in m/s^2.

    time: days since 1970
    start: number of the node's start, from 0
    temperature, state: board temperature [degC]; mean thermal state, in the order of `StateLayout`
    direction, force, by_parameter: v, x and H of this module's docstring
    gravity, residual: the stated g, and ``|f| - g``
    by_level: derivatives of |f| by the bias, and by the scale times g, of each axis, (n, 6)
    noise: variance of |f| due to noise of samples, errors of thermometers and of the regime
    by_start: derivatives of |f| by the unknown lag states at the start, in units of their sds
    lack: sd of the lack of fit of each axis times `direction`
    claim: claimed sd of `residual`
    n_windows: number of windows averaged to a rest
    """

    time: Floats
    start: Ints
    temperature: Floats
    state: Floats
    direction: Floats
    force: Floats
    gravity: Floats
    residual: Floats
    by_parameter: Floats
    by_level: Floats
    noise: Floats
    by_start: Floats
    lack: Floats
    claim: Floats
    n_windows: Ints
    reference_temperature: float

    def __len__(self) -> int:
        return len(self.time)

    @property
    def day(self) -> Ints:
        """Day of the first rest after the start of the node, for each rest [days since 1970]."""
        _, first = np.unique(self.start, return_index=True)
        return np.asarray(np.floor(self.time[first])[self.start], dtype=np.int64)

    def at(self, chosen: Bools | slice) -> RestSeries:
        """Return the selected rests, with their starts renumbered from 0."""
        arrays = (item for item in vars(self).items() if isinstance(item[1], np.ndarray))
        parts: dict[str, Any] = {name: value[chosen] for name, value in arrays}
        parts['start'] = np.unique(parts['start'], return_inverse=True)[1]
        return replace(self, **parts)


def is_rest_log(path: Path) -> bool:
    """Whether a path is a rest log or one of its files."""
    return path.suffix == SUFFIX or (path.is_dir() and any(path.glob(f'*{SUFFIX}')))


def _content(file: Path) -> bytes:
    try:
        # The node writes at most 320 kB a day; larger files than 64 MB are refused.
        return read_bounded(file, 1 << 26)
    except (OSError, ValueError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise RecordingError(f'cannot be read: {reason}', file) from error


def read_rests(
    paths: Sequence[Path],
    calibration: Calibration,
    *,
    ahead: float = 0.0,
    is_for_update: bool = True,
) -> tuple[list[tuple[Start, Rest]], Source, list[str]]:
    """
    Read the rest logs of a calibration's unit.

    Returns the rests, a `Source` for the provenance of an update by these rests, and notes.
    `ahead`: number of days of ageing that the covariance of the update will include. Rests before
    the date of the calibration are left out, unless all are before this date. Rests that an
    earlier update used are left out only if `is_for_update`. Raises RecordingError if none remain.
    """
    files: list[Path] = []
    for path in paths:
        matching = sorted(path.glob(f'*{SUFFIX}')) if path.is_dir() else [path]
        if not matching or not path.exists():
            raise RecordingError(
                f'no rest log: expected a folder of *{SUFFIX} files, which the node writes '
                '(parameter rest_log)',
                path,
            )
        files += matching
    others: set[str] = set()
    unit, wanted = calibration.unit, f'{calibration.unit.serial} ({calibration.unit.input})'

    def is_wanted(start: Start) -> bool:
        is_own = (start.serial, start.input) == (unit.serial, unit.input)
        if not is_own:
            others.add(f'{start.serial} ({start.input})')
        return is_own

    contents = [_content(file) for file in files]
    rests, n_damaged = rests_of(contents, is_wanted)
    notes = [f'{counted(n_damaged, "damaged line")} of the rest logs skipped'] if n_damaged else []
    if others:
        notes.append(f'rests of {", ".join(sorted(others))} are not of unit {wanted}: left out')
    if not rests:
        of_others = f'the rests are of {", ".join(sorted(others))}'
        found = of_others if others else 'the files contain no rests'
        raise RecordingError(f'no rest of unit {wanted}: {found}', ', '.join(map(str, paths)))
    begin, _, is_update = valid_since(calibration)
    # An update states the time of its last rest in whole seconds, rounded down.
    first_ns = begin * _DAY_NS + 1e9 * is_update
    later = [(start, rest) for start, rest in rests if rest.stamp_ns > first_ns]
    earlier = counted(len(rests) - len(later), 'window')
    if is_update and not is_for_update:
        notes.append(f'{earlier} were used by the last update')
    elif is_update and not later:
        raise RecordingError(
            'the calibration has been updated with all of these rests: update it again once the '
            'node has logged more',
            paths[0],
        )
    elif later and len(later) < len(rests):
        day = np.datetime64(int(begin * 86400.0), 's')
        notes.append(f'{earlier} before {day}, the date of the calibration: left out')
        rests = later
    digest = hashlib.sha256(b''.join(contents)).hexdigest()
    return rests, source_of(rests, digest, ahead), notes


def source_of(rests: Sequence[tuple[Start, Rest]], sha256: str, ahead: float = 0.0) -> Source:
    """Return an update's `Source`, named by the time of the last rest and days of ageing."""
    end = np.datetime64(max(rest.stamp_ns for _, rest in rests), 'ns').astype('datetime64[s]')
    n_samples = sum(rest.n for _, rest in rests)
    return Source(f'{_UNTIL}{end}{_AGED}{ahead:g} d', sha256, n_samples)


def last_rest(source: Source) -> str:
    """Return the date of the last rest of an update's source (UTC); '' for other sources."""
    name = source.name
    return name.removeprefix(_UNTIL).partition(_AGED)[0] + 'Z' if name.startswith(_UNTIL) else ''


def valid_since(calibration: Calibration) -> tuple[float, float, bool]:
    """
    Return the time of a calibration, the time up to which its covariance includes ageing [both in
    days since 1970], and whether the calibration is an update.

    The time of an update is the time of its last rest. The time of any other calibration is the
    date of its test or file; without a date, both returned times are -inf.
    """
    every = (source.name for source in calibration.provenance.sources)
    names = [name for name in every if name.startswith(_UNTIL)]
    text = names[-1].removeprefix(_UNTIL) if names else calibration.provenance.date
    date, _, aged = text.partition(_AGED)
    try:
        moment = np.datetime64(date.removesuffix('Z'), 'ns')
        ahead = float(aged.removesuffix(' d') or 0.0)
    except ValueError:
        return -np.inf, -np.inf, False
    # Ignore times of ageing that `update` cannot have written: below 0, a century or more.
    if np.isnat(moment) or not 0.0 <= ahead < 36525.0:
        return -np.inf, -np.inf, False
    begin = int(moment.astype(np.int64)) / _DAY_NS
    return begin, begin + ahead, bool(names)


def series_of(
    rests: Sequence[tuple[Start, Rest]], calibration: Calibration, gravity: float | None = None
) -> RestSeries:
    """
    Compute ``|f| - g`` and its derivatives at rests; `gravity` replaces the logged g. Raises
    RecordingError if the log does not have the lags of the calibration.
    """
    correction = Correction(calibration)
    K = correction.K[:, 0]
    places = {spec: _places(spec, correction.memory) for spec in {s.memory for s, _ in rests}}
    states = np.array([np.array(r.state)[places[s.memory][0]] for s, r in rests])
    shares = np.array([np.array(r.shares)[places[s.memory][1]] for s, r in rests])
    mean, sd = (np.array([getattr(r, name) for _, r in rests]) for name in ('mean', 'sd'))
    n = np.array([r.n for _, r in rests])
    stamps = np.array([r.stamp_ns for _, r in rests])
    beginnings = np.array([s.start_ns for s, _ in rests])
    local = np.array([s.gravity if gravity is None else gravity for s, _ in rests])
    group = _grouped(beginnings, states[:, BOARD], mean / K)
    sizes = np.bincount(group)
    averaged = partial(means_by, group)
    of_rests = beginnings[np.searchsorted(group, np.arange(len(sizes)))]
    _, first, start = np.unique(of_rests, return_index=True, return_inverse=True)
    start = np.argsort(np.argsort(first))[start]  # node starts, numbered in the order of rests
    states, mean, shares, local = map(averaged, (states, mean, shares, local))
    bias, scale = (part.T for part in correction.bias_scale(states.T))
    x = (mean - bias) / scale
    if correction.of_force is not None:
        x = correction.of_force.linearise(x, states[:, BOARD])
    M = np.array(calibration.misalignment)
    force = x @ M.T
    size = np.sqrt((force**2).sum(axis=1))
    u = force / size[:, np.newaxis]
    v = u @ M
    white = averaged(np.maximum((sd / K) ** 2, correction.noise) / n[:, np.newaxis])
    noise = (v**2 * white).sum(axis=1) / sizes
    at = _Geometry(states, shares, u, v, x)
    full = SlowUncertainty(calibration, correction)
    slow, claim, lack = _uncertainty(calibration, correction, full, at)
    of_start = np.moveaxis(full.of_start(states.T, shares.T, np.abs(states[:, RATE])), 2, 0)
    of_start = of_start[:, :, :3] / K + of_start[:, :, 3:] * x[:, np.newaxis]
    return RestSeries(
        time=averaged(stamps / _DAY_NS),
        start=start,
        temperature=states[:, BOARD],
        state=states,
        direction=v,
        force=x,
        gravity=local,
        residual=size - local,
        by_parameter=_by_parameter(calibration, correction, at, scale),
        by_level=np.hstack((v * K / scale, v * x / calibration.gravity_m_s2)),
        noise=noise + np.maximum(slow, 0.0),
        by_start=(of_start * v[:, np.newaxis]).sum(axis=2),
        lack=v * lack,
        claim=np.sqrt(np.maximum(claim, 0.0) + noise),
        n_windows=sizes,
        reference_temperature=calibration.reference_temperature_c,
    )


def _places(memory: MemorySpec, wanted: MemorySpec) -> tuple[Ints, Ints]:
    """Return the place in `memory` of each state element, and of each lag, of `wanted`."""
    try:
        logged, target = StateLayout(memory).numbers, StateLayout(wanted).numbers
        places = np.array([logged.index(number) for number in target], np.int64)
        return places, np.array([memory.lags.index(lag) for lag in wanted.lags], np.int64)
    except ValueError as error:
        raise RecordingError(
            'the rests were logged with another calibration, and their thermal state does not '
            'contain the lags of this calibration: log rests while the node uses this calibration'
        ) from error


def _grouped(start: Ints, temperature: Floats, force: Floats) -> Ints:
    """
    Return the group of each window, a number from 0; up to 60 consecutive windows form a group,
    and are averaged to one rest.

    The windows of a group belong to one start of the node and differ from the group's first window
    by less than 1e-3 in each component of the force's unit vector, and by less than 1 K on the
    board. The mean of the unit vectors of a group is shorter than 1 by less than 1.5e-6.
    """
    direction = force / np.sqrt((force**2).sum(axis=1, keepdims=True))
    group = np.zeros(len(start), dtype=np.int64)
    first = 0
    for k in range(1, len(start)):
        is_near = np.abs(direction[k] - direction[first]).max() < 1e-3
        is_near &= abs(temperature[k] - temperature[first]) < 1.0
        is_same = is_near and start[k] == start[first] and k - first < 60
        first = first if is_same else k
        group[k] = group[k - 1] + (not is_same)
    return group


class _Geometry(NamedTuple):
    """Thermal states, `Rest.shares`, and u, v and x of this module's docstring, for each rest."""

    states: Floats
    shares: Floats
    u: Floats
    v: Floats
    x: Floats


def _uncertainty(
    calibration: Calibration, correction: Correction, full: SlowUncertainty, at: _Geometry
) -> tuple[Floats, Floats, Floats]:
    """
    Return the variance of |f| due to thermometers and regime, (n,), the variance of |f| that the
    calibration claims, (n,), and the sd of the lack of fit of each axis, (n, 3).
    """
    without = replace(calibration, posterior=None, misalignment_sd=(0.0, 0.0, 0.0))
    settled = at._replace(shares=np.zeros_like(at.shares))
    slow = _variance_along(correction, SlowUncertainty(without, correction), settled)
    claim = _variance_along(correction, full, at)
    weight, unknown = at.states[:, WEIGHT], at.states[:, UNKNOWN]
    regimes = np.array([1.0 - weight, weight])
    unexplained = correction.curves.unexplained(at.states[:, BOARD])
    # The ageing model has terms for the residual sd and the lack of fit: subtract their variances
    # from `slow`, for the set of the present regime or, in an unknown regime, for both sets.
    of_sets = regimes + unknown * regimes[::-1]
    slow -= (at.v.T**2 * (of_sets[:, np.newaxis] * unexplained).sum(axis=0)).sum(axis=0)
    residual = [[a.residual_sd_m_s2**2 for a in part.axes()] for part in calibration.regime_sets()]
    lack = np.maximum(unexplained - np.array(residual)[:, :, np.newaxis], 0.0)
    return slow, claim, np.sqrt((regimes[:, np.newaxis] * lack).sum(axis=0).T)


def _variance_along(correction: Correction, slow: SlowUncertainty, at: _Geometry) -> Floats:
    """Return the variance of |f|, (n,), due to `slow`, thermometers and regime, without noise."""
    columns, x = at.states.T, at.x.T
    line = list(correction.line(columns, columns, slow.at(columns, at.shares.T), 0.0))
    if correction.of_force is None:
        covariance = covariance_at(line[12:], *x)
    else:
        covariance = nonlinear_covariance(line, correction.misalignment, *x)
    i, j = np.triu_indices(3)
    products = at.u[:, i] * at.u[:, j] * np.where(i == j, 1.0, 2.0)
    of_one_sample = (at.v**2 * np.array(correction.noise)).sum(axis=1)
    return np.asarray((products.T * np.array(covariance)).sum(axis=0) - of_one_sample)


def _by_parameter(
    calibration: Calibration, correction: Correction, at: _Geometry, scale: Floats
) -> Floats:
    states, _, u, v, x = at
    columns, layout = states.T, parameter_layout(calibration)
    regressors = correction.curves.regressors(columns, correction.table.values(columns))
    result = np.zeros((len(states), layout.n_parameters))
    for axis, K in enumerate(correction.K[:, 0]):
        on_bias = v[:, [axis]] / scale[:, [axis]]
        blocks = (layout.bias[axis], on_bias), (layout.scale[axis], on_bias * K * x[:, [axis]])
        for k, (block, factor) in enumerate(blocks):
            result[:, block.rows] = regressors[axis + 3 * k].T * factor
    if correction.of_force is not None:
        by_term = v[:, :, np.newaxis] * correction.of_force.regressors(x, columns[BOARD])
        places = slice(layout.nonlinear, layout.misalignment)
        result[:, places] = by_term.reshape(len(x), -1)
    by_tilt = (u[:, 1] * x[:, 0], u[:, 2] * x[:, 0], u[:, 2] * x[:, 1])
    result[:, layout.misalignment :] = -np.transpose(by_tilt)
    return result
