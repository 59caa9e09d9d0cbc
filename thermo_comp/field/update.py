# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the update of a calibration from rests in the field, and its score on left-out rests.

A rest determines the error along gravity alone, so rests in few attitudes leave axes undetermined.
An axis is updated only if the rests reduce the sd of a combination of its bias and scale by 40 %
or more, compared with the sd after ageing without rests. Undetermined axes keep their values, and
their sds include ageing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import eigh

from ..errors import FitError
from ..fitting.assembly import parameters_of, with_parameters
from ..text import counted
from ..typing import Bools, Floats
from ..unit.calibration import AXES, Calibration, RegimeSet, parameter_layout
from ..unit.correction import Correction
from ..unit.gravity import ug_text
from ..unit.metrics import means_by
from ..unit.provenance import Provenance, ResidualSummary, Source
from .ageing import Ageing, Change, Model, Solution, learn, solve
from .series import RestSeries, last_rest, valid_since

#: Conclusions that `--allow` excludes: wrong gravity is stated, or another unit logged the rests.
OVERRIDES = ('gravity', 'unit')
# If the RMS of |f| - g at a node start exceeds both limits, another unit logged the rests.
_LARGEST_PART = 1e-3  # RMS / gravity: 1 mg, as after a shock
_LARGEST_SIGMAS = 30.0  # RMS / claimed sd: 30 claimed sds are some milli-g for a poor sensor


@dataclass(frozen=True)
class AxisChange:
    """
    Changes of the bias and scale of an axis by an update, each with its posterior sd; for an axis
    that the rests do not determine, the changes are 0, and the sds include ageing but no rests.

    bias: change of the bias at the mean thermal state of the rests
    scale: relative change of the scale
    curve: change of the bias at the 90 % quantile of the rests' temperatures less the change of
        the bias at the 10 % quantile
    reading: change of the specific force by bias and scale, at the mean force of the rests
    claimed_sd: sd of the specific force that the old calibration claims
    present_sd: sd of the specific force with the old calibration, aged until the last rest
    All values but `scale` and `scale_sd` are in m/s^2.
    """

    axis: str
    is_determined: bool
    bias: float
    bias_sd: float
    scale: float
    scale_sd: float
    curve: float
    curve_sd: float
    reading: float
    reading_sd: float
    claimed_sd: float
    present_sd: float


@dataclass(frozen=True)
class Judged:
    """
    Score of an update on left-out rests.

    over, n: kind of the folds ('days' or 'starts'), and their number
    before, after: RMS of ``|f| - g`` over all folds, with the old calibration and with an update
        by the rests before each fold [m/s^2]
    gain, gain_sd: mean over the folds of the decrease of the mean square of ``|f| - g`` by the
        update, and the standard error of this mean [m^2/s^4]
    n_worse: number of folds whose mean square increases by more than `gain_sd`
    """

    over: str
    n: int
    before: float
    after: float
    gain: float
    gain_sd: float
    n_worse: int

    @property
    def is_better(self) -> bool:
        """Whether `gain` exceeds its standard error."""
        return self.gain > self.gain_sd

    def __str__(self) -> str:
        gained = 'better' if self.is_better else 'not better beyond one standard error'
        return (
            f'left-out {self.over}: |f| - g {ug_text(self.before)} RMS before, '
            f'{ug_text(self.after)} after the update, {gained} ({self.n} {self.over})'
        )


@dataclass(frozen=True)
class Update:
    """An updated calibration with the results of the ageing model."""

    calibration: Calibration
    axis_changes: tuple[AxisChange, ...]
    ageing: Ageing
    changes: tuple[Change, ...]
    judged: Judged
    series: RestSeries
    n_outliers: int
    model: Model
    solution: Solution


def update(
    series: RestSeries,
    calibration: Calibration,
    source: Source | None = None,
    created: str = '',
    ahead: float = 1.0,
    *,
    is_gravity_certain: bool = False,
) -> Update:
    """
    Update a calibration from rests.

    `source`, `created`: source and date for the new file's provenance; `ahead`: time of use after
    the last rest, for which the covariance includes ageing [days]; `is_gravity_certain`: whether
    the stated gravity is certain, so that no jump of gravity is estimated. Raises FitError if the
    rests belong to fewer than three starts of the node.
    """
    n_starts = int(series.start.max()) + 1
    if n_starts < 3:
        raise FitError(
            f'the logs contain rests of {counted(n_starts, "start")} of the node, at least 3 are '
            'needed: each start has a bias offset, and the update is judged on left-out starts'
        )
    _, aged, is_update = valid_since(calibration)
    first, last = float(series.time.min()), float(series.time.max())
    # The covariance includes ageing up to the time `aged`. The random walks of ageing begin at
    # `aged` if it is before the first rest (updated file: the last rest), else at the first rest.
    since = aged if -np.inf < aged < (last if is_update else first) else first
    ageing, model, used = learn(series, calibration, since, is_gravity_certain=is_gravity_certain)
    solution = solve(model, ageing, *_derivatives(calibration), ahead)
    determined, by_axis = _axis_changes(used, calibration, model, solution, ageing)
    judged = _judged(used, model, solution, determined)
    shift, kept = solution.shift * determined, solution.shift * ~determined
    # The shift of a parameter that is not updated remains an error: add the square of this shift.
    covariance = solution.posterior + solution.future + np.outer(kept, kept)
    scatter = float(np.hypot(ageing.turn_on, ageing.rest))
    new = _shifted(calibration, shift, covariance)
    new = replace(
        new,
        static=_with_residual(new.static, scatter, by_axis),
        dynamic=_with_residual(new.dynamic, scatter, by_axis),
        provenance=_with_update(new.provenance, series, judged, source, created),
    )
    n_outliers = len(series) - len(used)
    return Update(new, by_axis, ageing, model.changes, judged, used, n_outliers, model, solution)


def _with_update(
    before: Provenance, series: RestSeries, judged: Judged, source: Source | None, created: str
) -> Provenance:
    """Add the source, the residuals on left-out rests and a note on the update."""
    largest, day = float(np.abs(series.residual).max()), np.datetime64(int(series.time.max()), 'D')
    section = f'left-out {judged.over}'
    residuals = ResidualSummary(section, judged.n, judged.before, judged.after, largest)
    note = (
        f'updated by {int(series.n_windows.sum())} windows at rest up to {day}; before: '
        f'{before.created or "no date"}. {judged}'
    )
    return replace(
        before,
        created=created or before.created,
        tested=last_rest(source) if source else '',
        sources=(*before.sources, *([source] if source else [])),
        residuals=(*before.residuals, residuals),
        notes=(*before.notes, note),
    )


def _derivatives(calibration: Calibration) -> tuple[Floats, Floats]:
    """
    Return derivatives of the n file parameters: by bias, and scale times g, of each axis, (n, 6),
    and by the slope over temperature of the bias of each axis [m/s^2 per K], (n, 3).
    """
    layout, reference_c = parameter_layout(calibration), calibration.reference_temperature_c
    levels, slopes = np.zeros((layout.n_parameters, 6)), np.zeros((layout.n_parameters, 3))
    for axis, reference in enumerate(calibration.axes):
        bias, scale = layout.bias[axis], layout.scale[axis]
        levels[[bias.static, bias.dynamic], axis] = reference.scale_factor
        levels[[scale.static, scale.dynamic], axis + 3] = 1.0 / calibration.gravity_m_s2
        for part, level in zip(calibration.regime_sets(), bias[:2], strict=True):
            function = part.axes()[axis].bias_function
            t = np.linspace(*part.temperature_range_c, 50) - reference_c
            if function.n_free:
                free = np.linalg.lstsq(np.array(function.basis(t)).T, t, rcond=None)[0]
                places = slice(level + 1, level + 1 + function.n_free)
                slopes[places, axis] = reference.scale_factor * free
    return levels, slopes


def _axis_changes(
    series: RestSeries, calibration: Calibration, model: Model, solution: Solution, ageing: Ageing
) -> tuple[Bools, tuple[AxisChange, ...]]:
    """Find the parameters that the rests determine, and list the changes of each axis."""
    layout, correction = parameter_layout(calibration), Correction(calibration)
    coolest, warmest = np.argsort(series.temperature)[[len(series) // 10, -1 - len(series) // 10]]
    states = np.array([series.state.mean(axis=0), series.state[coolest], series.state[warmest]]).T
    regressors = correction.curves.regressors(states, correction.table.values(states))
    determined = np.zeros(layout.n_parameters, dtype=np.bool_)
    gravity, shifts = calibration.gravity_m_s2, []
    weights = series.n_windows / series.n_windows.sum()
    for axis, name in enumerate(AXES):
        bias, scale = layout.bias[axis], layout.scale[axis]
        K = correction.K[axis, 0]
        rows = np.zeros((4, layout.n_parameters))
        rows[0, bias.rows] = regressors[axis][:, 0] / K
        rows[1, scale.rows] = regressors[axis + 3][:, 0] * gravity
        rows[2, bias.rows] = (regressors[axis] @ [0.0, -1.0, 1.0]) / K
        rows[3] = rows[0] + rows[1] * float(weights @ series.force[:, axis]) / gravity
        prior, posterior = (rows @ P @ rows.T for P in (solution.prior, solution.posterior))
        jitter = 1e-12 * np.trace(prior[:2, :2]) * np.eye(2) + 1e-30 * np.eye(2)
        ratio = eigh(posterior[:2, :2], prior[:2, :2] + jitter, eigvals_only=True)[0]
        is_determined = bool(ratio <= 0.6**2)
        determined[bias.static : scale.end] = is_determined
        # Mean square error of the old calibration: posterior variance plus the shift squared.
        error = posterior[3, 3] + float(rows[3] @ solution.shift) ** 2
        residual = calibration.static.axes()[axis].residual_sd_m_s2
        scatter = float(np.hypot(ageing.turn_on, ageing.rest))
        claimed = float(np.hypot(np.sqrt(rows[3] @ model.prior @ rows[3]), residual))
        present = float(np.hypot(np.sqrt(error), max(residual, scatter)))
        change = rows @ solution.shift * is_determined
        sd = np.sqrt(np.maximum(np.diag(posterior if is_determined else prior), 0.0))
        change[1], sd[1] = change[1] / gravity, sd[1] / gravity
        values = [*np.stack((change, sd), axis=1).ravel().tolist(), claimed, present]
        shifts.append(AxisChange(name, is_determined, *values))
    determined[layout.misalignment :] = all(shift.is_determined for shift in shifts)
    return determined, tuple(shifts)


def _judged(series: RestSeries, model: Model, solution: Solution, determined: Bools) -> Judged:
    """Score updates by earlier rests on each day's rests (below 5 days: on each start's rests)."""
    over, labels = 'days', series.day
    if len(np.unique(labels)) < 5:
        over, labels = 'starts', series.start
    rows, squares = model.rows, []
    of_gravity = _gravity_part(series, solution)
    for label in np.unique(labels)[1:]:
        at = labels == label
        earlier = int(np.searchsorted(rows.start, series.start[at].min()))
        shift = np.where(determined, solution.before(earlier), 0.0)
        residual = series.residual[at] - of_gravity[at]
        left = residual - series.by_parameter[at] @ shift
        share = series.n_windows[at] / series.n_windows[at].sum()
        squares.append((float(share @ residual**2), float(share @ left**2)))
    before, after = np.array(squares).T
    gain = before - after
    gain_sd = float(gain.std(ddof=1) / np.sqrt(len(gain))) if len(gain) > 1 else np.inf
    old, new = (float(np.sqrt(square.mean())) for square in (before, after))
    n_worse = int((gain < -gain_sd).sum())
    return Judged(over, len(gain), old, new, float(gain.mean()), gain_sd, n_worse)


def _gravity_part(series: RestSeries, solution: Solution) -> Floats:
    """Return the sum of the estimated jumps of gravity before each rest [m/s^2], (n,)."""
    time = means_by(series.start, series.time)[series.start]
    result = np.zeros(len(series))
    for change, size, _ in solution.gravity:
        # Allow for rounding of the times of starts and jumps.
        result += size * (time > (change.time or 0.0) - 1e-6)
    return result


def refuse_another_unit(result: Update) -> None:
    """Raise FitError if the RMS of |f| - g at a node start exceeds 1 mg and 30 claimed sds."""
    series = result.series
    residual = series.residual - _gravity_part(series, result.solution)
    rms, claim = (np.sqrt(means_by(series.start, part**2)) for part in (residual, series.claim))
    largest = np.maximum(_LARGEST_PART * series.gravity.mean(), _LARGEST_SIGMAS * claim)
    worst = int(np.argmax(rms / largest))
    if rms[worst] > largest[worst]:
        at = np.flatnonzero(series.start == worst)[0]
        day = np.datetime64(int(series.time[at]), 'D')
        raise FitError(
            f'on {day} |f| differs from the gravity {series.gravity[at]:.5f} m/s^2 by '
            f'{ug_text(rms[worst])} RMS, expected at most {ug_text(largest[worst])} for this unit '
            'with ageing: samples of another unit, wrong gravity, or damage (override with '
            '--allow unit)'
        )


def _shifted(calibration: Calibration, shift: Floats, covariance: Floats) -> Calibration:
    """Add a shift to a calibration's parameters; multiply K by 1 + the shift of the scale."""
    layout = parameter_layout(calibration)
    K = np.array([axis.scale_factor for axis in calibration.axes])
    K *= 1.0 + shift[[block.static for block in layout.scale]]
    parameters = parameters_of(calibration)
    if shift.any():
        parameters += shift
    return with_parameters(calibration, K, parameters, covariance)


def _with_residual(part: RegimeSet, scatter: float, changes: Sequence[AxisChange]) -> RegimeSet:
    """Set the residual sd of each axis to `scatter`; an undetermined axis keeps a larger sd."""
    axes: dict[str, Any] = {}
    for axis, change in zip(part.axes(), changes, strict=True):
        sd = scatter if change.is_determined else max(scatter, axis.residual_sd_m_s2)
        axes[change.axis] = replace(axis, residual_sd_m_s2=sd)
    return replace(part, **axes)


def change_texts(result: Update) -> list[str]:
    """Return messages on ageing, jumps, undetermined axes and rests left out."""
    ageing = result.ageing
    lines = [
        f'random walk of the bias {ug_text(ageing.bias)}, of the scale '
        f'{1e6 * ageing.scale / result.calibration.gravity_m_s2:.2g} ppm per root day; '
        f'sd of the bias offset of a start {ug_text(ageing.turn_on)}, of the scatter of rests '
        f'{ug_text(ageing.rest)}'
    ]
    if result.series.by_start.any():
        lines[0] += f'; sd of the lags at a start {ageing.lags:.2g} times the calibrated sd'
    for change in result.changes:
        if change.time is None:
            lines.append('the slopes of the bias over temperature have changed, not only the bias')
        elif change.kind == 'levels':
            day = np.datetime64(int(change.time * 86400.0), 's')
            text = f'bias and scale jumped before {day}: a shock, not ageing'
            if change.may_be_gravity:
                text += (
                    '; or gravity changed, which rests in these attitudes do not distinguish from '
                    'a jump: if the unit was moved, state the gravity of the place (--gravity; '
                    'parameter local_gravity of the node)'
                )
            lines.append(text)
    for change, size, sd in result.solution.gravity:
        time = change.time or 0.0
        stated = result.series.gravity[np.argmin(np.abs(result.series.time - time))]
        lines.append(
            f'from {np.datetime64(int(time * 86400.0), "s")} on |f| is '
            f'{"larger" if size > 0.0 else "smaller"} by {ug_text(abs(size))} +- {ug_text(sd)} '
            f'than before in all attitudes, as if gravity differed from the stated {stated:.5f} '
            'm/s^2: no scale was changed for this; state the gravity of the place (--gravity; '
            'parameter local_gravity of the node) or, if the stated gravity is right, use '
            '--allow gravity'
        )
    undetermined = [change.axis for change in result.axis_changes if not change.is_determined]
    if undetermined:
        lines.append(
            f'the rests do not determine {", ".join(undetermined)}: these axes keep their values, '
            'with an uncertainty that includes ageing; rests in other attitudes would determine '
            'these axes'
        )
    if result.n_outliers:
        lines.append(
            f'{counted(result.n_outliers, "rest")} left out: at a start of the node with |f| - g '
            'more than 5 sd from the prediction by all other rests'
        )
    return lines
