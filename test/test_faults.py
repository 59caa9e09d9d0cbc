# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The fault table: every row over DDS into the real node process, every number against the truth.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')

from fault_bench import Bench, Heard, bench
from fault_rig import CONFIG, bag, force_at, unit
from fault_rows import ROWS, Row, true_seconds

from thermo_comp.online.compensator import Compensator
from thermo_comp.unit.calibration_file import save_calibration

#: Wrong is what is off by more than this many of the standard deviations it was published with.
SIGMAS = 5.0
#: Recovered is what is nearer than this to the undisturbed run: 1 ug.
RECOVERED = 9.80665e-6


@pytest.fixture(scope='module')
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    path = tmp_path_factory.mktemp('faults') / 'unit.yaml'
    save_calibration(unit(), path)
    with bench(path) as started:
        yield started


def wrong(row: Row, heard: Heard) -> np.ndarray:
    """Find the published samples that are wrong, the blind span left out."""
    seconds = true_seconds(row, heard.stamp_ns)
    sd = np.sqrt(np.diagonal(heard.covariance, axis1=1, axis2=2))
    is_wrong = (np.abs(heard.force - force_at(seconds)) > SIGMAS * sd).any(axis=1)
    begin, end = row.blind
    return seconds[is_wrong & ~((begin <= seconds) & (seconds < end))]


def undisturbed(events: list) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and specific force of the run without the fault."""
    compensator = Compensator(unit(), CONFIG)
    stamps, force = [], []
    for topic, stamp_ns, value in events:
        if topic == 'counts':
            row = compensator.process(stamp_ns, *value)
            if row is not None:
                stamps.append(stamp_ns)
                force.append(row[:3])
        else:
            compensator.push(topic, stamp_ns, value)
    return np.array(stamps), np.array(force)


@pytest.fixture(scope='module')
def reference() -> tuple[np.ndarray, np.ndarray]:
    return undisturbed(bag())


@pytest.mark.parametrize('row', ROWS, ids=[row.fault for row in ROWS])
def test_row(row: Row, node: Bench, reference: tuple[np.ndarray, np.ndarray]) -> None:
    source = row.source or bag()
    heard = node.play(row.inject(list(source)))
    seconds = true_seconds(row, heard.stamp_ns)
    assert wrong(row, heard).tolist() == []
    assert len(seconds) >= row.n_least
    for begin, end in row.silent:
        assert not ((begin <= seconds) & (seconds < end)).any(), (begin, end)
    for level, text in row.says:
        assert heard.says(text, level), (level, text, sorted(set(heard.reports)))
    # What is finite and positive definite is sound, wrong or not.
    assert np.isfinite(heard.force).all()
    if len(seconds):
        assert np.linalg.eigvalsh(heard.covariance).min() > 0.0
    stamps, force = undisturbed(source) if row.source else reference
    at, by = row.shift
    moved = heard.stamp_ns - round(by * 1e9) * (seconds >= at)
    late = seconds >= row.recovered
    place = np.searchsorted(stamps, moved[late])
    known = np.isin(moved[late], stamps)
    difference = heard.force[late][known] - force[place[known]]
    off = np.abs(difference).max(axis=1, initial=0.0) > RECOVERED
    assert seconds[late][known][off].tolist() == []
    assert late.any() == np.isfinite(row.recovered)
