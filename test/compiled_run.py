# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Runs an eventful day through the compensator and saves all that comes out, to the bit.

    python compiled_run.py OUT.npz

Which core runs is a matter of the path: `test_compiled` compares the files of both.

"""

from __future__ import annotations

import copy
import pickle
import sys
from dataclasses import replace

import numpy as np
from builders import SECOND_NS, columns_from_events, rich_calibration

from thermo_comp import is_compiled
from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import Compensator, CompensatorConfig
from thermo_comp.online.snapshot import take_snapshot
from thermo_comp.thermal.settings import DetectorSettings, ThermometerSettings
from thermo_comp.thermal.tracker import tracker as thermal

START_NS = 1_767_225_600 * SECOND_NS
#: A sensor of its own noise, one whose quantum hides it, one of whole degrees.
QUANTA = {'smooth': 0.0, 'cells': 0.0625, 'degrees': 1.0}
N_SECONDS = 4900


def reading(second, lag, quantum, rng):
    """Give a temperature of a soak, a ramp of 1 K/min and a soak."""
    value = 12.0 + min(max(second - 1900.0 - lag, 0.0), 900.0) / 60.0
    value += 0.005 * rng.standard_normal()
    return round(value / quantum) * quantum if quantum else value


def events_of(quantum):
    """List what arrives: readings that fail in every way, samples that must not go out."""
    rng = np.random.default_rng(11)
    events = []
    jumped = 0.0
    for second in range(N_SECONDS):
        # At the end the bag loops: the stamps go back by more than half an hour.
        stamp = START_NS + (second if second < 4600 else second - 2500) * SECOND_NS
        board, case = (reading(second, lag, quantum, rng) for lag in (200.0, 0.0))
        if second == 3000:
            board = float('nan')
        if second == 3010:
            case += 40.0
        if 3050 <= second < 3120:
            case = 27.0
        if second >= 3500:
            jumped = 15.0
        # Readings come with jitter, and both are lost for a while.
        late = int(rng.integers(0, 30_000_000))
        if not 3200 <= second < 3300:
            events.append(('case', stamp + late, case))
        if not 3250 <= second < 3360:
            events.append(('board', stamp + late // 2, board + jumped))
        n = 200 if 3600 <= second < 3606 else 10
        for k in range(n):
            sample = np.rint((20.0, -300.0, 3022.0) + 0.4 * rng.standard_normal(3))
            if 3700 <= second < 3708:
                sample = (21.0, -300.0, 3020.0)
            elif 3800 <= second < 3850:
                sample = sample - (0.0, 0.0, 900.0)
            elif second == 3900:
                sample = [(0.0, 0.0, 0.0), (40000.0, 0.0, 0.0), (1.0, float('nan'), 2.0)][k % 3]
            back = 300_000_000 if second == 4000 and k == 5 else 0
            events.append(('accel', stamp + k * SECOND_NS // n - back, sample))
    return events


def status_row(compensator):
    """Give what diagnostics see as text: a float's text has all its bits."""
    return repr(take_snapshot(compensator))


def streamed(calibration, events):
    """Run sample by sample, with the settings and the calibration changed on the way."""
    compensator = Compensator(calibration)
    rows, texts = [], []
    for n, (kind, stamp, value) in enumerate(events):
        if kind == 'accel':
            row = compensator.process(stamp, *map(float, value))
            rows.append((np.nan,) * 9 if row is None else row)
        elif kind == 'board':
            compensator.push_board(stamp, value)
        else:
            compensator.push_case(stamp, value)
        if n % 2500 == 0:
            texts.append(status_row(compensator))
        if n == 33_000:
            compensator.reconfigure(CompensatorConfig(transition_time_s=90.0))
        if n == 36_000:
            compensator.swap(replace(calibration, gravity_m_s2=9.81))
    return np.array(rows), [*texts, status_row(compensator), repr(compensator.take_flags())]


def in_blocks(calibration, events):
    """Run block by block."""
    compensator = Compensator(calibration)
    rows, texts = [], []
    for first in range(0, len(events), 7000):
        block = process_block(compensator, columns_from_events(events[first : first + 7000]))
        rows.append(np.column_stack((block.index, block.specific_force, block.covariance)))
        texts.append(status_row(compensator))
    return np.concatenate(rows), [*texts, repr(compensator.take_flags())]


def main() -> None:
    """Run all and save it."""
    is_in_c = 'thermo_comp._kernel' in sys.modules
    is_made = not thermal.__file__.endswith('.py')
    result = {'is_compiled': np.array([is_compiled(), is_made, is_in_c])}
    for name, quantum in QUANTA.items():
        sensor = ThermometerSettings(quantum_c=quantum)
        detector = DetectorSettings(case=sensor, board=replace(sensor, lag_s=700.0))
        calibration = replace(rich_calibration(), detector=copy.deepcopy(detector))
        # A fleet's workers get their calibrations this way.
        calibration = pickle.loads(pickle.dumps(calibration))  # noqa: S301
        assert calibration.detector == detector
        events = events_of(quantum)
        for way, run in (('stream', streamed), ('batch', in_blocks)):
            rows, texts = run(calibration, events)
            result[f'{name}_{way}'] = rows.view(np.uint64)
            result[f'{name}_{way}_texts'] = np.array(texts)
    np.savez(sys.argv[1], **result)


if __name__ == '__main__':
    main()
