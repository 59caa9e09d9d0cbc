# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The sample bags agree with bags/README.md: size, content, and the commands that make them."""

import shlex

import numpy as np
import pytest
from conftest import ROOT

from thermo_comp.recording.reader import read_recording

README = (ROOT / 'bags' / 'README.md').read_text()
COMMANDS = [line for line in README.splitlines() if line.startswith('thermo_comp ')]
SHIPPED = sorted((ROOT / 'bags').rglob('*.mcap'))


def test_sample_bags_are_small_and_the_numbers_in_their_readme_are_right():
    assert len(SHIPPED) == 10
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
        # Only the version in `simulated_by` may differ between shipped and new bags.
        own, theirs = (dict(bag.info.metadata) for bag in (anew, shipped))
        assert own.pop('simulated_by').split()[0] == theirs.pop('simulated_by').split()[0]
        assert own == theirs, path.name
        new, old = anew.columns, shipped.columns
        for name in ('accel_stamp_ns', 'accel'):
            np.testing.assert_array_equal(getattr(new, name), getattr(old, name), path.name)
        for name, readings in new.temperatures.items():
            before = old.temperatures[name]
            np.testing.assert_array_equal(readings.stamp_ns, before.stamp_ns, err_msg=path.name)
            np.testing.assert_array_equal(readings.after, before.after, err_msg=path.name)
            # Exponentials may differ in the last bit between processors; rounded counts do not.
            np.testing.assert_allclose(readings.celsius, before.celsius, rtol=1e-12)
