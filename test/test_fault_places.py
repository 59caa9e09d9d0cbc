# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Faults at the places of a ramp where they are worst, through the compensator without DDS.

WHY: a covariance that held for a fault in the middle of a ramp did not for the same fault where
the ramp was about to begin, or where a sensor came back elsewhere.
PROMISE: whatever is published is within five of the standard deviations it was published with.
"""

from __future__ import annotations

import fault_page
import numpy as np
import pytest
from fault_rig import CONFIG, Inject, bag, chain, force_at, frozen, seconds_of, stop, unit, value
from fault_rows import ROWS
from fault_told import TOLD

from thermo_comp.online.compensator import Compensator

SIGMAS = 5.0


@pytest.mark.parametrize(
    'inject',
    [
        chain(stop('board', 64.0, 84.0), stop('case', 64.0, 84.0)),
        chain(stop('board', 76.0, 96.0), stop('case', 76.0, 96.0)),
        chain(frozen('board', 112.0, 115.0), frozen('case', 112.0, 115.0)),
        value('case', 44.0, 64.0, lambda v: v + 5.0),
        chain(
            value('board', 68.0, 88.0, lambda v: v + 5.0),
            value('case', 68.0, 88.0, lambda v: v + 5.0),
        ),
    ],
    ids=['both stop early', 'both stop later', 'both freeze', 'case steps', 'both step'],
)
def test_nothing_wrong_is_published(inject: Inject) -> None:
    compensator = Compensator(unit(), CONFIG)
    seconds, rows = [], []
    for topic, stamp_ns, what in inject(bag()):
        if topic == 'counts':
            row = compensator.process(stamp_ns, *what)
            if row is not None:
                seconds.append(seconds_of(stamp_ns))
                rows.append(row)
        else:
            compensator.push(topic, stamp_ns, what)
    table = np.array(rows)
    sd = np.sqrt(table[:, [3, 6, 8]])
    off = (np.abs(table[:, :3] - force_at(np.array(seconds))) / sd).max(axis=1)
    assert np.array(seconds)[off > SIGMAS].tolist() == []
    # Not by a covariance that covers anything: before the fault it is noise and residual.
    assert sd[450:540].max() < 3e-4


def test_the_page_says_what_the_rows_hold() -> None:
    # python test/fault_page.py
    assert fault_page.PAGE.read_text(encoding='utf-8') == fault_page.page()


def test_every_transient_fault_is_over_within_the_detector_s_settling_time() -> None:
    back = {row.fault: fault_page.back_s(row) for row in ROWS}
    late = {fault: s for fault, s in back.items() if s is not None and s > fault_page.settling_s()}
    assert late == {}


def test_the_tests_that_the_page_names_are_there() -> None:
    folder = fault_page.PAGE.parent.parent / 'test'
    for told in TOLD:
        file, _, name = told.test.partition('::')
        assert f'def {name}(' in (folder / file).read_text(encoding='utf-8'), told.test
