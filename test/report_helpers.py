# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the small simulated thermal test that the tests of the report use."""

from dataclasses import replace
from functools import cache

import numpy as np
from builders import arrays_of, source_of

from thermo_comp import fitting
from thermo_comp.fitting import FitOptions
from thermo_comp.recording.writer import BagWriter
from thermo_comp.report.evidence import evidence_of_fit
from thermo_comp.report.page import render_report
from thermo_comp.simulation.campaign import parse_cyclogram, positions
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.simulation.run import simulate
from thermo_comp.unit.gravity import STANDARD_GRAVITY

PROGRAM = '15 12min, 30@1.5 14min, 15@1.5 8min'
#: Sample rate [Hz]; at 1 Hz rounding to counts would add a noise of 18 ug/sqrt(Hz), not 6.
RATE_HZ = 2.0
N_POSITIONS = 9
LEFT_OUT_RMS = [1e-6 * STANDARD_GRAVITY * (1 + k) for k in range(N_POSITIONS - 1)]


@cache
def run(position=0):
    """Run one position of a thermostatted unit through 54 minutes of ramps and soaks."""
    return simulate(
        unit_preset('thermostatted', 1), parse_cyclogram(PROGRAM),
        positions(N_POSITIONS, 0)[position], rate_hz=RATE_HZ, temperature_rate_hz=0.2,
        seed=position,
    )  # fmt: skip


@cache
def fitted():
    sources = []
    for position in range(N_POSITIONS):
        record = run(position)
        number = position + 1
        keys = {'sha256': f'{number:064x}', 'serial': 'thermostatted-0001'}
        sources.append(source_of(*arrays_of(record), name=f'{number:02d}.mcap', **keys))
    groups = ('curve', 'set', 'gradient', 'board')
    return fitting.fit(sources, FitOptions(gravity=STANDARD_GRAVITY, groups=groups))


@cache
def evidence():
    """Gather the data of a report; its left-out residuals are invented, the last one is NaN."""
    *others, last = fitted().positions
    pairs = zip(others, LEFT_OUT_RMS, strict=True)
    left_out = [replace(other, left_out_rms=rms) for other, rms in pairs]
    positions = (*left_out, replace(last, left_out_rms=np.nan))
    return evidence_of_fit(replace(fitted(), positions=positions))


@cache
def certificate():
    return render_report(evidence())


def write_bag(path, position=0, frame_id='imu_link', **metadata):
    record = run(position)
    facts = {'serial': 'thermostatted-0001', 'truth': '{}', **metadata}
    with BagWriter(path, metadata=facts) as writer:
        writer.write_temperature('temperature/board', record.board_stamp_ns, record.board)
        writer.write_temperature('temperature/case', record.case_stamp_ns, record.case)
        writer.write_counts('accel/counts', record.accel_stamp_ns, record.counts, frame_id)
    return path
