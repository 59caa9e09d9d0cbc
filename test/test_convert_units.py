# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Units are recognised by physics: at rest |a| is gravity in the unit of the table."""

from __future__ import annotations

import numpy as np
import pytest

from thermo_comp.convert.log import believed_unit, contradiction, find_stillness


@pytest.mark.parametrize(
    ('magnitude', 'unit'),
    [
        (1.019, 'g'),  # an MPU6050 with 2 % of bias
        (0.85, 'g'),
        (9.78, 'm/s^2'),
        (10.4, 'm/s^2'),
        (1003.0, 'mg'),
        (2051.0, 'counts'),
        (16100.0, 'counts'),
        (3003.0, 'counts'),
        (0.1, 'unknown'),
        (32.2, 'unknown'),  # ft/s^2
    ],
)
def test_what_a_still_sensor_reads_says_its_unit(magnitude: float, unit: str) -> None:
    believed, reason = believed_unit(magnitude)
    assert believed == unit
    assert f'{magnitude:.4g}' in reason


def test_nothing_is_said_against_what_may_be_true() -> None:
    assert contradiction('g', 1.15, None) is None
    assert contradiction('m/s^2', 9.6, None) is None
    # Values above those of all units are counts of a precise converter.
    assert contradiction('counts', 2941.7, None) is None
    assert contradiction('counts', 2060.0, 2048.0) is None
    # Never at rest: the unit cannot be recognised.
    assert contradiction('g', float('nan'), None) is None


def shaken(rng: np.random.Generator, n: int, scale: float, noise: float) -> np.ndarray:
    """At rest, except for a shaken middle fifth."""
    accel = scale * np.array([0.6, 0.0, 0.8]) + noise * rng.standard_normal((n, 3))
    middle = slice(2 * n // 5, 3 * n // 5)
    accel[middle] += 20.0 * noise * rng.standard_normal((len(accel[middle]), 3))
    return accel


@pytest.mark.parametrize('scale', [1.0, 9.81, 2048.0])
def test_movement_is_found_in_any_unit(rng: np.random.Generator, scale: float) -> None:
    n = 5000
    stamp_ns = np.arange(1, n + 1) * 10_000_000
    found = find_stillness(stamp_ns, shaken(rng, n, scale, 1e-3 * scale))
    # 50 s in cells of half a second: the middle fifth is 20..30 s, on the edges of cells.
    assert [(t0 * 1e-9, t1 * 1e-9) for t0, t1 in found.moving_ns] == [
        (pytest.approx(20.01), pytest.approx(30.01))
    ]
    # The mean over 2 s of noise of 0.1 % has an sd of 0.1 % / sqrt(200).
    assert found.magnitude == pytest.approx(scale, rel=3e-4)
    assert found.noise == pytest.approx(1e-3 * scale, rel=0.1)
    assert found.still_s == pytest.approx(40.0, abs=0.5)


def test_a_sensor_that_shows_no_noise_is_not_moving(rng: np.random.Generator) -> None:
    # Rounded to steps larger than the noise, the value changes by a step from time to time.
    accel = np.tile([0.0, 0.0, 1.0], (1000, 1))
    accel[::97, 0] = 0.1
    found = find_stillness(np.arange(1000) * 10_000_000, accel)
    assert found.moving_ns == ()
    assert found.magnitude == pytest.approx(1.0, rel=1e-3)


def test_too_short_to_tell() -> None:
    found = find_stillness(np.arange(5), np.ones((5, 3)))
    assert np.isnan(found.magnitude)
    assert found.moving_ns == ()
    assert np.isnan(find_stillness(np.arange(1), np.ones((1, 3))).magnitude)
