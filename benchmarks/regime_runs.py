# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Runs the detector over ramps and soaks, and measures its CPU time, for benchmarks/regime.py.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from regime_scenes import BOARD_LAG_S, RIPPLE_C, Scene, read, temperatures

from thermo_comp.thermal.regime import Regime, RegimeDetector
from thermo_comp.thermal.settings import DetectorSettings, ThermometerSettings
from thermo_comp.thermal.thermometer import Thermometer
from thermo_comp.typing import Bools, Floats

#: Arguments of `run_ramps`: scene, number of ramps, seed, whether ripple and self-heating exist.
Job = tuple[Scene, int, int, bool]


@dataclass
class Outcome:
    """Onset delays [s] in the ramps of a scene, and numbers of ramps with a wrong flag."""

    delays: list[float]
    missed: int
    flips: int
    early: int
    flagged: float
    n: int


def settings(scene: Scene) -> DetectorSettings:
    """Return detector settings with the scene's noise, quantum, lags and chamber ripple."""
    case = ThermometerSettings(scene.noise_sd, scene.quantum, lag_s=scene.lag_s)
    board = ThermometerSettings(scene.noise_sd, scene.quantum, lag_s=scene.lag_s + BOARD_LAG_S)
    return DetectorSettings(ripple_c=RIPPLE_C, case=case, board=board)


def rng_of(seed: int, purpose: int, scene: Scene) -> np.random.Generator:
    """Return the random generator of a scene; its seed does not depend on the other scenes."""
    return np.random.default_rng([seed, purpose, *(round(1e6 * v) for v in vars(scene).values())])


def regime_flags(scene: Scene, case: Floats, board: Floats) -> npt.NDArray[np.int8]:
    """Return the flag of the detector at each reading: 1 dynamic, 0 static, -1 unknown."""
    detector_settings = settings(scene)
    case_thermometer = Thermometer(detector_settings.case)
    board_thermometer = Thermometer(detector_settings.board)
    detector = RegimeDetector(detector_settings)
    step_ns = round(1e9 / scene.rate_hz)
    flags = np.empty(len(case), np.int8)
    regime = Regime.UNKNOWN
    for k, (c, b) in enumerate(zip(case.tolist(), board.tolist(), strict=True)):
        board_thermometer.update(k * step_ns, b)
        if case_thermometer.update(k * step_ns, c):
            regime = detector.update(k * step_ns, case_thermometer, board_thermometer)
        flags[k] = regime
    return flags


def judge(flags: Iterable[tuple[Floats, Bools]], duration: float) -> Outcome:
    """Return delays, wrong flags and the fraction flagged dynamic in ramps of `duration` s."""
    outcome = Outcome([], 0, 0, 0, 0.0, 0)
    for t, flag in flags:
        outcome.n += 1
        inside = flag[(t >= 0.0) & (t < duration)]
        times = t[(t >= 0.0) & (t < duration)]
        outcome.flagged += float(inside.mean())
        if flag[np.searchsorted(t, 0.0) - 1]:
            outcome.early += 1
            continue
        if not inside.any():
            outcome.missed += 1
            continue
        onset = int(np.argmax(inside))
        outcome.delays.append(float(times[onset]))
        outcome.flips += bool((~inside[onset:]).any())
    outcome.flagged /= max(outcome.n, 1)
    return outcome


def run_ramps(job: Job) -> tuple[Scene, Outcome]:
    """Run the detector over ramps of a scene."""
    scene, n, seed, is_rippled = job
    rng = rng_of(seed, 5, scene)
    # A ramp lasts 2 case lags plus the time of a change by 4 quanta, limited to 40 min .. 2 h.
    edges_s = 60.0 * 4.0 * scene.quantum / scene.ramp_k_min + 2.0 * scene.lag_s
    duration = min(max(edges_s, 2400.0), 7200.0)
    t = np.arange(-2700.0, duration, 1.0 / scene.rate_hz)
    flags: list[tuple[Floats, Bools]] = []
    for _ in range(n):
        case, board = temperatures(scene, t, duration, rng, RIPPLE_C if is_rippled else 0.0)
        found = regime_flags(scene, read(case, scene, rng), read(board, scene, rng))
        flags.append((t, found == Regime.DYNAMIC))
    return scene, judge(flags, duration)


def run_soak(job: tuple[Scene, float, int]) -> tuple[str, int, int, float]:
    """Return sensor, switches to dynamic, all switches, share of time with a known regime."""
    scene, hours, seed = job
    rng = rng_of(seed, 7, scene)
    t = np.arange(0.0, 3600.0 * hours, 1.0 / scene.rate_hz)
    case, board = temperatures(scene, t, 0.0, rng)
    flag = regime_flags(scene, read(case, scene, rng), read(board, scene, rng))
    known = flag[flag >= 0]
    switches = int(np.count_nonzero(np.diff(known)))
    return scene.sensor, int(np.count_nonzero(np.diff(known) == 1)), switches, len(known) / len(t)


def cost() -> dict[str, float]:
    """Return CPU times [us] per reading and per numpy call on a scalar; smallest of 3 runs."""
    scene = Scene(0.5, 900.0, 0.001, 0.0, 1.0)
    rng = np.random.default_rng(0)
    t = np.arange(-7200.0, 7200.0)
    case, board = (read(x, scene, rng).tolist() for x in temperatures(scene, t, 3600.0, rng))
    best = dict.fromkeys(('thermometer', 'thermometer + detector', 'numpy scalar call'), np.inf)

    def keep(name: str, begin: float, n: int) -> None:
        best[name] = min(best[name], (time.process_time() - begin) / n * 1e6)

    value = np.float64(2.0)
    for _ in range(3):
        own = settings(scene)
        case_sensor, board_sensor = Thermometer(own.case), Thermometer(own.board)
        detector = RegimeDetector(own)
        begin = time.process_time()
        for k, reading in enumerate(board):
            board_sensor.update(k * 10**9, reading)
        keep('thermometer', begin, len(board))
        begin = time.process_time()
        for k, reading in enumerate(case):
            case_sensor.update(k * 10**9, reading)
            detector.update(k * 10**9, case_sensor, board_sensor)
        keep('thermometer + detector', begin, len(case))
        begin = time.process_time()
        for _ in range(100_000):
            np.sqrt(value)
        keep('numpy scalar call', begin, 100_000)
    return best
