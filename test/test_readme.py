# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the README shows is what a reader gets: its commands run, its tables and links are true.

"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import yaml
from conftest import Cli

from thermo_comp.cli.app import app

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / 'README.md').read_text(encoding='utf-8')
FENCES = re.findall(r'^```(\w+)\n(.*?)^```', README, re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r'-?\d+(?:\.\d+)?(?:e[+-]?\d+)?')


def shown() -> list[tuple[list[str], str]]:
    """
    Return the commands with the output that the README shows for each, in order.

    """
    pairs = []
    for kind, text in FENCES:
        if kind == 'console':
            command, _, output = text.partition('\n')
            pairs.append((shlex.split(command.removeprefix('$ ')), output))
    return pairs


def same_words(got: str, expected: str) -> bool:
    """
    Compare two outputs: words exactly, numbers by a third.

    A figure may differ on another processor (last bits) or another day (speed); its order of
    magnitude may not.

    """
    if NUMBER.sub('#', got).split() != NUMBER.sub('#', expected).split():
        return False
    numbers = zip(NUMBER.findall(got), NUMBER.findall(expected), strict=True)
    return all(abs(float(a) - float(b)) <= max(abs(float(b)) / 3.0, 5.0) for a, b in numbers)


def test_the_shown_commands_give_the_shown_output(tmp_path: Path, cli: Cli) -> None:
    pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    commands = shown()
    assert [words[1] for words, _ in commands] == ['demo', 'fit', 'evaluate', 'replay', 'info']
    for words, expected in commands:
        assert words[0] == 'thermo_comp'
        arguments = [
            str(path)
            for word in words[1:]
            for path in (
                sorted(p.relative_to(tmp_path) for p in tmp_path.glob(word))
                if '*' in word
                else [word]
            )
        ]
        got = cli(*arguments, cwd=tmp_path).stdout
        assert same_words(got, expected), f'{" ".join(words)}\n{got}'


def test_commands_that_are_not_run_here_exist() -> None:
    known = {c.name or c.callback.__name__ for c in app.registered_commands if c.callback}
    named = set(re.findall(r'(?:^|^\$ |`)thermo_comp (\w+)', README, re.MULTILINE))
    assert named <= known, named - known
    assert {c for c in known if f'`thermo_comp {c}' in README} == known
    makefile = (ROOT / 'Makefile').read_text()
    for target in re.findall(r'^make (\w+)', README, re.MULTILINE):
        assert re.search(rf'^{target}:', makefile, re.MULTILINE), target
    for script in re.findall(r'python (benchmarks/\w+\.py)', README):
        assert (ROOT / script).is_file(), script


def test_the_parameters_are_the_node_s() -> None:
    pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')
    from thermo_comp.ros.parameters import parameters_table

    table = re.search(r'<!-- parameters.*?-->\n(.*?)<!-- end', README, re.DOTALL)
    assert table is not None
    assert table[1].strip() == parameters_table().strip()


def test_links_lead_somewhere() -> None:
    for target in re.findall(r'\]\(([^)#]+)\)', README):
        assert (ROOT / target).exists(), target


def test_the_calibration_s_keys_are_those_of_the_example() -> None:
    (excerpt,) = (yaml.safe_load(text) for kind, text in FENCES if kind == 'yaml')
    example = yaml.safe_load((ROOT / 'config' / 'calibration.example.yaml').read_text())

    def holds(part: object, whole: object) -> bool:
        if isinstance(part, dict):
            return isinstance(whole, dict) and all(
                key in whole and holds(value, whole[key]) for key, value in part.items()
            )
        return part == whole

    assert holds(excerpt, example)


def test_it_fits_the_page() -> None:
    assert [line for line in README.splitlines() if len(line) > 100 and '|' not in line] == []
