# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The demonstration plays a bag to the node without loss; node and offline run agree."""

import re
import sys

import pytest
from conftest import ran
from readme_helpers import ROOT, is_alike, shown, shown_of_demo

from thermo_comp.recording.reader import inspect_recording

pytestmark = pytest.mark.usefixtures('equal_fits_once')


@pytest.fixture(autouse=True)
def needs_ros():
    pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')


@pytest.mark.slow
def test_the_demonstration_prints_the_output_shown_on_the_pages(tmp_path, monkeypatch, capsys):
    # The demo runs in this process, so that other tests can use its fits of the sample bags.
    import demo

    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'argv', ['demo.py'])
    monkeypatch.setenv('COLUMNS', '80')
    assert demo.main() == 0
    printed = capsys.readouterr().out
    # The demo must also run as a program of its own.
    script = ROOT / 'benchmarks' / 'demo.py'
    assert '--bags' in ran(sys.executable, script, '--help', check=True).stdout
    assert 'messages in 15407, messages out 15407' in printed
    assert 'bit for bit: yes' in printed
    # The output is shown on docs/cli.md and in part in the README; only the speed differs.
    speed = re.compile(r' in [\d.]+ s, \d+ times real time')
    assert is_alike(speed.sub('', printed), speed.sub('', shown()['demo'][1])), printed
    lines = speed.sub('', printed).splitlines()
    shown_lines = [speed.sub('', line) for line in shown_of_demo()]
    assert [row for row in shown_lines if not any(is_alike(line, row) for line in lines)] == []
    out = tmp_path / 'out'
    topics = inspect_recording(out / 'out.mcap').topics
    (imu,) = (count for name, (_, count) in topics.items() if name.endswith('imu/data_raw'))
    assert imu == 15407
    assert (out / 'report.html').stat().st_size > 10_000
    assert (out / 'figures' / '4_gravity.png').read_bytes().startswith(b'\x89PNG')
    for section in ('static', 'dynamic'):
        rows = re.findall(rf'^{section} +([a-z ]+?) +\d+ +([\d.]+) ', printed, re.MULTILINE)
        assert len(rows) == 4, printed
        raw, node, two_sets, one_set = (float(rms) for _, rms in rows)
        # The node's error must be smaller than with two fits without lags: a common curve of both
        # regimes, and a curve per regime. Noise is below 10 ug.
        assert raw > 150.0
        assert node < 10.0
        assert node < 0.5 * min(one_set, two_sets)
        assert max(one_set, two_sets) < 0.2 * raw
