# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A third thermometer, on a lid that electronics warm, reduces errors that depend on the lid."""

import math
from dataclasses import replace

import numpy as np
import pytest
from simulation_helpers import of_part

from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.sources import fit_sources
from thermo_comp.judging.evaluation import evaluate
from thermo_comp.recording.reader import read_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter
from thermo_comp.replay import replay
from thermo_comp.simulation.campaign import parse_cyclogram, positions
from thermo_comp.simulation.drift import PartEffect
from thermo_comp.simulation.network import AIR, Link, ThermalNetwork
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.simulation.run import simulate
from thermo_comp.simulation.unit import SwitchedLoad
from thermo_comp.unit.calibration_file import load_calibration, save_calibration
from thermo_comp.unit.gravity import STANDARD_GRAVITY

PROGRAM = parse_cyclogram('20 10min, 40@1 25min, 5@1 25min')
MICRO_G = STANDARD_GRAVITY * 1e-6
#: Effect of the lid's temperature on the biases [ug/K], and warming of the lid by the load [K].
LID_UG_K = (12.0, -9.0, 15.0)
LOAD_K = 5.0


def record(path, run):
    truth, rng = run.truth, np.random.default_rng(7)
    with BagWriter(path, metadata={'serial': truth.unit.serial}) as bag:
        bag.write_temperature('temperature/board', run.board_stamp_ns, run.board)
        bag.write_temperature('temperature/case', run.case_stamp_ns, run.case)
        since = (run.case_stamp_ns - run.accel_stamp_ns[0]) * 1e-9 + truth.cycle_s[0]
        lid = np.interp(since, truth.grid_s, of_part(truth, 'lid'))
        lid += 0.01 * rng.standard_normal(len(lid))
        bag.write_temperature('temperature/lid', run.case_stamp_ns, lid)
        bag.write_counts('accel/counts', run.accel_stamp_ns, run.counts.astype(float))
    return path


@pytest.fixture(scope='module')
def runs():
    links = Link(AIR, 'case', 4.0), Link('case', 'board', 0.4), Link('case', 'lid', 0.1)
    network = ThermalNetwork({'case': 800.0, 'board': 120.0, 'lid': 60.0}, links)
    drift = (PartEffect('board', bias=(6.0, 4.0, -8.0)), PartEffect('lid', bias=LID_UG_K))
    load = SwitchedLoad('lid', 0.1 * LOAD_K)
    unit = replace(unit_preset('bare-quartz', 1), network=network, drift=drift, load=load)
    rates = {'rate_hz': 2.0, 'temperature_rate_hz': 0.25}
    return [simulate(unit, PROGRAM, up, seed=k, **rates) for k, up in enumerate(positions(4, 1))]


@pytest.mark.slow
def test_a_third_thermometer_reduces_the_error_to_the_noise(runs, tmp_path):
    *bags, held_out = (record(tmp_path / f'{k}.mcap', run) for k, run in enumerate(runs))
    options = FitOptions(gravity=STANDARD_GRAVITY, groups=('curve', 'gradient', 'board'))
    save_calibration(fit(fit_sources(bags)[0], options).calibration, tmp_path / 'unit.yaml')
    calibration = load_calibration(tmp_path / 'unit.yaml')
    assert calibration.sensors == ('case', 'lid')
    assert any(term.sensor == 'lid' for term in calibration.response)
    errors, spreads = {}, {}
    blind = tuple(
        replace(term, bias=(0.0,) * 3, scale=(0.0,) * 3) if term.sensor == 'lid' else term
        for term in calibration.response
    )
    for sees_lid, tried in ((False, replace(calibration, response=blind)), (True, calibration)):
        output = tmp_path / f'{sees_lid}.mcap'
        replay(held_out, tried, output)
        topics = Topics(imu='imu/data_raw', input='imu')
        corrected = read_recording(output, topics, require=('accel',)).columns
        truth = runs[-1].truth
        index = np.searchsorted(runs[-1].accel_stamp_ns, corrected.accel_stamp_ns)
        error = corrected.accel - truth.specific_force
        use = truth.cycle_s[index] > 600.0
        # The scatter of means over 60 s contains no errors of the constants.
        n = int(use.sum()) // 120 * 120
        means = error[use][:n].reshape(-1, 120, 3).mean(axis=1)
        errors[sees_lid] = float(np.sqrt(np.mean(np.var(means, axis=0)))) / MICRO_G
        judged = evaluate([held_out], [('unit', tried)]).judgements['unit']
        spreads[sees_lid] = float(np.std(np.linalg.norm(judged.windows.force, axis=1))) / MICRO_G
    switched = float(np.sqrt(np.mean(np.square(LID_UG_K)))) * LOAD_K / 2.0
    assert errors[False] > 0.3 * switched
    assert errors[True] < 0.05 * switched
    # If the lid's temperature is known, means over 60 s scatter by little more than their noise.
    noise = float(np.mean(calibration.noise_density_m_s2_sqrt_hz)) / math.sqrt(60.0) / MICRO_G
    assert spreads[False] > 2.0 * noise
    assert spreads[True] < 1.3 * noise
