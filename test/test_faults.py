# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The output agrees with the truth for each row of the fault table, for some also over DDS."""

from copy import deepcopy
from dataclasses import asdict, fields
from functools import cache

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

from fault_bench import Heard, bench, lots
from fault_rig import CONFIG, SIGMAS, bag, corrected, ratios_to_sd, unit
from fault_rows import ROWS, true_seconds

from thermo_comp.online.compensator import Compensator
from thermo_comp.ros.conversion import Traffic
from thermo_comp.ros.diagnostics import findings_of
from thermo_comp.ros.reader import LoadedCalibration
from thermo_comp.unit.calibration_file import save_calibration

#: After recovery the output differs by at most 1 ug [m/s^2] from the output without the fault.
RECOVERED = 9.80665e-6
#: These rows of the fault table depend on the order of messages, so they also run over DDS.
OVER_DDS = (
    *('board late by 5 s', 'counts out of order'),
    *('time jumps back', 'temperatures of another clock'),
)
#: Slow tests: faults of the case that the board's tests cover, and further jumps of time.
SLOW = {
    *('case twice', 'case in whole degrees', 'case is NaN', 'case is infinite'),
    *('case jumps by 40 K and stays', 'case out of order', 'case late by 5 s'),
    *('time jumps forward by 10 min in the soak', 'time jumps forward by a day in the ramp'),
}
CASES = [
    pytest.param(row, id=row.fault, marks=[pytest.mark.slow] * (row.fault in SLOW)) for row in ROWS
]


class Direct:
    """A compensator with the node's diagnostics, which gets lots of messages without DDS."""

    def __init__(self):
        self.compensator = Compensator(unit(), CONFIG)
        self.before = dict.fromkeys((field.name for field in fields(Traffic)), 0)
        self.before |= {'n_in': 0, 'n_failures': 0, **asdict(self.compensator.counters)}
        self.before_ns, self.parts, self.reports = None, [], []

    def take(self, lot):
        compensator, before = self.compensator, self.before
        loaded = LoadedCalibration(compensator.calibration, 'unit.yaml', '')
        self.parts.append(corrected(lot, compensator))
        counters, status = compensator.counters, compensator.status()
        counts = {**before, 'n_in': counters.n_in, **asdict(counters)}
        new = {name: n - before[name] for name, n in counts.items()}
        rate = None
        if self.before_ns is not None and status.stamp_ns > self.before_ns and new['n_in']:
            rate = new['n_in'] / (1e-9 * (status.stamp_ns - self.before_ns))
        self.before, self.before_ns = counts, status.stamp_ns
        notes = list(findings_of(loaded, status, new, rate, silence_s=0.0))
        texts = '; '.join(text for _, text in notes)
        self.reports.append((max((level for level, _ in notes), default=0), texts))

    def heard(self):
        stamps, table = (np.concatenate(columns) for columns in zip(*self.parts, strict=True))
        covariance = table[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3)
        return Heard(stamps, table[:, :3], covariance, self.reports)


@cache
def undisturbed():
    """Return the lots of the bag without a fault, each with the compensator before it."""
    run, result = Direct(), []
    for lot in (*lots(bag()), []):
        result.append((lot, deepcopy(run)))
        if lot:
            run.take(lot)
    return result


def direct(events):
    """Return the output for events; up to the first difference it is taken from `undisturbed`."""
    given, known = list(lots(events)), undisturbed()
    n = next((k for k, lot in enumerate(given) if lot != known[k][0]), len(given))
    run = deepcopy(known[n][1])
    for lot in given[n:]:
        run.take(lot)
    return run.heard()


def wrong(row, heard):
    """Return the times of wrong samples outside `blind`, in which a fault is undetectable."""
    seconds = true_seconds(row, heard.stamp_ns)
    is_wrong = (ratios_to_sd(heard.force, heard.covariance, seconds) > SIGMAS).any(axis=1)
    begin, end = row.blind
    return seconds[is_wrong & ~((begin <= seconds) & (seconds < end))]


@pytest.fixture(scope='module')
def reference():
    return corrected(bag())


@pytest.mark.parametrize('row', CASES)
def test_fault_row_without_dds(row, reference):
    source = row.source or bag()
    heard = direct(row.inject(list(source)))
    seconds = true_seconds(row, heard.stamp_ns)
    assert wrong(row, heard).tolist() == []
    assert len(seconds) >= row.n_least
    for begin, end in row.silent:
        assert not ((begin <= seconds) & (seconds < end)).any(), (begin, end)
    for level, text in row.says:
        assert heard.says(text, level), (level, text, sorted(set(heard.reports)))
    assert np.isfinite(heard.force).all()
    if len(seconds):
        assert np.linalg.eigvalsh(heard.covariance).min() > 0.0
    stamps, table = corrected(source) if row.source else reference
    at, by = row.shift
    moved = heard.stamp_ns - round(by * 1e9) * (seconds >= at)
    late = seconds >= row.recovered
    place = np.searchsorted(stamps, moved[late])
    known = np.isin(moved[late], stamps)
    difference = heard.force[late][known] - table[place[known], :3]
    off = np.abs(difference).max(axis=1, initial=0.0) > RECOVERED
    assert seconds[late][known][off].tolist() == []
    assert late.any() == np.isfinite(row.recovered)


def test_fault_rows_over_dds_give_the_samples_without_dds(tmp_path):
    save_calibration(unit(), tmp_path / 'unit.yaml')
    rows = [row for row in ROWS if row.fault in OVER_DDS]
    assert len(rows) == len(OVER_DDS)
    with bench(tmp_path / 'unit.yaml') as node:
        for row in rows:
            events = row.inject(list(bag(duration_s=130.0)))
            heard, expected = node.play(events), direct(events)
            for name in ('stamp_ns', 'force', 'covariance'):
                got, wanted = getattr(heard, name), getattr(expected, name)
                np.testing.assert_array_equal(got, wanted, row.fault)
            for level, text in row.says:
                assert heard.says(text, level), (row.fault, text, sorted(set(heard.reports)))
