# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The sample bags agree with bags/README.md; the demonstration prints the output on the pages."""

import re
import shlex
import sys

import numpy as np
import pytest
from conftest import ran
from readme_helpers import ROOT, is_alike, shown, shown_of_demo

from thermo_comp.recording.reader import inspect_recording, read_recording

README = (ROOT / 'bags' / 'README.md').read_text()
COMMANDS = [line for line in README.splitlines() if line.startswith('thermo_comp ')]


def test_sample_bags_are_small_and_the_numbers_in_their_readme_are_right():
    assert len(list((ROOT / 'bags').rglob('*.mcap'))) == 10
    assert sum(path.stat().st_size for path in (ROOT / 'bags').rglob('*')) <= 6_000_000
    for name, samples in (('fit/01.mcap', '18 236'), ('held_out.mcap', '15 407')):
        assert len(read_recording(ROOT / 'bags' / name).columns) == int(samples.replace(' ', ''))
        assert samples in README


@pytest.mark.parametrize('command', COMMANDS, ids=['fit', 'held_out'])
def test_the_commands_in_the_readme_of_the_bags_make_the_sample_bags(command, tmp_path, cli):
    arguments = shlex.split(command)[1:]
    # Level 1 is the fastest compression; it does not change the messages.
    arguments[arguments.index('--level') + 1] = '1'
    cli(*arguments, cwd=tmp_path)
    made = sorted((tmp_path / 'bags').rglob('*.mcap'))
    assert made
    for path in made:
        shipped = read_recording(ROOT / path.relative_to(tmp_path))
        anew = read_recording(path)
        new, old = (dict(bag.info.metadata) for bag in (anew, shipped))
        assert new.pop('simulated_by').split()[0] == old.pop('simulated_by').split()[0]
        assert new == old, path.name
        new, old = anew.columns, shipped.columns
        for name in ('accel_stamp_ns', 'accel'):
            np.testing.assert_array_equal(getattr(new, name), getattr(old, name), path.name)
        for name, readings in new.temperatures.items():
            before = old.temperatures[name]
            np.testing.assert_array_equal(readings.stamp_ns, before.stamp_ns, err_msg=path.name)
            np.testing.assert_array_equal(readings.after, before.after, err_msg=path.name)
            # Exponentials may differ in the last bit between processors; rounded counts do not.
            np.testing.assert_allclose(readings.celsius, before.celsius, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures('equal_fits_once')
def test_the_demonstration_prints_the_output_shown_on_the_pages(tmp_path, monkeypatch, capsys):
    pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')
    # The demo runs in this process, so that other tests can use its fits of the sample bags.
    import demo

    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'argv', ['demo.py'])
    monkeypatch.setenv('COLUMNS', '80')
    assert demo.main() == 0
    printed = capsys.readouterr().out
    script = ROOT / 'benchmarks' / 'demo.py'
    assert '--bags' in ran(sys.executable, script, '--help', check=True).stdout
    assert 'messages in 15407, messages out 15407' in printed
    assert 'bit for bit: yes' in printed
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
        # Fits of one or two curves without lags must have twice the error of the node or more.
        assert raw > 150.0
        assert node < 10.0
        assert node < 0.5 * min(one_set, two_sets)
        assert max(one_set, two_sets) < 0.2 * raw
