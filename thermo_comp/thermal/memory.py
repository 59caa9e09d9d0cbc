# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal memory: lags of the board, lags of the neighbours' gradients, play operators.

A lag L of an input u obeys ``dL/dt = (u - L) / tau``. Kept is ``m = u - L``; with u linear between
two readings (first-order hold) its exact step over dt is
``m' = m e + (u' - u) (tau / dt) (1 - e)``, ``e = exp(-dt / tau)``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ..typing import Floats

#: The input of a lag or play that is the board's own temperature.
BOARD_INPUT: Final = 'board'
#: Neighbouring lags are almost one number: to this part of a variance they are not.
START_APART: Final = 3e-4
#: What nobody knows at the start: sd of lags of `START_TAU_S`, the board's and a gradient's [K].
START_TAU_S: Final = 3600.0
BOARD_START_SD: Final = 3.0
NEIGHBOUR_START_SD: Final = 1.0
#: Readings farther apart than this part of a time constant leave the way between them open.
SPARSE_SHARE: Final = 0.1
#: Steps of as many lengths are remembered with their exponentials.
_KNOWN_STEPS: Final = 256
#: A lag that keeps less than this has forgotten.
_FADED: Final = 1e-18


@dataclass(frozen=True)
class MemorySpec:
    """
    What a tracker remembers: thermometers by name, the first of which leads the detector; lags as
    (``'board'`` or a sensor, whose gradient it is; time constant [s]), in the order of `inputs`;
    plays as (time constant of the board's lag that it follows, 0 for the board; half-width [K]).

    Raises ValueError if there is no sensor, a name comes twice, or a lag or play has no input.
    """

    sensors: tuple[str, ...] = ('case',)
    lags: tuple[tuple[str, float], ...] = ()
    plays: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        inputs = self.inputs
        if not self.sensors or len(set(inputs)) < len(inputs):
            raise ValueError(
                f'`sensors` must name at least one thermometer, each once, beside '
                f'{BOARD_INPUT}, got {self.sensors}'
            )
        for name, tau in self.lags:
            if name not in inputs or not tau > 0.0:
                raise ValueError(
                    f'`lags` must be of {", ".join(inputs)} with a time constant above 0, '
                    f'got {name} and {tau}'
                )
        places = [inputs.index(name) for name, _ in self.lags]
        if places != sorted(places) or len(set(self.lags)) < len(self.lags):
            raise ValueError(f'`lags` must stand in the order of {inputs}, each once')
        for tau, width in self.plays:
            if not width > 0.0 or (tau and (BOARD_INPUT, tau) not in self.lags):
                raise ValueError(
                    f'`plays` must have a half-width above 0 and follow the board or one of its '
                    f'lags, got {width} on {tau}'
                )

    @property
    def inputs(self) -> tuple[str, ...]:
        """The board and the sensors, in the order of their lags."""
        return (BOARD_INPUT, *self.sensors)

    def taus(self, name: str) -> tuple[float, ...]:
        """Return the time constants of the lags of one input [s]."""
        return tuple(tau for owner, tau in self.lags if owner == name)


def start_covariance(lags: Sequence[tuple[str, float]]) -> Floats:
    """
    Say what is not known of lags whose input nobody has seen before: covariance (n, n) [K^2].

    The input is taken for a random walk around what is seen first, so that ``P_kl = D tau_k tau_l
    / (tau_k + tau_l)`` between the lags of one input and 0 between those of two. From then on it
    decays by ``exp(-dt / tau_k) exp(-dt / tau_l)``.
    """
    tau = np.array([tau for _, tau in lags])
    names = np.array([name for name, _ in lags])
    sd = np.where(names == BOARD_INPUT, BOARD_START_SD, NEIGHBOUR_START_SD)
    with np.errstate(invalid='ignore'):
        shape = tau[:, np.newaxis] * tau / (tau[:, np.newaxis] + tau)
    is_same = names[:, np.newaxis] == names
    shape[np.diag_indices_from(shape)] *= 1.0 + START_APART
    result: Floats = np.where(is_same, 2.0 / START_TAU_S * sd * sd * shape, 0.0)
    return result


class LagBank:
    """
    The lags of one input; `start_ns` is the first stamp since they were last forgotten,
    `has_extra` tells whether anything but the start is unknown of them.
    """

    def __init__(self, taus: tuple[float, ...]) -> None:
        self.taus = taus
        self._sparse_s = SPARSE_SHARE * min(taus, default=math.inf)
        self._steps: dict[int, tuple[list[float], list[float]]] = {}
        self._nil = [0.0] * len(taus)
        self.forget()

    def forget(self) -> None:
        """Forget the input: what comes next is the first."""
        self.stamp_ns: int | None = None
        self.start_ns: int | None = None
        self.input = 0.0
        self.lagging: list[float] = self._nil
        self.extra: list[float] = self._nil
        self.has_extra = False

    def step(self, stamp_ns: int, value: float, sd: float = 0.0) -> None:
        """Take the input's next value [K], reached in a straight line, wrong by `sd` meanwhile."""
        seen_ns = self.stamp_ns
        if seen_ns is None:
            self.stamp_ns = self.start_ns = stamp_ns
            self.input = value
            return
        if not self.taus:
            return
        change = value - self.input
        dt_ns = stamp_ns - seen_ns
        if dt_ns <= 0:
            self.lagging = [m + change for m in self.lagging]
        else:
            self.lagging, self.extra = self.at(stamp_ns, value)
            self.stamp_ns = stamp_ns
            if sd or dt_ns * 1e-9 > self._sparse_s:
                self._doubt(self._steps[dt_ns][0], dt_ns * 1e-9, change, sd)
        self.input = value

    def _doubt(self, decays: list[float], dt: float, change: float, sd: float) -> None:
        self.has_extra = True
        result = []
        for variance, e, tau in zip(self.extra, decays, self.taus, strict=True):
            grown = variance
            if dt > SPARSE_SHARE * tau:
                # Nobody saw the way between two readings this far apart.
                grown += (change * (1.0 - e)) ** 2
            if sd:
                # Wrong by the same for long: it adds up.
                grown = (math.sqrt(grown) + sd * (1.0 - e)) ** 2
            result.append(grown)
        self.extra = result

    def note_jump(self, change: float) -> None:
        """Doubt the lags by a change of the input that was none."""
        if self.taus:
            self.has_extra = True
            self.extra = [variance + change * change for variance in self.extra]

    def _coefficients(self, dt_ns: int) -> tuple[list[float], list[float]]:
        dt = dt_ns * 1e-9
        lost = [-math.expm1(-dt / tau) for tau in self.taus]
        decays = [1.0 - part for part in lost]
        gains = [part * (tau / dt) for part, tau in zip(lost, self.taus, strict=True)]
        if len(self._steps) >= _KNOWN_STEPS:
            self._steps.clear()
        self._steps[dt_ns] = decays, gains
        return decays, gains

    def at(self, stamp_ns: int, value: float) -> tuple[list[float], list[float]]:
        """Give ``u - L`` [K] of each lag at a stamp with the input `value`, and its variance."""
        seen_ns = self.stamp_ns
        if seen_ns is None or stamp_ns <= seen_ns or not self.taus:
            return self.lagging, self.extra
        dt_ns = stamp_ns - seen_ns
        decays, gains = self._steps.get(dt_ns) or self._coefficients(dt_ns)
        change = value - self.input
        lagging = [
            m * e + change * gain for m, e, gain in zip(self.lagging, decays, gains, strict=True)
        ]
        if not self.has_extra:
            return lagging, self.extra
        return lagging, [v * e * e for v, e in zip(self.extra, decays, strict=True)]

    def start_shares(self, stamp_ns: int) -> list[float]:
        """Say what is left at a stamp of each lag's start, 1 to 0."""
        start_ns = self.start_ns
        age = 0.0 if start_ns is None else max(stamp_ns - start_ns, 0) * 1e-9
        return [math.exp(-age / tau) for tau in self.taus]


class Plays:
    """
    Play operators, the parts of rate-independent hysteresis, of some half-widths r [K] on an input
    v, which they follow only where it pushes them: ``P = min(max(P, v - r), v + r)``.
    """

    def __init__(self, widths: tuple[float, ...]) -> None:
        self.widths = widths
        self._held: list[float] = []

    def forget(self) -> None:
        """Begin anew with the next input, in the middle of every play."""
        self._held = []

    def step(self, v: float) -> None:
        """Take the next value of the input."""
        held = self._held
        if not held:
            self._held = [v] * len(self.widths)
            return
        self._held = [
            v - r if p < v - r else v + r if p > v + r else p
            for p, r in zip(held, self.widths, strict=True)
        ]

    def at(self, v: float) -> list[float]:
        """Give each play less its input, for a value that is not remembered."""
        if not self._held:
            return [0.0] * len(self.widths)
        result = []
        for held, r in zip(self._held, self.widths, strict=True):
            beside = held - v
            result.append(-r if beside < -r else r if beside > r else beside)
        return result


class ThermalMemory:
    """All that a tracker remembers: lags of the board and of each gradient, plays."""

    def __init__(self, spec: MemorySpec) -> None:
        self.spec = spec
        self.board = LagBank(spec.taus(BOARD_INPUT))
        self.neighbours = [LagBank(spec.taus(name)) for name in spec.sensors]
        self.is_empty = not spec.lags and not spec.plays
        places: list[int] = []
        widths: list[list[float]] = []
        for tau, width in spec.plays:
            place = self.board.taus.index(tau) if tau else -1
            if not places or places[-1] != place:
                places.append(place)
                widths.append([])
            widths[-1].append(width)
        #: Plays that follow the same input stand together: index of the lag, -1 for none.
        self._plays = [
            (place, Plays(tuple(some))) for place, some in zip(places, widths, strict=True)
        ]

    def forget(self) -> None:
        """Forget everything."""
        self.board.forget()
        for bank in self.neighbours:
            bank.forget()
        for _, plays in self._plays:
            plays.forget()

    def board_step(self, stamp_ns: int, board: float) -> None:
        """Take the next estimate of the board temperature [degC]."""
        bank = self.board
        bank.step(stamp_ns, board)
        for place, plays in self._plays:
            plays.step(board if place < 0 else board - bank.lagging[place])

    def note_jump(self, change: float) -> None:
        """Doubt everything by a change of the board temperature that was none."""
        self.board.note_jump(change)
        for bank in self.neighbours:
            bank.note_jump(change)

    def at(self, stamp_ns: int, board: float, gradients: list[float]) -> list[float]:
        """Give (lag [K], extra variance [K^2]) per lag, then each play less its input [K]."""
        lagging, variances = self.board.at(stamp_ns, board)
        values, extra = lagging, variances
        for bank, gradient in zip(self.neighbours, gradients, strict=True):
            if bank.taus:
                behind, more = bank.at(stamp_ns, gradient)
                values = values + [gradient - m for m in behind]
                extra = extra + more
        result = [0.0] * (2 * len(values))
        result[0::2] = values
        result[1::2] = extra
        for place, plays in self._plays:
            result += plays.at(board if place < 0 else board - lagging[place])
        return result

    def start_shares(self, stamp_ns: int) -> list[float]:
        """Say what is left at a stamp of each lag's start, 1 to 0, in the order of the spec."""
        result = self.board.start_shares(stamp_ns)
        for bank in self.neighbours:
            result = result + bank.start_shares(stamp_ns)
        return result


def memory_on_grid(
    spec: MemorySpec, step_s: float, board: Floats, gradients: Sequence[Floats]
) -> Floats:
    """
    Remember whole columns at once: what `ThermalMemory` gives on a uniform grid, but for rounding.

    Returns (n, 2 * n_lags + n_plays): (lag [K], 0) per lag, then each play less its input [K].
    """
    inputs = dict(zip(spec.inputs, (board, *gradients), strict=True))
    columns: list[Floats] = []
    behind: dict[float, Floats] = {}
    for name, tau in spec.lags:
        u = inputs[name]
        lost = -math.expm1(-step_s / tau)
        m = _recursion(1.0 - lost, np.diff(u, prepend=u[:1]) * (lost * tau / step_s))
        if name == BOARD_INPUT:
            behind[tau] = m
        columns += [m if name == BOARD_INPUT else u - m, np.zeros_like(u)]
    for tau, width in spec.plays:
        v = board - behind[tau] if tau else board
        columns.append(_play(v, width) - v)
    return np.column_stack(columns) if columns else np.zeros((len(board), 0), dtype=np.float64)


def _recursion(decay: float, driven: Floats) -> Floats:
    """``m[k] = decay m[k - 1] + driven[k]``, by doubling: stretches of 2^j steps at a time."""
    result: Floats = driven.copy()
    shift, factor = 1, decay
    while shift < len(result) and factor > _FADED:
        result[shift:] += factor * result[:-shift]
        shift, factor = 2 * shift, factor * factor
    return result


def _play(v: Floats, width: float) -> Floats:
    held = float(v[0])
    result = []
    for value in v.tolist():
        if held < value - width:
            held = value - width
        elif held > value + width:
            held = value + width
        result.append(held)
    return np.array(result)
