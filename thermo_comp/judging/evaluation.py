# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the judgement of a calibration on a recording: ``|f| - g`` at rest, section by section.

At rest ``|f|`` is local gravity in any attitude, so the check needs no fixture. The corrected
samples are averaged over windows at rest, and what the window's norm misses gravity by is the
residual; white noise averages out, thermal errors stay.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..online.batch import process_block
from ..online.compensator import Compensator
from ..online.status import CompensatorConfig, Counters
from ..recording import Block, Input, RecordingInfo, Topics, open_recording
from ..recording.stillness import CellAccumulator, Cells, still_intervals
from ..replay import check_unit, input_for
from ..typing import Bools, Floats, Ints
from ..unit.calibration import Calibration
from ..unit.gravity import MICRO_G
from ..unit.metrics import ResidualStatistics, norm_residual, statistics_by_regime

#: Name of the column without thermal correction.
RAW = 'raw'

_CELL_S, _MIN_STILL_S = 0.5, 3.0
# A residual this many times that of the fit's own data is no longer the same unit's.
_SUSPICIOUS_RATIO = 5.0
# Below this a ratio says nothing: quantization and noise of the windows themselves.
_NOISE_SDS = 3.0


@dataclass(frozen=True)
class Evaluation:
    """
    What calibrations leave of ``|f| - g`` on one recording.

    Parameters
    ----------
    info : RecordingInfo
        The recording.
    gravity, window_s : float
        Local gravity used and length of a window.
    start_ns : int
        Stamp that `time` counts from.
    time : ndarray, shape (n,)
        Middle of each window at rest [s].
    is_dynamic : ndarray of bool, shape (n,)
        Regime of each window, as the first calibration's detector saw it.
    board : ndarray, shape (n,)
        Board temperature, NaN where none is near.
    residuals : dict of {str: ndarray, shape (n,)}
        Per model; `RAW` first: scale factor, bias and M at the reference, no temperature.
    claimed_sd : ndarray, shape (n,)
        Standard deviation that the first calibration claims for its residual.
    statistics : dict of {str: dict of {str: ResidualStatistics}}
        Per model and section (``static``, ``dynamic``, ``all``).
    counters : dict of {str: Counters}
        Per calibration.
    findings : tuple of str
        What speaks against the first calibration; empty when it holds.
    notes : tuple of str
        What the judgement does not reach.

    """

    info: RecordingInfo
    gravity: float
    window_s: float
    start_ns: int
    time: Floats
    is_dynamic: Bools
    board: Floats
    residuals: dict[str, Floats]
    claimed_sd: Floats
    statistics: dict[str, dict[str, ResidualStatistics]]
    counters: dict[str, Counters]
    findings: tuple[str, ...]
    notes: tuple[str, ...] = ()


def evaluate(
    path: str | Path,
    calibrations: Sequence[tuple[str, Calibration]],
    *,
    gravity: float | None = None,
    window_s: float = 10.0,
    config: CompensatorConfig | None = None,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    serial: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> Evaluation:
    """
    Judge one or more calibrations on a recording.

    Parameters
    ----------
    path : str or Path
        The recording.
    calibrations : sequence of (str, Calibration)
        Models and their names; the first decides the sections and is the one that is judged.
    gravity : float or None, optional
        Local gravity where the recording was made; the first calibration's by default.
    window_s : float, optional
        Length of a window [s].
    config : CompensatorConfig or None, optional
        The node's settings.
    topics : Topics or None, optional
        Names of the inputs.
    input : {'auto', 'counts', 'imu'}, optional
        What is read; by default what the first calibration is for.
    serial : str or None, optional
        See `replay.check_unit`.
    progress : callable or None, optional
        Called with the fraction read.

    Returns
    -------
    Evaluation
        Residuals, statistics and findings.

    Raises
    ------
    ValueError
        If there is no calibration, or `window_s` is not positive.
    RecordingError
        If the recording cannot be read, or never rests.
    CalibrationError
        If a calibration is for another unit.

    """
    if not calibrations:
        raise ValueError('`calibrations` must hold at least one')
    if not 0.0 < window_s < np.inf:
        raise ValueError(f'`window_s` must be positive, got {window_s}')
    _, judged = calibrations[0]
    gravity = judged.gravity_m_s2 if gravity is None else gravity
    models = {
        RAW: _Model(None, judged, window_s),
        **{
            name: _Model(Compensator(calibration, config), calibration, window_s)
            for name, calibration in calibrations
        },
    }
    with open_recording(
        path, topics, input_for(judged, input), require=('accel', 'board')
    ) as reader:
        info = reader.info
        for _, calibration in calibrations:
            check_unit(calibration, info, serial)
        total = max(info.topics[reader.topics['accel']][1], 1)
        cells, flags, board = _run(models, reader.blocks(), total, judged, progress)
    windows = _common_windows(models, cells, window_s, str(path))
    first = models[calibrations[0][0]]
    time: Floats = np.asarray((windows + 0.5) * window_s, dtype=np.float64)
    is_dynamic = _regime_at(flags, first.start_ns, time)
    residuals = {
        name: norm_residual(model.mean(windows), gravity) for name, model in models.items()
    }
    statistics = {
        name: statistics_by_regime(residual, is_dynamic) for name, residual in residuals.items()
    }
    claimed_sd = first.claimed_sd(windows, judged)
    near_board = _nearest(board, first.start_ns, time, window_s)
    return Evaluation(
        info=info,
        gravity=gravity,
        window_s=window_s,
        start_ns=first.start_ns,
        time=time,
        is_dynamic=is_dynamic,
        board=near_board,
        residuals=residuals,
        claimed_sd=claimed_sd,
        statistics=statistics,
        counters={
            name: model.compensator.counters
            for name, model in models.items()
            if model.compensator is not None
        },
        findings=_findings(judged, statistics, calibrations[0][0], claimed_sd),
        notes=_notes(judged, near_board),
    )


def joined(parts: Sequence[Evaluation], calibration: Calibration) -> Evaluation:
    """
    Judge one calibration on several recordings as one.

    Parameters
    ----------
    parts : sequence of Evaluation
        What each recording told, with the same models and windows.
    calibration : Calibration
        The first of the models.

    Returns
    -------
    Evaluation
        Windows of all, one after another; recording and start are the first one's, the counters
        are added up.

    """
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    is_dynamic = np.concatenate([part.is_dynamic for part in parts])
    residuals = {
        name: np.concatenate([part.residuals[name] for part in parts]) for name in first.residuals
    }
    statistics = {
        name: statistics_by_regime(residual, is_dynamic) for name, residual in residuals.items()
    }
    claimed_sd = np.concatenate([part.claimed_sd for part in parts])
    board = np.concatenate([part.board for part in parts])
    names = [field.name for field in fields(Counters)]
    counters = {
        model: Counters(
            **{name: sum(getattr(part.counters[model], name) for part in parts) for name in names}
        )
        for model in first.counters
    }
    judged = next(iter(first.counters))
    return replace(
        first,
        time=np.concatenate([part.time for part in parts]),
        is_dynamic=is_dynamic,
        board=board,
        residuals=residuals,
        claimed_sd=claimed_sd,
        statistics=statistics,
        counters=counters,
        findings=_findings(calibration, statistics, judged, claimed_sd),
        notes=_notes(calibration, board),
    )


@dataclass
class _Model:
    """
    Window sums of one model's output while the blocks stream by.

    """

    compensator: Compensator | None
    calibration: Calibration
    window_s: float
    start_ns: int = 0
    _ids: list[Ints] = field(default_factory=list)
    _sums: list[Floats] = field(default_factory=list)

    def add(self, block: Block) -> list[tuple[int, bool]]:
        if self.compensator is None:
            self._sum(block.accel_stamp_ns, self._constant(block.accel), None)
            return []
        corrected = process_block(self.compensator, block)
        self._sum(corrected.stamp_ns, corrected.specific_force, corrected.covariance)
        return self.compensator.take_flags()

    def _constant(self, samples: Floats) -> Floats:
        axes = (self.calibration.axes.x, self.calibration.axes.y, self.calibration.axes.z)
        bias = np.array([axis.bias for axis in axes])
        K = np.array([axis.scale_factor for axis in axes])
        M = np.array(self.calibration.misalignment)
        return np.asarray((samples - bias) / K @ M.T)

    def _sum(self, stamp_ns: Ints, force: Floats, covariance: Floats | None) -> None:
        if not len(stamp_ns):
            return
        ids = (stamp_ns - self.start_ns) // round(self.window_s * 1e9)
        first = np.flatnonzero(np.concatenate(([True], ids[1:] != ids[:-1])))
        columns = np.empty((len(force), 13))
        columns[:, 0] = 1.0
        columns[:, 1:4] = force
        columns[:, 4:] = 0.0 if covariance is None else covariance
        self._ids.append(ids[first])
        self._sums.append(np.add.reduceat(columns, first, axis=0))

    def finish(self) -> None:
        ids = np.concatenate(self._ids) if self._ids else np.empty(0, np.int64)
        sums = np.concatenate(self._sums) if self._sums else np.empty((0, 13))
        unique, place = np.unique(ids, return_inverse=True)
        total = np.zeros((len(unique), 13))
        np.add.at(total, place, sums)
        self._ids, self._sums = [unique], [total]

    @property
    def windows(self) -> tuple[Ints, Floats]:
        return self._ids[0], self._sums[0]

    def _rows(self, windows: Ints) -> Floats:
        ids, sums = self.windows
        return sums[np.searchsorted(ids, windows)]

    def mean(self, windows: Ints) -> Floats:
        rows = self._rows(windows)
        return rows[:, 1:4] / rows[:, :1]

    def claimed_sd(self, windows: Ints, calibration: Calibration) -> Floats:
        """
        Project the published covariance on the mean force, its white part averaged down.

        """
        rows = self._rows(windows)
        n = rows[:, 0]
        up = rows[:, 1:4] / np.linalg.norm(rows[:, 1:4], axis=1, keepdims=True)
        covariance = (rows[:, 4:] / n[:, None]).reshape(-1, 3, 3)
        total = np.einsum('ni,nij,nj->n', up, covariance, up)
        density = np.array(calibration.noise_density_m_s2_sqrt_hz)
        white = (up**2) @ (density**2 / calibration.unit.cycle_time_s)
        return np.asarray(np.sqrt(np.maximum(total - white, 0.0) + white / n))


def _run(
    models: dict[str, _Model],
    blocks: Iterable[Block],
    total: int,
    judged: Calibration,
    progress: Callable[[float], None] | None,
) -> tuple[Cells, list[tuple[int, bool]], list[tuple[Ints, Floats]]]:
    cells = CellAccumulator(_CELL_S, judged.unit.full_scale)
    flags: list[tuple[int, bool]] = []
    board: list[tuple[Ints, Floats]] = []
    n_read = 0
    for block in blocks:
        if n_read == 0 and len(block):
            for model in models.values():
                model.start_ns = int(block.accel_stamp_ns[0])
        is_first = True
        for name, model in models.items():
            found = model.add(block)
            if name != RAW and is_first:
                flags += found
                is_first = False
        cells.add(block.accel_stamp_ns, block.accel)
        board.append((block.board_stamp_ns, block.board))
        n_read += len(block)
        if progress is not None:
            progress(n_read / total)
    for model in models.values():
        model.finish()
    return cells.finish(), flags, board


def _common_windows(models: dict[str, _Model], cells: Cells, window_s: float, path: str) -> Ints:
    """
    Find the windows that lie at rest as a whole and are full in every model.

    """
    common: Ints = models[RAW].windows[0]
    for model in models.values():
        ids, sums = model.windows
        full = ids[sums[:, 0] >= 0.9 * np.median(sums[:, 0])] if len(ids) else ids
        common = np.intersect1d(common, full)
    still = still_intervals(cells, _MIN_STILL_S)
    start, end = common * window_s, (common + 1) * window_s
    at_rest = np.zeros(len(common), dtype=np.bool_)
    for lower, upper in still:
        begin = float(cells.index[lower]) * cells.cell_s
        stop = float(cells.index[upper - 1] + 1) * cells.cell_s
        at_rest |= (start >= begin) & (end <= stop)
    if not at_rest.any():
        raise RecordingError(
            f'no window of {window_s:g} s at rest was corrected: nothing to judge', path=path
        )
    return common[at_rest]


def _regime_at(flags: list[tuple[int, bool]], start_ns: int, time: Floats) -> Bools:
    if not flags:
        return np.zeros(len(time), dtype=np.bool_)
    stamps = (np.array([stamp for stamp, _ in flags], dtype=np.int64) - start_ns) * 1e-9
    values = np.array([value for _, value in flags], dtype=np.bool_)
    place = np.searchsorted(stamps, time, side='right') - 1
    return np.asarray(values[np.maximum(place, 0)] & (place >= 0))


def _nearest(
    readings: list[tuple[Ints, Floats]], start_ns: int, time: Floats, window_s: float
) -> Floats:
    stamps = np.concatenate([stamp for stamp, _ in readings])
    values = np.concatenate([value for _, value in readings])
    use = np.isfinite(values)
    order = np.argsort(stamps[use], kind='stable')
    at = (stamps[use][order] - start_ns) * 1e-9
    values = values[use][order]
    if not len(at):
        return np.full(len(time), np.nan)
    place = np.clip(np.searchsorted(at, time), 1, max(len(at) - 1, 1))
    left = np.minimum(place - 1, len(at) - 1)
    right = np.minimum(place, len(at) - 1)
    closer = np.where(np.abs(at[left] - time) <= np.abs(at[right] - time), left, right)
    near = np.abs(at[closer] - time) <= max(window_s, 60.0)
    return np.where(near, values[closer], np.nan)


def _findings(
    judged: Calibration,
    statistics: dict[str, dict[str, ResidualStatistics]],
    name: str,
    claimed_sd: Floats,
) -> tuple[str, ...]:
    findings = []
    noise = float(np.sqrt(np.mean(claimed_sd**2)))
    raw, corrected = statistics[RAW]['all'], statistics[name]['all']
    if corrected.rms > raw.rms and corrected.rms > _NOISE_SDS * noise:
        findings.append(
            f'it makes |g| worse: {corrected.micro_g.rms:.0f} ug RMS after, '
            f'{raw.micro_g.rms:.0f} before; is it the calibration of this unit?'
        )
    for row in judged.provenance.residuals:
        now = statistics[name].get(row.section)
        if now is None or row.section == 'all' or not now.n:
            continue
        limit = max(_SUSPICIOUS_RATIO * row.rms_m_s2, _NOISE_SDS * noise)
        if now.rms > limit:
            findings.append(
                f'{row.section}: {now.micro_g.rms:.0f} ug RMS, the fit left '
                f'{row.rms_m_s2 / MICRO_G:.0f}; another unit, or it has drifted: fit anew'
            )
    return tuple(findings)


def _notes(judged: Calibration, board: Floats) -> tuple[str, ...]:
    notes = []
    ranges = (judged.static.temperature_range_c, judged.dynamic.temperature_range_c)
    lower, upper = min(low for low, _ in ranges), max(high for _, high in ranges)
    known = board[np.isfinite(board)]
    outside = (known < lower) | (known > upper)
    if outside.any():
        notes.append(
            f'{outside.mean():.0%} of the windows lie outside the calibrated {lower:.1f}..'
            f'{upper:.1f} degC (they reach {np.min(known):.1f}..{np.max(known):.1f}): no residual '
            'there speaks for the unit, only for the extrapolation'
        )
    if not judged.provenance.residuals:
        notes.append(
            'the calibration does not say what its fit left: it is held to its own claims alone'
        )
    return tuple(notes)
