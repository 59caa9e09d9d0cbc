# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Links in the README and outputs shown on docs/cli.md are right."""

import re

import pytest
import yaml
from desk_helpers import write_fit_of_the_readme
from readme_helpers import CLI_PAGE, FENCE, README, ROOT, is_alike, shown

from thermo_comp.cli.app import app

pytestmark = pytest.mark.usefixtures('equal_fits_once')


def test_commands_of_the_page_give_the_output_shown(tmp_path, cli, once):
    # The demo is tested in test_cli_demo.
    commands = shown()
    assert list(commands) == ['demo', 'fit', 'evaluate', 'replay', 'info']
    made = once('unit42.yaml', lambda folder: write_fit_of_the_readme(folder / 'unit42.yaml', cli))
    assert is_alike((made / 'unit42.txt').read_text(), commands['fit'][1])
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    (tmp_path / 'unit.yaml').symlink_to(made / 'unit42.yaml')
    for name in ('evaluate', 'replay', 'info'):
        words, expected = commands[name]
        got = cli(*words, cwd=tmp_path).stdout
        assert is_alike(got, expected), f'{" ".join(words)}\n{got}'


def test_commands_in_the_readme_exist():
    known = {c.name or c.callback.__name__ for c in app.registered_commands if c.callback}
    known |= {group.typer_instance.info.name for group in app.registered_groups}
    named = set(re.findall(r'(?:^|^\$ |`)thermo_comp (\w+)', README, re.MULTILINE))
    assert named <= known, named - known
    page = CLI_PAGE.read_text(encoding='utf-8')
    assert {c for c in known if f'`thermo_comp {c}' in page} == known
    makefile = (ROOT / 'Makefile').read_text()
    for target in re.findall(r'^make (\w+)', README, re.MULTILINE):
        assert re.search(rf'^{target}:', makefile, re.MULTILINE), target
    for script in re.findall(r'python (benchmarks/\w+\.py)', README):
        assert (ROOT / script).is_file(), script


def test_the_excerpt_of_a_calibration_on_the_page_is_part_of_the_example():
    page = (ROOT / 'docs' / 'calibration_file.md').read_text(encoding='utf-8')
    (excerpt,) = (yaml.safe_load(text) for kind, text in FENCE.findall(page) if kind == 'yaml')
    example = yaml.safe_load((ROOT / 'config' / 'calibration.example.yaml').read_text())

    def holds(part, whole):
        if not isinstance(part, dict) or not isinstance(whole, dict):
            return part == whole
        return all(key in whole and holds(value, whole[key]) for key, value in part.items())

    assert holds(excerpt, example)


def test_the_readme_is_short_enough():
    lines = README.splitlines()
    assert len(lines) <= 150
    assert [line for line in lines if len(line) > 100 and '|' not in line] == []
