# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The chamber's program: ready-made ones and those typed by the user."""

from __future__ import annotations

import numpy as np
import pytest
from simulation_helpers import rates_k_min

from thermo_comp.simulation.campaign import parse_cyclogram


def test_paper_covers_its_range_in_ramps_and_soaks() -> None:
    program = parse_cyclogram('paper')
    assert min(program.temperature_c) == 5.0
    assert max(program.temperature_c) == 35.0
    ramps = rates_k_min(program)[rates_k_min(program) != 0.0]
    np.testing.assert_allclose(np.abs(ramps), 0.5)


def test_a_typed_program_is_read_as_written() -> None:
    program = parse_cyclogram('20 30min, 35@0.5 1h; -5.5@1.5\n-5.5 90s, 20')
    np.testing.assert_allclose(program.temperature_c, [20, 20, 35, 35, -5.5, -5.5, 20])
    np.testing.assert_allclose(
        np.diff(program.time_s), [1800, 30 * 60, 3600, 40.5 / 1.5 * 60, 90, 25.5 / 1.5 * 60]
    )


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('20, 35@', "step 2 '35@' must read TARGET"),
        ('20@1, 30', "step 1 '20@1' must read"),
        ('20, 30@0 5min', "step 2 '30@0 5min' must read"),
        ('20, 30@0.00 5min', r"step 2 '30@0\.00 5min' must read"),
        ('20, 30 5', "step 2 '30 5' must read"),
        ('nan', "step 1 'nan' must read"),
        ('oven', "step 1 'oven' must read"),
        (' ,\n', 'cyclogram is empty'),
        ('20', 'a ramp or a soak'),
        (f'20, {"9" * 400}', 'finite numbers'),
    ],
)
def test_a_typed_program_that_cannot_be_read_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_cyclogram(text)
