# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors are below five claimed sd for faults at any time of a ramp (tested without DDS)."""

import math
import re

import fault_rig as rig
import numpy as np
import pytest
from conftest import ROOT
from fault_rows import ROWS

PAGE = ROOT / 'docs' / 'faults.md'


def both(fault, *span_and_change):
    return rig.chain(*(fault(name, *span_and_change) for name in ('board', 'case')))


@pytest.mark.parametrize(
    'inject',
    [
        *(both(rig.stop, 64.0, 84.0), both(rig.stop, 76.0, 96.0), both(rig.frozen, 112.0, 115.0)),
        rig.value('case', 44.0, 64.0, lambda v: v + 5.0),
        both(rig.value, 68.0, 88.0, lambda v: v + 5.0),
    ],
    ids=['both stop early', 'both stop later', 'both freeze', 'case steps', 'both step'],
)
def test_every_published_error_is_below_five_claimed_sd(inject):
    stamps, table = rig.corrected(inject(rig.bag()))
    seconds = (stamps - rig.START_NS) * 1e-9
    sd = np.sqrt(table[:, [3, 6, 8]])
    off = (np.abs(table[:, :3] - rig.force_at(seconds)) / sd).max(axis=1)
    assert seconds[off > rig.SIGMAS].tolist() == []
    # The published sd is large only while the fault lasts: before the fault it is small.
    assert sd[450:540].max() < 3e-4


def settling_s():
    detector = rig.unit().detector
    ramp = 60.0 * rig.RAMP_K_S
    return rig.BOARD_LAG_S * math.log(ramp / detector.relaxed_rate_k_min) + detector.dwell_s


def ended_s(row):
    """Return the time [s] from which a row's messages equal those of the bag without the fault."""
    at, _ = row.shift
    if math.isfinite(at):
        return at
    clean = row.source or rig.bag()
    faulty = row.inject(list(clean))
    n_same = 0
    while n_same < len(clean) and repr(clean[-1 - n_same]) == repr(faulty[-1 - n_same]):
        n_same += 1
    return rig.seconds_of(clean[-1 - n_same][1])


def test_output_recovers_from_transient_faults_within_the_settling_time():
    rows = [row for row in ROWS if 0 < row.recovered < math.inf]
    back = {row.fault: row.recovered - ended_s(row) for row in rows}
    assert {fault: s for fault, s in back.items() if s > settling_s()} == {}
    page = PAGE.read_text()
    assert f'the settling time is {settling_s():.0f} s' in page
    assert f'after {max(back.values()):.0f} s' in page


def test_the_page_has_every_fault_row_and_names_tests_that_exist():
    named = re.findall(r'`(test_\w+\.py)::(\w+)(?:\[(.+)\])?` \|$', PAGE.read_text(), re.MULTILINE)
    assert [row for *_, row in named if row] == [row.fault for row in ROWS]
    for file, name, _ in named:
        assert f'def {name}(' in (ROOT / 'test' / file).read_text(), (file, name)
