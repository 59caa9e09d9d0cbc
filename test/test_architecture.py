# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables and file names on the pages about theory and architecture agree with the source."""

import re

import pytest
from conftest import ROOT
from test_layers import LAYERS

from thermo_comp.unit.columns import bank
from thermo_comp.unit.terms import GROUPS

DOCS = ROOT / 'docs'
SOURCES = sorted((ROOT / 'thermo_comp').rglob('*.py'))


def test_the_table_of_packages_on_the_page_equals_that_of_test_layers():
    text = (DOCS / 'architecture.md').read_text()
    rows = re.findall(r'^\| (\d) \| `(\w+)` \|', text, re.MULTILINE)
    assert {room: int(layer) for layer, room in rows} == LAYERS
    drawing = text.partition('```text')[2].partition('```')[0]
    for line in drawing.strip().splitlines():
        layer, _, rooms = line.strip().partition(' ')
        shown = [word for word in re.findall(r'\w+', rooms) if word in LAYERS]
        assert shown, line
        assert {LAYERS[room] for room in shown} == {int(layer)}, line


@pytest.mark.parametrize('page', ['architecture.md', 'theory.md'])
def test_the_files_that_a_page_names_exist(page):
    text = (DOCS / page).read_text()
    for name in re.findall(r'[\w*/]+\.py\b', text):
        places = (ROOT, ROOT / 'thermo_comp', ROOT / 'test')
        # A page names a file by its path, or by its name alone if the folder is named before.
        is_path = any(list(place.glob(name)) for place in places)
        assert is_path or any(path.name == name for path in SOURCES), name


def test_the_table_of_the_response_on_the_page_has_every_group():
    text = (DOCS / 'theory.md').read_text()
    shown = re.findall(r'^\| `(\w+)` \|', text, re.MULTILINE)
    columns = bank(('case',), {'case': -0.5}, (-9.0, 9.0))
    # The group `part` has no columns of its own: its curves are sums of other columns.
    groups = {'part', *(column.group for column in columns)}
    assert shown == [group for group in GROUPS if group in groups]
