# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The end of the dynamic regime is chosen by evidence: by the unit, not by the chamber."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from test_fitting import FACES, sources_of
from triads import triad

from thermo_comp.fitting import FitOptions, fit
from thermo_comp.simulation.campaign import Position, parse_cyclogram
from thermo_comp.simulation.run import SimulatedRun, arrays
from thermo_comp.thermal.settings import DetectorSettings
from thermo_comp.thermal.state import WEIGHT
from thermo_comp.thermal.tracker import ThermalTracker
from thermo_comp.typing import Floats
from thermo_comp.unit.gravity import MICRO_G, STANDARD_GRAVITY

Closes = Literal['board', 'case']
#: Soaks long enough for the board to settle.
PROGRAM = parse_cyclogram('20 40min, 45@1.5 120min')
#: Difference of the dynamic set in each axis, far above the 2 ug of a window.
STEP = np.array([120.0, -80.0, 60.0]) * MICRO_G


def weight(record: SimulatedRun, closes: Closes) -> Floats:
    """Weight of the dynamic set at each sample, by a detector with the true sensor settings."""
    tracker = ThermalTracker(replace(DetectorSettings(), closes=closes))
    readings = sorted(
        (stamp, name, value)
        for name, stamps, values in (
            ('board', record.board_stamp_ns, record.board),
            ('case', record.case_stamp_ns, record.case),
        )
        for stamp, value in zip(stamps.tolist(), values.tolist(), strict=True)
    )
    at, result = 0, []
    for stamp in record.accel_stamp_ns.tolist():
        while at < len(readings) and readings[at][0] <= stamp:
            tracker.read(readings[at][1], readings[at][0], readings[at][2])
            at += 1
        result.append(tracker.sample(stamp)[WEIGHT])
    return np.array(result)


@pytest.mark.parametrize(
    ('closes', 'options'),
    [('board', {'model': 'golovach'}), ('case', {'groups': ('curve', 'set', 'board')})],
)
def test_evidence_says_when_the_regime_closes(closes: Closes, options: dict[str, Any]) -> None:
    # A reading every four seconds: the case changes by 0.1 K between them.
    unit = triad('plain', 1).with_thermometers(rate_hz=0.25)
    records = []
    plan = [Position(PROGRAM, up) for up in FACES]
    for record in arrays(unit, plan, 11, rate_hz=2.0):
        step = np.outer(weight(record, closes), STEP * unit.scale_factor)
        records.append(replace(record, counts=record.counts + step))
    result = fit(sources_of(records), FitOptions(gravity=STANDARD_GRAVITY, **options))
    assert result.calibration.detector.closes == closes
    # The remaining difference is when a set starts and ends, as the fit estimates the sensor
    # settings.
    last = result.residuals[-1]
    assert last.fitted.rms < 0.35 * last.raw.rms
