# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns docs/faults.md: the page that says in words what the rows of the fault bench hold.

Run ``python test/fault_page.py`` after changing a row; a test compares.
"""

from __future__ import annotations

import math
from pathlib import Path

from fault_rig import BOARD_LAG_S, RAMP_K_S, bag, seconds_of, unit
from fault_rows import ERROR, ROWS, WARN, Row
from fault_told import ATTACKS, TOLD

PAGE = Path(__file__).resolve().parent.parent / 'docs' / 'faults.md'
_LEVELS = {0: 'OK', WARN: 'WARN', ERROR: 'ERROR'}

HEAD = """\
# Faults

What goes wrong around an accelerometer, how it is injected, what the node and the tools do
about it, what the diagnostics say, and the test that shows it. The page is made from the rows
of the bench with `python test/fault_page.py`; `python -m pytest test/test_faults.py` plays
them.

## How it is tested

A simulated unit turns, rests, is heated through a ramp and rests again (320 s). Its messages go
over DDS into the real node process, which publishes over DDS again. The unit is described by
what its calibration can describe, so every published number can be held against the truth:

- **wrong** is a number that misses the truth by more than five of the standard deviations it
  was published with. None is, in any row, but within the span in which a fault cannot be known
  yet, where the row says so;
- every covariance is finite and positive definite;
- **back** is the time after the end of the fault from which the output is within 1 ug of the
  undisturbed run's; 0 means that it never left it.

The settling time of the regime detector is the time in which the lag of the board takes the
rate of a ramp down to `relaxed_rate_k_min`, and `dwell_s`: lag x ln(ramp / relaxed rate) +
dwell. For the unit of the bench that is {settling:.0f} s ({lag:.0f} s lag, {ramp:.0f} K/min,
{relaxed:g} K/min, {dwell:.0f} s), and every transient fault is back within it, the slowest
after {slowest:.0f} s. It goes with the lag: for a board of 600 s, {of_600:.0f} min. Until then
the covariance covers what is not known yet.

## Faults of the messages

| fault | how it is injected | what the node does | diagnostics | back | test |
|---|---|---|---|---|---|
"""

OTHERS = """
## Faults of processes and files

| fault | how it is injected | what happens | what is said | test |
|---|---|---|---|---|
"""

ATTACKS_HEAD = """
## Attacks beyond the rows

What was tried beside the faults above, how often, and what came of it (`test_attacks.py`):

| attack | how often | what came of it |
|---|---|---|
"""

TAIL = """
## Beyond the table

- Any bytes as a calibration file, any sequence of messages: [properties and
  fuzzing](security.md#properties-and-fuzzing).
- Hours at full rate: [the soak](benchmarks.md#the-soak).
- A calibration that has aged shows while the platform stands: |f| against gravity, with its
  uncertainty, in the diagnostics (`gravity residual`, `gravity residual sd`); WARN beyond five
  standard deviations, and beyond `gravity_tolerance` nothing is published
  (`test_gravity_check.py`).
- A driver that sends the magnitude of its own wrong calibration, a platform that accelerates
  steadily while the temperature rests, and a thermometer that drifts by less than its noise in
  a lag cannot be known from the messages: no row can show them.
"""


def settling_s(lag_s: float = BOARD_LAG_S) -> float:
    """Return the settling time of the detector for a lag of the board."""
    detector = unit().detector
    ramp = 60.0 * RAMP_K_S
    return lag_s * math.log(ramp / detector.relaxed_rate_k_min) + detector.dwell_s


def ended_s(row: Row) -> float:
    """Find the time of the bag after which the messages are the undisturbed ones again."""
    at, _ = row.shift
    if math.isfinite(at):
        return at
    clean = row.source or bag()
    faulty = row.inject(list(clean))
    n_same = 0
    while n_same < len(clean) and repr(clean[-1 - n_same]) == repr(faulty[-1 - n_same]):
        n_same += 1
    return seconds_of(clean[-1 - n_same][1])


def back_s(row: Row) -> float | None:
    """Return the time from the end of a fault to the undisturbed output; None if it stays."""
    if not math.isfinite(row.recovered):
        return None
    if not row.recovered:
        return 0.0
    return max(row.recovered - ended_s(row), 0.0)


def _cell(text: str) -> str:
    return text.replace('|', '\\|')


def _diagnostics(row: Row) -> str:
    told = [f'{_LEVELS[level]} "{text}"' for level, text in row.says]
    return ', '.join(told) or 'counted'


def page() -> str:
    """Return the page."""
    back = {row.fault: back_s(row) for row in ROWS}
    detector = unit().detector
    parts = [
        HEAD.format(
            settling=settling_s(),
            lag=BOARD_LAG_S,
            ramp=60.0 * RAMP_K_S,
            relaxed=detector.relaxed_rate_k_min,
            dwell=detector.dwell_s,
            slowest=max(value for value in back.values() if value is not None),
            of_600=settling_s(600.0) / 60.0,
        )
    ]
    for row in ROWS:
        seconds = back[row.fault]
        when = 'it stays' if seconds is None else f'{seconds:.0f} s'
        begin, end = row.blind
        blind = f'; cannot be known, and is wrong, for {end - begin:.0f} s' if end > begin else ''
        cells = (row.fault, row.injection, row.does + blind, _diagnostics(row), when)
        parts.append(
            f'| {" | ".join(map(_cell, cells))} | `test_faults.py::test_row[{row.fault}]` |\n'
        )
    parts.append(OTHERS)
    for told in TOLD:
        cells = (told.fault, told.injection, told.does, told.says or 'nothing')
        parts.append(f'| {" | ".join(map(_cell, cells))} | `{told.test}` |\n')
    parts.append(ATTACKS_HEAD)
    parts += [f'| {" | ".join(map(_cell, cells))} |\n' for cells in ATTACKS]
    parts.append(TAIL)
    return ''.join(parts)


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
