# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Degenerate inputs through the real commands: those that once cost gigabytes, hung or lied.

The whole table, every command on every input, is `benchmarks/degenerate.py`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / 'benchmarks'))

import degenerate


@pytest.mark.parametrize(
    ('name', 'commands'),
    [
        ('jump of a year', ('fit', 'evaluate')),
        ('jump from 1970', ('fit', 'report')),
        ('equal stamps', ('info', 'replay')),
        ('reversed stamps', ('info', 'fit')),
        ('stamps of the limits', ('info',)),
        ('one sample', ('fit',)),
        ('all zeros', ('fit',)),
        ('readings of one stamp', ('info',)),
        ('all values 1e308', ('report',)),
        ('name not UTF-8', ('replay',)),
        ('csv after 2038', ('convert',)),
        ('parquet of large uint64', ('convert',)),
    ],
)
def test_it_ends_with_a_sentence_in_bounded_memory(
    name: str, commands: tuple[str, ...], tmp_path: Path
) -> None:
    folder = tmp_path / 'in' / 'unit'
    folder.mkdir(parents=True)
    path = degenerate.INPUTS[name].make(folder)
    for command in commands:
        out = tmp_path / command
        out.mkdir()
        (out / 'map.yaml').write_text(degenerate.MAP)
        done = degenerate.run(name, command, path, out)
        assert not done.is_bad, done
