# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The README is short, and the commands and keys that README and pages name exist."""

import re

import yaml
from readme_helpers import CLI_PAGE, FENCE, README, ROOT

from thermo_comp.cli.app import app


def test_the_readme_is_short_and_its_commands_exist():
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
    lines = README.splitlines()
    assert len(lines) <= 150
    assert [line for line in lines if len(line) > 100 and '|' not in line] == []


def test_the_excerpt_of_a_calibration_on_the_page_is_part_of_the_example():
    page = (ROOT / 'docs' / 'calibration_file.md').read_text(encoding='utf-8')
    (excerpt,) = (yaml.safe_load(text) for kind, text in FENCE.findall(page) if kind == 'yaml')
    example = yaml.safe_load((ROOT / 'config' / 'calibration.example.yaml').read_text())

    def holds(part, whole):
        if not isinstance(part, dict) or not isinstance(whole, dict):
            return part == whole
        return all(key in whole and holds(value, whole[key]) for key, value in part.items())

    assert holds(excerpt, example)
