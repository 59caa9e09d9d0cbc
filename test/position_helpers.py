# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns simulated rests of a sensor, in the form that a fit reads."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from builders import ArrayBlock

from thermo_comp.fitting.sources import FitSource

GRAVITY = 9.80665
MG = GRAVITY * 1e-3
START_NS = 1_700_000_000_000_000_000


@dataclass
class Imu:
    """The columns of Imu messages that the search for jumps reads."""

    angular_velocity: np.ndarray

    @property
    def angular_velocity_covariance(self):
        return np.zeros((len(self.angular_velocity), 9))

    linear_acceleration_covariance = angular_velocity_covariance


def source(accel, gyro=None, name='log'):
    """Make a source of samples at 100 Hz, without temperatures."""
    stamp_ns = START_NS + np.arange(len(accel)) * 10_000_000
    block = ArrayBlock(stamp_ns, accel, imu=None if gyro is None else Imu(gyro))
    return FitSource(name, lambda: [block])


@dataclass
class Rest:
    """A sensor at rest with specific force `level`; its board cools from `warm` by `fall`."""

    rng: np.random.Generator
    duration_s: float = 600.0
    rate_hz: float = 25.0
    level: tuple[float, float, float] = (0.0, 0.0, GRAVITY)  # specific force [m/s^2]
    sd: float = 3.0 * MG  # noise of a sample [m/s^2]
    warm: float = 35.0  # board temperature at the start [degC]
    fall: float = 20.0  # total cooling of the board [K]
    pace_s: float = 200.0  # time constant of the cooling [s]
    quantum: float = 0.0  # step of the board's readings [K]

    def __post_init__(self):
        n = round(self.duration_s * self.rate_hz)
        self.time = np.arange(n) / self.rate_hz
        self.accel = np.array(self.level) + self.sd * self.rng.standard_normal((n, 3))
        self.gyro = 0.002 * self.rng.standard_normal((n, 3))
        self.board_time = np.arange(0.0, self.duration_s, 1.0)

    def temperature(self, time):
        return self.warm - self.fall * (1.0 - np.exp(-time / self.pace_s))

    def add(self, vector, from_s, to_s=np.inf):
        self.accel[(self.time >= from_s) & (self.time < to_s)] += np.asarray(vector)

    def source(self, n_blocks=1, with_gyro=False, name='rest'):
        stamp_ns = START_NS + np.rint(self.time * 1e9).astype(np.int64)
        board_ns = START_NS + np.rint(self.board_time * 1e9).astype(np.int64)
        noise = np.random.default_rng(7).standard_normal(len(self.board_time))
        board = self.temperature(self.board_time) + 0.02 * noise
        board = np.rint(board / self.quantum) * self.quantum if self.quantum else board
        cuts = np.linspace(0, len(stamp_ns), n_blocks + 1).astype(int)
        blocks = []
        for first, last in pairwise(cuts.tolist()):
            begin = stamp_ns[first] if first else 0
            end = stamp_ns[last] if last < len(stamp_ns) else np.iinfo(np.int64).max
            use = (board_ns >= begin) & (board_ns < end)
            rows = slice(first, last)
            imu = Imu(self.gyro[rows]) if with_gyro else None
            readings = (board_ns[use], board[use])
            blocks.append(ArrayBlock(stamp_ns[rows], self.accel[rows], *readings, imu=imu))
        return FitSource(name, lambda: blocks)
