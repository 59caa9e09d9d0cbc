# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Commands with unusable inputs end with a message, within limits of time and memory."""

import degenerate
import pytest


@pytest.mark.parametrize(
    ('name', 'command'),
    [
        ('equal stamps', 'replay'),
        pytest.param('jump of a year', 'evaluate', marks=pytest.mark.slow),
        pytest.param('jump from 1970', 'fit', marks=pytest.mark.slow),
        ('reversed stamps', 'fit'), ('stamps of the limits', 'info'), ('one sample', 'fit'),
        ('all zeros', 'fit'), ('readings of one stamp', 'info'),
        pytest.param('all values 1e308', 'report', marks=pytest.mark.slow),
        ('name not UTF-8', 'replay'),
    ],
)  # fmt: skip
def test_a_degenerate_input_ends_with_a_sentence_in_bounded_memory(name, command, tmp_path):
    folder = tmp_path / 'in' / 'unit'
    folder.mkdir(parents=True)
    path = degenerate.INPUTS[name].make(folder)
    out = tmp_path / command
    out.mkdir()
    (out / 'map.yaml').write_text(degenerate.MAP)
    done = degenerate.run(name, command, path, out)
    assert not done.is_bad, done


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('zeros in every second row', '50 % of the samples are exactly zero, between other'),
        ('no acceleration in the messages', '(linear_acceleration_covariance[0] = -1)'),
        ('gravity subtracted', 'gravity is subtracted (linear or free acceleration)'),
        ('samples in g', 'the samples are in g, convert them to m/s^2'),
        ('stamps all zero', 'all samples are stamped 0 s: the driver does not stamp them'),
        ('worn on a wrist', 'as if worn or driven, but must rest in each position'),
        ('a drive in a car', 'worn, driven or shaken?'),
        ('axes not orthogonal', 'the angle between two of the axes is some 60 degrees or less'),
    ],
)
def test_the_message_of_a_refusal_names_its_cause(name, text, tmp_path, cli):
    path = degenerate.INPUTS[name].make(tmp_path)
    failed = cli('fit', path, '--gravity', '9.81', '-o', tmp_path / 'out.yaml', code=1)
    (line,) = [text for text in failed.stderr.splitlines() if ': error: ' in text]
    assert text in line
    # The command has selected the topic by its message type, so the message names the topic.
    assert 'bag.mcap (/imu/data)' in line or name in {'stamps all zero', 'axes not orthogonal'}
