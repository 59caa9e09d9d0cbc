# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns functions that make small calibrations, samples and readings, for tests of many modules."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np

from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import Compensator
from thermo_comp.online.status import CompensatorConfig
from thermo_comp.unit.calibration import (
    Axes,
    AxisReference,
    AxisSet,
    Calibration,
    RegimeSet,
    ResponseTerm,
    Unit,
    parameter_layout,
)
from thermo_comp.unit.functions import Polynomial
from thermo_comp.unit.posterior import posterior_of
from thermo_comp.unit.rate_bias import Gyroscope, RateCurve, RateSet, RateTerm

GRAVITY = 9.80665
SECOND_NS = 1_000_000_000
#: The beginning of 2026, at which bags of tests begin [ns].
START_NS = 1_767_225_600 * SECOND_NS
FACES = np.vstack((np.eye(3), -np.eye(3)))
#: Indices of the six distinct elements among the nine of a 3 x 3 covariance.
UNIQUE = [0, 1, 2, 4, 5, 8]
#: Settings of a compensator that does not check for stuck samples, nor |f| against gravity.
UNCHECKED = CompensatorConfig(stuck_timeout_s=0.0, gravity_tolerance_m_s2=0.0)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def axis_set(bias=(0.0,), scale=(1.0,), **keys):
    return AxisSet(Polynomial(tuple(bias)), Polynomial(tuple(scale)), **keys)


def regime_set(x=None, y=None, z=None, **keys):
    ranges = {'temperature_range_c': (5.0, 35.0), 'rate_range_k_min': (-1.0, 1.0), **keys}
    return RegimeSet(x=x or axis_set(), y=y or axis_set(), z=z or axis_set(), **ranges)


def equal_axes(scale_factor, bias=0.0):
    return Axes(*[AxisReference(scale_factor, bias)] * 3)


def calibration(**keys):
    """Make a calibration of 300 counts per m/s^2; defaults: constant scale and bias."""
    values = {
        'format_version': 2, 'unit': Unit('T-1', 'counts', 32767.0, 0.01),
        'reference_temperature_c': 20.0, 'gravity_m_s2': GRAVITY,
        'axes': equal_axes(300.0), 'static': regime_set(),
        'dynamic': regime_set(), 'noise_density_m_s2_sqrt_hz': (1e-4, 1e-4, 1e-4), **keys,
    }  # fmt: skip
    return Calibration(**values)


def thermal_calibration():
    """Make a calibration that needs a thermometer, although its bias slope is negligible."""
    return calibration(dynamic=regime_set(z=axis_set((0.0, 1e-12))))


def term(kind, bias=(0.0, 0.0, 0.0), scale=(0.0, 0.0, 0.0), **keys):
    """Make a response term; by default its group is named as its kind, and its range is +-50 K."""
    values = {'group': kind, 'range': (-50.0, 50.0), **keys}
    return ResponseTerm(kind=kind, bias=tuple(bias), scale=tuple(scale), **values)


def rich_calibration():
    """Make a calibration with a posterior and all kinds of terms, on all axes, in both regimes."""

    def axis_of(sign, dynamic):
        size = 2 if dynamic else 1
        bias = (0.0, *(sign * 0.3 / k for k in range(1, size + 1)))
        scale = (1.0, *(sign * 7e-5 / k for k in range(1, size + 1)))
        return axis_set(bias, scale, delta=sign * 0.2 * size, residual_sd_m_s2=1e-5 * size)

    value = calibration(
        axes=Axes(AxisReference(300.0, 5.0), AxisReference(-295.0, -3.0), AxisReference(310, 1)),
        static=regime_set(axis_of(1, False), axis_of(-1, False), axis_of(1, False)),
        dynamic=regime_set(axis_of(-1, True), axis_of(1, True), axis_of(-1, True)),
        misalignment=((1.0, 0.0, 0.0), (1e-3, 1.0, 0.0), (-2e-3, 3e-4, 1.0)),
        misalignment_sd=(1e-6, 1e-6, 2e-6), slow_noise_m_s2_sqrt_h=(1e-5, 2e-5, 1e-5),
        sensors=('case', 'frame'),
        response=(
            term('gradient', (0.5, -0.5, 0.5), (2e-5, 2e-5, 2e-5)),
            term('gradient', (0.1, 0.2, -0.1), (0.0, 1e-6, 0.0), sensor='frame', during='dynamic'),
            term(
                'rate', (3.0, 3.0, -2.0), (1e-3, -1e-3, 1e-3), during='static', range=(-0.1, 0.1),
            ),
            term('board', (0.1, 0.1, 0.2), (1e-6, 2e-6, 1e-6), tau_s=600.0),
            term(
                'board', (-0.05, 0.02, 0.0), (2e-6, -2e-6, 2e-6), tau_s=2400.0, second_tau_s=400.0,
                sensor='frame', sensor_share=0.4,
            ),
            term('gradient_lag', (0.2, -0.1, 0.1), (1e-6, 0.0, -1e-6), tau_s=240.0),
            term('board', (1e-3, -2e-3, 1e-3), group='product', tau_s=600.0, power=1),
            term(
                'gradient_even', (0.3, 0.2, 0.1), (1e-6,) * 3, width_k=1.5, power=1,
                range=(0.0, 1.0),
            ),
            term('play', (0.1, 0.05, -0.1), (1e-6,) * 3, width_k=0.8, range=(-1.0, 1.0)),
            term('bend', (0.2, -0.1, 0.1), tau_s=600.0, knee_k=4.0, range=(0.0, 40.0)),
            term('bend', (0.1, 0.1, 0.2), knee_k=-3.0, range=(0.0, 40.0)),
            term(
                'play', (0.1, -0.1, 0.1), width_k=1.6, tau_s=900.0, second_tau_s=120.0,
                sensor_share=-0.2, range=(-2.0, 2.0),
            ),
        ),
    )  # fmt: skip
    n = parameter_layout(value).n_parameters
    return replace(
        value,
        posterior=posterior_of(1e-8 * np.eye(n) + np.full((n, n), 1e-10)),
        gyroscope=rich_gyroscope(),
    )


def rich_gyroscope():
    """Make a gyroscope with biases, noise, four terms of the response and a posterior."""

    def rate_set(size):
        curve = RateCurve(Polynomial((0.0, *(size / k for k in (1e4, 1e6)))), delta=size * 1e-5)
        return RateSet(curve, RateCurve(Polynomial((0.0, 2e-4))), curve)

    def rate_term(kind, bias, **keys):
        return RateTerm(group=kind, kind=kind, bias=bias, range=(-50.0, 50.0), **keys)

    response = (
        rate_term('gradient', (1e-4, -2e-4, 3e-4)),
        rate_term('board', (3e-4, 1e-4, -1e-4), tau_s=600.0),
        rate_term('board', (-2e-4, 1e-4, 1e-4), tau_s=120.0),
        rate_term('gradient_lag', (1e-4, 0.0, 1e-4), tau_s=240.0, sensor='frame'),
    )
    n = 3 * (2 + len(response)) + 2 * (2 + 1 + 2)
    return Gyroscope(
        bias_rad_s=(0.02, -0.03, 0.01), static=rate_set(1.0), dynamic=rate_set(-2.0),
        noise_density_rad_s_sqrt_hz=(1e-4, 2e-4, 1e-4), slow_noise_rad_s_sqrt_h=(1e-6, 1e-6, 1e-6),
        residual_sd_rad_s=(1e-5, 2e-5, 1e-5), response=response,
        posterior=posterior_of(1e-10 * np.eye(n) + np.full((n, n), 1e-12)),
    )  # fmt: skip


def stream(compensator, events):
    """Process events one by one, with rates of 1e-3 * sample; return rows and sample numbers."""
    rows, index = [], []
    position = 0
    for kind, stamp, value in events:
        if kind == 'accel':
            row = compensator.process(stamp, *map(float, value))
            if row is not None:
                if compensator.corrects_rate:
                    rate = (1e-3 * float(component) for component in value)
                    row = (*row, *compensator.correct_rate(stamp, *rate))
                rows.append(row)
                index.append(position)
            position += 1
        else:
            compensator.push(kind, stamp, value)
    return np.array(rows).reshape(-1, 15 if compensator.corrects_rate else 9), index


def batch(compensator, events):
    """
    Process events (kind, stamp [ns], value) as one block, with angular rates of 1e-3 * sample.
    The kind of an event is 'accel' or the name of a thermometer.
    """
    stamps, samples, readings = [], [], {}
    for kind, stamp, value in events:
        if kind == 'accel':
            stamps.append(stamp)
            samples.append(value)
        else:
            readings.setdefault(kind, []).append((stamp, value, len(stamps)))
    for name, rows in readings.items():
        readings[name] = tuple(map(np.array, zip(*rows, strict=True), (np.int64, float, np.int64)))
    accel = np.array(samples, dtype=float).reshape(-1, 3)
    stamp_ns = np.array(stamps, dtype=np.int64)
    columns = SimpleNamespace(accel_stamp_ns=stamp_ns, accel=accel, temperatures=readings)
    return process_block(compensator, columns, 1e-3 * accel)


def assert_equal_bits(unit, config, events, chunk):
    """Check that blocks of `chunk` events, or one block, give the bits of single events."""
    streamed, whole, cut = (Compensator(unit, config) for _ in range(3))
    rows, index = stream(streamed, events)
    block = batch(whole, events)
    assert block.index.tolist() == index
    pieces = [batch(cut, events[k : k + chunk]) for k in range(0, len(events), chunk)]
    for blocks in ([block], pieces):
        names = ['specific_force', 'covariance', 'stamp_ns']
        names += ['angular_rate', 'angular_rate_variance'] * streamed.corrects_rate
        values = (np.concatenate([getattr(part, name) for part in blocks]) for name in names)
        force, covariance, stamp_ns, *rates = values
        matrices = covariance.reshape(-1, 3, 3)
        np.testing.assert_array_equal(matrices, matrices.transpose(0, 2, 1))
        columns = np.column_stack([force, covariance[:, UNIQUE], *rates])
        np.testing.assert_array_equal(columns, rows)
        np.testing.assert_array_equal(stamp_ns, block.stamp_ns)
    assert streamed.counters == whole.counters == cut.counters
    assert streamed.take_flags() == whole.take_flags() == cut.take_flags()
    return rows, block, (streamed, whole, cut)


def warm(compensator, celsius=20.0, case=None, *, until_s=1, start_s=0, flicker=0.0):
    """Push a board and a case reading each second; `flicker` [K] shows that neither is stuck."""
    for second in range(start_s, until_s):
        noise = flicker * (-1) ** second
        compensator.push('board', second * SECOND_NS, celsius + noise)
        compensator.push('case', second * SECOND_NS, (celsius if case is None else case) + noise)


@dataclass(frozen=True)
class ArrayBlock:
    accel_stamp_ns: np.ndarray
    accel: np.ndarray
    board_stamp_ns: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    board: np.ndarray = field(default_factory=lambda: np.zeros(0))
    case_stamp_ns: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    case: np.ndarray = field(default_factory=lambda: np.zeros(0))
    imu: object = None

    @property
    def temperatures(self):
        pairs = (self.board_stamp_ns, self.board), (self.case_stamp_ns, self.case)
        return {
            name: (stamp_ns, celsius, np.searchsorted(self.accel_stamp_ns, stamp_ns))
            for name, (stamp_ns, celsius) in zip(('board', 'case'), pairs, strict=True)
        }


def source_of(*arrays, name='bag', **keys):
    from thermo_comp.fitting.sources import FitSource

    return FitSource(name, lambda: [ArrayBlock(*arrays)], **keys)


def arrays_of(run, every=1):
    """Return the samples of a simulated run and each `every`-th reading, as arrays for a block."""
    readings = (run.board_stamp_ns, run.board, run.case_stamp_ns, run.case)
    return (run.accel_stamp_ns, run.counts.astype(float), *(part[::every] for part in readings))


def drawn(unit, layout, d):
    """Add `d` to the parameters of a calibration, except for the levels of the scale curves."""

    def moved_by(values, start):
        return tuple(value + d[start + k] for k, value in enumerate(values))

    def moved(regime_set_, start):
        axes = []
        for axis, curves in enumerate(regime_set_.axes()):
            bias, scale = start(layout.bias[axis]), start(layout.scale[axis])
            fs, fc = curves.bias_function, curves.scale_function
            bias_function = fs.with_free(moved_by(fs.free_coefficients, bias + 1), 0.0)
            scale_function = fc.with_free(moved_by(fc.free_coefficients, scale + 1), 1.0)
            axes.append(replace(curves, delta=curves.delta + d[bias], bias_function=bias_function,
                                scale_function=scale_function))  # fmt: skip
        return replace(regime_set_, x=axes[0], y=axes[1], z=axes[2])

    response = tuple(
        replace(
            term,
            bias=tuple(w + d[layout.bias[i].response + k] for i, w in enumerate(term.bias)),
            scale=tuple(w + d[layout.scale[i].response + k] for i, w in enumerate(term.scale)),
        )
        for k, term in enumerate(unit.response)
    )
    return replace(
        unit,
        static=moved(unit.static, lambda block: block.static),
        dynamic=moved(unit.dynamic, lambda block: block.dynamic),
        response=response,
    )
