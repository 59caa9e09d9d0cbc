# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Examples in the help texts work, also with --json and --quiet, and lines fit a terminal."""

import re

import pytest
from conftest import parsed
from node_process import without_middleware
from typer import rich_utils
from typer.main import get_command

from thermo_comp.cli.app import app

pytestmark = pytest.mark.usefixtures('equal_fits_once', 'no_figures')


def leaves(group, prefix=''):
    collected = {}
    for name, command in group.commands.items():
        inner = hasattr(command, 'commands')
        collected |= leaves(command, f'{prefix}{name} ') if inner else {f'{prefix}{name}': command}
    return collected


COMMANDS = leaves(get_command(app))
EXAMPLES = [
    line.strip()
    for name, command in COMMANDS.items()
    for line in re.findall(r'^ +(thermo_comp .*)$', command.help or '', re.MULTILINE)
]
# This example runs in a separate process; the other examples run in the process of the tests.
OF_ITS_OWN = 'thermo_comp evaluate held_out.mcap -c unit42.yaml --tolerance 100ug'
# Other files test these examples; one example of each other command is tested with --json.
TESTED = re.compile(r'thermo_comp (play|report|record --positions) |bags/unit42/\*')
WITH_JSON = {line.split()[1]: line for line in EXAMPLES if not TESTED.search(line)}.values()
QUICK = [line for line in EXAMPLES if line.split()[1] in ('info', 'convert', 'export', 'import')]


def test_every_command_has_an_example_and_every_option_a_help_text():
    for name, command in COMMANDS.items():
        assert any(example.startswith(f'thermo_comp {name} ') for example in EXAMPLES), name
        assert f'thermo_comp {name} ' in (command.help or ''), name
        assert name == 'play' or any('--json' in option.opts for option in command.params), name
        for parameter in command.params:
            assert parameter.name == 'help' or getattr(parameter, 'help', ''), parameter.name


@pytest.mark.parametrize('example', EXAMPLES)
def test_the_example_runs_and_its_lines_are_short_enough(example, desk, program):
    finished = desk.run(example, program if example == OF_ITS_OWN else None)
    assert '\x1b' not in finished.stdout + without_middleware(finished.stderr)
    long = [line for line in finished.stdout.splitlines() if len(line) > 80]
    # A terminal may wrap lines of prose, but not lines of a table.
    assert [line for line in long if not line.startswith('- ') and '  ' in line.strip()] == []


@pytest.mark.parametrize('example', WITH_JSON)
def test_with_json_the_command_prints_one_object_only(example, desk):
    finished = desk.run(f'{example} --json -q')
    assert finished.stderr == ''
    assert parsed(finished.stdout)


@pytest.mark.parametrize('example', QUICK)
def test_with_quiet_the_command_prints_nothing(example, desk):
    finished = desk.run(f'{example} -q')
    assert (finished.stdout, finished.stderr) == ('', '')


@pytest.mark.parametrize('name', COMMANDS)
def test_the_help_prints_complete_names(name, cli, monkeypatch):
    # WHY: a terminal of 80 columns showed `--reference-tempera…`, an incomplete option name.
    monkeypatch.setattr(rich_utils, 'MAX_WIDTH', 80)
    text = cli(*name.split(), '--help').stdout
    assert '…' not in text
    assert max(map(len, text.splitlines())) <= 80
    # WHY: help texts of 86 columns were wrapped: every second line had two words.
    assert max(map(len, COMMANDS[name].help.splitlines())) <= 78
    # The library that prints the help removes text in square brackets, which would leave ' .'.
    assert not re.search(r' \.\s', text)
    assert text == cli(*name.split(), '-h').stdout
    for parameter in COMMANDS[name].params:
        assert all(option in text for option in parameter.opts if option.startswith('-')), text
