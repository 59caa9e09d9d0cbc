# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the bag of the fault tests, whose only error is noise, and functions that insert faults."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from builders import GRAVITY, START_NS, axis_set, calibration, regime_set, term

from thermo_comp.online.compensator import Compensator
from thermo_comp.online.status import CompensatorConfig
from thermo_comp.thermal.settings import DetectorSettings, ThermometerSettings
from thermo_comp.unit.calibration import Axes, AxisReference, Unit

RATE_HZ = 12.5
READINGS_HZ = 2.5
DURATION_S = 320.0
#: Time at which the unit stops turning, and its rest begins [s].
STANDS_S = 40.0
RAMP_S = (60.0, 120.0)
RAMP_K_S = 0.1
CASE_LAG_S, BOARD_LAG_S, MEMORY_S = 10.0, 60.0, 20.0
READING_SD = 0.003

#: Counts per m/s^2 of a 24-bit converter, whose rounding step is 0.3 ug.
K = 3e5
FULL_SCALE = 8388607.0
NOISE_SD = 1e-4
BIAS = (18000.0, -15000.0, 16500.0)  # counts, which are 5 to 6 mg
BIAS_SLOPE, BIAS_CURVE = 300.0, 4.0  # counts/K, counts/K^2: 100 ug/K, 1.4 ug/K^2
SCALE_SLOPE = 7e-5
BY_GRADIENT, BY_MEMORY = 150.0, 60.0  # counts per K of (case - board), and of board lag

#: Sd of the lack of fit of static curves [m/s^2]: their error until a ramp is detected.
STATIC_RESIDUAL = 1.5e-4
DYNAMIC_RESIDUAL = 3e-5
#: A published force is wrong if its error exceeds this number of published standard deviations.
SIGMAS = 5.0

CONFIG = CompensatorConfig(transition_time_s=5.0, temperature_timeout_s=20.0, case_timeout_s=10.0,
                           gravity_tolerance_m_s2=0.02)  # fmt: skip

# A message has topic, stamp [ns] and value. Lists of messages are in order of arrival.
Event = tuple[str, int, Any]
Inject = Callable[[list[Event]], list[Event]]


def unit(**changes):
    def set_in(dynamic):
        return axis_set(
            (0.0, BIAS_SLOPE, BIAS_CURVE),
            (1.0, SCALE_SLOPE),
            residual_sd_m_s2=DYNAMIC_RESIDUAL if dynamic else STATIC_RESIDUAL,
        )

    ranges = {'rate_range_k_min': (-8.0, 8.0)}
    sensor = ThermometerSettings(READING_SD, 0.0, 12.0, CASE_LAG_S)
    values = {
        'unit': Unit('F-1', 'counts', FULL_SCALE, 1.0 / RATE_HZ),
        'axes': Axes(*[AxisReference(K, bias) for bias in BIAS]),
        'static': regime_set(*[set_in(False)] * 3, **ranges),
        'dynamic': regime_set(*[set_in(True)] * 3, **ranges),
        'noise_density_m_s2_sqrt_hz': (NOISE_SD / math.sqrt(RATE_HZ),) * 3,
        'response': (
            term('gradient', (BY_GRADIENT,) * 3, during='dynamic', range=(-6.0, 6.0)),
            term('board', (BY_MEMORY,) * 3, tau_s=MEMORY_S),
        ),
        'board_lag_s': BOARD_LAG_S,
        'rest_gradient_range_k': (-0.1, 0.1),
        'detector': DetectorSettings(
            smallest_ramp_k_min=1.0, relaxed_rate_k_min=0.4, dwell_s=5.0, case=sensor,
            board=replace(sensor, lag_s=BOARD_LAG_S),
        ),
        **changes,
    }  # fmt: skip
    return calibration(**values)


def force_at(seconds):
    """Return the true specific force [m/s^2], shape (n, 3): a slow turn, then a rest."""
    angle = 0.02 * np.minimum(seconds, STANDS_S)
    return GRAVITY * np.array([np.sin(angle) * 0.6, np.sin(angle) * 0.8, np.cos(angle)]).T


@dataclass(frozen=True)
class Truth:
    """Times [s], case and board temperatures [degC]; `memory`: board less lagged board [K]."""

    time: np.ndarray
    case: np.ndarray
    board: np.ndarray
    memory: np.ndarray

    def at(self, seconds):
        return tuple(
            np.interp(seconds, self.time, c) for c in (self.case, self.board, self.memory)
        )


def ratios_to_sd(force, covariance, seconds):
    """Divide the errors of forces [m/s^2] at true times [s] by their claimed sd, shape (n, 3)."""
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return np.abs(force - force_at(seconds)) / sd


def truth(ramp_s=RAMP_S, duration_s=DURATION_S):
    """Return temperatures: the case lags the air, the board the case; `memory` as in `Truth`."""
    step = 0.01
    time = np.arange(0.0, duration_s + 1.0, step)
    air = 15.0 + RAMP_K_S * (np.clip(time, *ramp_s) - ramp_s[0])

    def follow(source, lag):
        share = step / lag
        result = np.empty_like(source)
        value = source[0]
        for k, target in enumerate(source.tolist()):
            value += share * (target - value)
            result[k] = value
        return result

    case = follow(air, CASE_LAG_S)
    board = follow(case, BOARD_LAG_S)
    return Truth(time, case, board, board - follow(board, MEMORY_S))


def counts_of(force, case, board, memory):
    """Return the counts for a specific force, Eq. (6) to (9) of Golovach's paper."""
    t = board - 20.0
    drift = BIAS_SLOPE * t + BIAS_CURVE * t**2
    drift += BY_GRADIENT * (case - board) + BY_MEMORY * memory
    scale = K * (1.0 + SCALE_SLOPE * t)
    return force * scale[:, None] + np.array(BIAS) + drift[:, None]


@cache
def bag(rate_hz=RATE_HZ, ramp_s=RAMP_S, duration_s=DURATION_S, start_s=0.0):
    rng = np.random.default_rng(7)
    thermal = truth(ramp_s, duration_s)
    n = round((duration_s - start_s) * rate_hz)
    seconds = start_s + (np.arange(n) + 1) / rate_hz
    counts = counts_of(force_at(seconds), *thermal.at(seconds))
    counts += K * NOISE_SD * rng.standard_normal(counts.shape)
    events = [
        ('counts', START_NS + round(second * 1e9), tuple(row))
        for second, row in zip(seconds.tolist(), np.rint(counts).tolist(), strict=True)
    ]
    times = start_s + np.arange(round((duration_s - start_s) * READINGS_HZ)) / READINGS_HZ
    case, board, _ = thermal.at(times)
    for topic, values in (('board', board), ('case', case)):
        noisy = values + READING_SD * rng.standard_normal(len(values))
        events += [
            (topic, START_NS + round(second * 1e9), value)
            for second, value in zip(times.tolist(), noisy.tolist(), strict=True)
        ]
    return sorted(events, key=lambda event: event[1])


def corrected(events, compensator=None):
    compensator = compensator or Compensator(unit(), CONFIG)
    stamps, rows = [], []
    for topic, stamp_ns, message in events:
        if topic != 'counts':
            compensator.push(topic, stamp_ns, message)
        elif row := compensator.process(stamp_ns, *message):
            stamps.append(stamp_ns)
            rows.append(row)
    return np.array(stamps, np.int64), np.array(rows).reshape(-1, 9)


def seconds_of(stamp_ns):
    return (stamp_ns - START_NS) * 1e-9


def changed(topic, begin_s, end_s, change):
    """Replace each message of a topic from `begin_s` to `end_s` by `change(message)`."""

    def inject(events):
        result = []
        for event in events:
            if event[0] == topic and begin_s <= seconds_of(event[1]) < end_s:
                result += change(event)
            else:
                result.append(event)
        return result

    return inject


def value(topic, begin_s, end_s, change):
    return changed(topic, begin_s, end_s, lambda e: [(e[0], e[1], change(e[2]))])


def stop(topic, begin_s, end_s):
    return changed(topic, begin_s, end_s, lambda _: [])


def frozen(topic, begin_s, end_s):
    """Repeat the last value of a topic from `begin_s` to `end_s`, with new stamps."""
    last = []

    def hold(event):
        last.append(event[2])
        return [(event[0], event[1], last[0])]

    return changed(topic, begin_s, end_s, hold)


def late(topic, delay_s, begin_s, end_s):
    def inject(events):
        def arrival(event):
            seconds = seconds_of(event[1])
            is_late = event[0] == topic and begin_s <= seconds < end_s
            return seconds + delay_s * is_late

        return sorted(events, key=arrival)

    return inject


def shuffled(topic, begin_s, end_s):
    """Exchange each two successive messages of a topic from `begin_s` to `end_s`."""

    def inject(events):
        result = list(events)
        inside = (e[0] == topic and begin_s <= seconds_of(e[1]) < end_s for e in result)
        places = [k for k, is_inside in enumerate(inside) if is_inside]
        for place, other in zip(places[::2], places[1::2], strict=False):
            result[place], result[other] = result[other], result[place]
        return result

    return inject


def chain(*steps):
    def inject(events):
        for step in steps:
            events = step(events)
        return events

    return inject


def shifted(begin_s, by_s):
    def inject(events):
        by_ns = round(by_s * 1e9)
        return [(name, at + by_ns * (seconds_of(at) >= begin_s), v) for name, at, v in events]

    return inject
