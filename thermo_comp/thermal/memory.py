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
from functools import lru_cache
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
#: A lag that keeps less than this has forgotten.
_FADED: Final = 1e-18


@dataclass(frozen=True)
class MemorySpec:
    """
    What a tracker remembers: thermometers by name, the first of which leads the detector; lags as
    (``'board'`` or a sensor, whose gradient it is; time constant [s]), in the order of `inputs`;
    plays as (time constant of the board's lag that it follows, 0 for the board; half-width [K]).
    """

    sensors: tuple[str, ...] = ('case',)
    lags: tuple[tuple[str, float], ...] = ()
    plays: tuple[tuple[float, float], ...] = ()

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
                self._doubt(_coefficients(self.taus, dt_ns)[0], dt_ns * 1e-9, change, sd)
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

    def at(self, stamp_ns: int, value: float) -> tuple[list[float], list[float]]:
        """Give ``u - L`` [K] of each lag at a stamp with the input `value`, and its variance."""
        seen_ns = self.stamp_ns
        if seen_ns is None or stamp_ns <= seen_ns or not self.taus:
            return self.lagging, self.extra
        decays, gains = _coefficients(self.taus, stamp_ns - seen_ns)
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


@lru_cache(maxsize=1024)
def _coefficients(taus: tuple[float, ...], dt_ns: int) -> tuple[list[float], list[float]]:
    """Give what a step keeps of each lag, and what it takes of the input's change."""
    dt = dt_ns * 1e-9
    lost = [-math.expm1(-dt / tau) for tau in taus]
    return [1.0 - part for part in lost], [
        part * (tau / dt) for part, tau in zip(lost, taus, strict=True)
    ]


class ThermalMemory:
    """
    All that a tracker remembers: lags of the board and of each gradient, plays.

    A play is a part of rate-independent hysteresis, of a half-width r [K] on an input v, which it
    follows only where this pushes it: ``P = min(max(P, v - r), v + r)``.
    """

    def __init__(self, spec: MemorySpec) -> None:
        self.spec = spec
        #: The lags of each input, by its name.
        self.banks = {name: LagBank(spec.taus(name)) for name in spec.inputs}
        self.board = self.banks[BOARD_INPUT]
        self.is_empty = not spec.lags and not spec.plays
        #: Of each play the lag that it follows, -1 for the board itself, and its half-width.
        self._inputs = [self.board.taus.index(tau) if tau else -1 for tau, _ in spec.plays]
        self._widths = [width for _, width in spec.plays]
        self._held: list[float] = []

    def forget(self) -> None:
        """Forget everything; each play begins anew in its middle."""
        for bank in self.banks.values():
            bank.forget()
        self._held = []

    def board_step(self, stamp_ns: int, board: float) -> None:
        """Take the next estimate of the board temperature [degC]."""
        self.board.step(stamp_ns, board)
        lagging = self.board.lagging
        inputs = [board if place < 0 else board - lagging[place] for place in self._inputs]
        self._held = [
            v - r if p < v - r else v + r if p > v + r else p
            for p, v, r in zip(self._held or inputs, inputs, self._widths, strict=True)
        ]

    def note_jump(self, change: float) -> None:
        """Doubt everything by a change of the board temperature that was none."""
        for bank in self.banks.values():
            bank.note_jump(change)

    def at(self, stamp_ns: int, board: float, gradients: list[float]) -> list[float]:
        """Give (lag [K], extra variance [K^2]) per lag, then each play less its input [K]."""
        lagging, variances = self.board.at(stamp_ns, board)
        values, extra = lagging, variances
        for name, gradient in zip(self.spec.sensors, gradients, strict=True):
            if (bank := self.banks[name]).taus:
                behind, more = bank.at(stamp_ns, gradient)
                values = values + [gradient - m for m in behind]
                extra = extra + more
        result = [0.0] * (2 * len(values))
        result[0::2] = values
        result[1::2] = extra
        if not self._held:
            return result + [0.0] * len(self._widths)
        for place, p, r in zip(self._inputs, self._held, self._widths, strict=True):
            beside = p - (board if place < 0 else board - lagging[place])
            result.append(-r if beside < -r else r if beside > r else beside)
        return result

    def start_shares(self, stamp_ns: int) -> list[float]:
        """Say what is left at a stamp of each lag's start, 1 to 0, in the order of the spec."""
        banks = self.banks.values()
        return [share for bank in banks for share in bank.start_shares(stamp_ns)]


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
