# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A short soak test: at 2 kHz, with reloads and an onset, every sample is published."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')

import soak


def test_every_sample_comes_out(tmp_path: Path) -> None:
    figures = tmp_path / 'soak.json'
    finished = subprocess.run(
        [sys.executable, ROOT / 'benchmarks' / 'soak.py', '--minutes', '0.04', '--json', figures],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    found = json.loads(figures.read_text())
    counts = {found[name] for name in ('n_sent', 'n_in', 'n_out', 'n_heard')}
    assert counts == {4_800}
    assert found['n_reloads'] >= 1


def test_slope_and_its_error(rng: np.random.Generator) -> None:
    time = np.arange(3600.0)
    values = 100.0 + 7.0 * time / 3600.0 + rng.standard_normal(3600)
    # The start is not counted.
    values[:300] += 50.0
    slope, sd = soak.slope(list(zip(time.tolist(), values.tolist(), strict=True)), 60.0)
    # Sd of a mean of 60, divided by sqrt(sum of squared hours) of 54 windows over 0.9 h.
    assert sd == pytest.approx(1.0 / 60**0.5 / (54 * 0.9**2 / 12) ** 0.5, rel=0.3)
    assert abs(slope - 7.0) < 4.0 * sd
    assert soak.slope([(0.0, 1.0), (1.0, 1.0)], 60.0) is None
