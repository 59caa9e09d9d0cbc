# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The attitude least determined by the positions is named, with the sd of |f| there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from position_helpers import GRAVITY, Rest

from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.coverage import least_known
from thermo_comp.simulation.campaign import positions

#: The repeatability of the mounting is given, as six faces do not determine it.
OPTIONS = FitOptions(gravity=GRAVITY, input='m/s^2', groups=('curve',), mounting_sd=1e-6)
FACES = np.vstack((np.eye(3), -np.eye(3)))


def fitted(rng, ups):
    rests = [Rest(rng, 60.0, level=tuple(GRAVITY * up)) for up in ups]
    return fit([rest.source(name=f'bag{k}') for k, rest in enumerate(rests)], OPTIONS)


def said(result) -> str:
    return next((one.message for one in result.findings if one.name == 'unseen'), '')


def test_faces_leave_the_corners_to_the_prior_of_the_misalignment(rng):
    result = fitted(rng, FACES)
    least = result.least_known
    # Without a posterior there is no claimed sd.
    assert least_known(replace(result.calibration, posterior=None), FACES) is None
    # A corner, or a neighbour in the grid: the variance is flat there.
    np.testing.assert_allclose(np.abs(least.up), 3.0**-0.5, atol=0.05)
    assert least.away_deg == pytest.approx(np.degrees(np.arccos(3.0**-0.5)), abs=4.0)
    # d|f| = g (xy, xz, yz) . (three angles of 1 mrad); noise and curves of the faces add a little.
    assert least.sd_m_s2 == pytest.approx(GRAVITY * 1e-3 / 3.0**0.5, rel=0.2)


def test_a_side_that_was_never_up_is_named(rng):
    ups = positions(30, 4)
    result = fitted(rng, ups[ups[:, 2] > 0.2])
    assert result.least_known.up == (0.0, 0.0, -1.0)
    assert '-z up' in said(result)
    assert said(result) in ' '.join(result.calibration.provenance.notes)


def test_spread_positions_leave_nothing_unseen(rng):
    result = fitted(rng, positions(18, 4))
    assert result.least_known.sd_m_s2 < 2.0 * result.least_known.seen_sd_m_s2
    assert not said(result)
