# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The demonstration does what it says: over real DDS, losing nothing, with the offline run's bits.

"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Cli

from thermo_comp.recording import inspect_recording

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def needs_ros() -> None:
    pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')


def test_end_to_end(tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / 'out'
    data = json.loads(cli('demo', '--out', out, '--json', cwd=ROOT).stdout)
    assert data['messages_in'] == data['messages_out'] == 15407
    assert data['is_equal_to_offline'] is True
    assert data['wall_s'] < data['bag_s'], 'slower than real time'
    topics = inspect_recording(out / 'out.mcap').topics
    (imu,) = (count for name, (_, count) in topics.items() if name.endswith('imu/data_raw'))
    assert imu == 15407
    assert (out / 'report.html').stat().st_size > 10_000
    assert Path(data['figure']).read_bytes().startswith(b'\x89PNG')
    statistics = data['statistics_m_s2']
    micro_g = 9.80665e-6
    for section in ('static', 'dynamic'):
        rms = {name: statistics[name][section]['rms'] / micro_g for name in statistics}
        # The bag's drift is some hundred ug; one polynomial leaves what the memory of the unit
        # does to it while the temperature moves; the quantization of 20 cycles of the converter
        # (340 ug a count, its remainder carried) is below 17 ug.
        assert rms['raw'] > 150.0
        assert rms['node'] < 17.0
        assert rms['node'] < 0.6 * rms['one set'] < 0.6 * rms['raw']


def test_without_sample_bags_it_says_where_to_get_them(tmp_path: Path, cli: Cli) -> None:
    finished = cli('demo', '--bags', tmp_path, code=1, cwd=tmp_path)
    assert 'no sample bags in' in finished.stderr
    assert list(tmp_path.iterdir()) == []
