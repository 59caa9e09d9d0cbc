# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns functions that tests apply to simulated runs."""

from dataclasses import replace

import numpy as np
from builders import source_of

from thermo_comp.simulation.campaign import Cyclogram


def of_part(truth, node):
    return truth.temperatures[:, truth.unit.network.nodes.index(node)]


def ideal_regime(run, threshold_k_min=0.02):
    """Whether the board's rate exceeds `threshold_k_min`, at each time of the thermal grid."""
    truth = run.truth
    rate = np.gradient(of_part(truth, truth.unit.board.node), truth.grid_s)
    return np.asarray(np.abs(rate) * 60.0 > threshold_k_min)


def noiseless(unit):
    return replace(unit.with_thermometers(noise_sd=0.0), noise_density=(0.0, 0.0, 0.0))


def rippled(program, seed=1, amplitude=0.1, period=300.0):
    """Add the ripple of a chamber's control to a program: a sine whose phase is a random walk."""
    # The sine has twelve points per period; per period its phase changes with an sd of 0.5 rad.
    time = np.arange(0.0, program.duration_s, period / 12.0)
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    phase += np.cumsum(rng.normal(0.0, 0.5 / np.sqrt(12.0), len(time)))
    wave = amplitude * np.sin(phase + 2.0 * np.pi * time / period)
    both = np.union1d(time, program.time_s)
    air = np.interp(both, program.time_s, program.temperature_c)
    return Cyclogram(tuple(both), tuple(air + np.interp(both, time, wave)))


def slow(bag):
    """Average samples and their times over 4 s, for speed: means over 60 s hardly change."""
    n = round(4.0 / (bag.time_s[1] - bag.time_s[0]))
    whole = len(bag.time_s) // n * n
    time_s, samples = (
        values[:whole].reshape(-1, n, *values.shape[1:]).mean(axis=1)
        for values in (bag.time_s, bag.samples)
    )
    return replace(bag, time_s=time_s, samples=samples)


def sources_of(bags):
    """Make the sources of a fit from bags of strangers_units.py, with board and case readings."""
    sources = []
    for number, bag in enumerate(bags):
        arrays = [bag.time_s, bag.samples]
        for name in ('board', 'case'):
            arrays += bag.temperatures[name]
        arrays[::2] = (10**18 + np.rint(time_s * 1e9).astype(np.int64) for time_s in arrays[::2])
        sources.append(source_of(*arrays, name=f'{number}'))
    return sources
