# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Imports follow the layers, and the pages on architecture and theory agree with the source."""

from __future__ import annotations

import ast
import re
import sys
from functools import cache
from pathlib import Path

import pytest
from conftest import ROOT, ran

from thermo_comp.unit.columns import bank
from thermo_comp.unit.terms import GROUPS

PACKAGE = ROOT / 'thermo_comp'

# Layer of each package, a folder or file of thermo_comp. No package imports from a higher layer.
LAYERS = {
    **dict.fromkeys(('__init__', 'errors', 'typing', 'files', 'plain_yaml', 'quantities'), 0),
    **dict.fromkeys(('topics', 'text'), 0),
    **dict.fromkeys(('thermal', 'unit'), 1),
    **dict.fromkeys(('online', 'simulation', 'recording'), 2),
    **dict.fromkeys(('fitting', 'replay'), 3),
    **dict.fromkeys(('api', 'field', 'judging', 'convert'), 4),
    **dict.fromkeys(('report', 'fleet'), 5),
    **dict.fromkeys(('ros', 'cli', '__main__'), 6),
}

# Packages that may import a library; any package may import a library that is not listed.
ROS = ['rclpy', 'rcl_interfaces', 'sensor_msgs', 'geometry_msgs', 'std_msgs', 'diagnostic_msgs']
HOMES = {
    **{name: {'ros'} for name in ROS}, 'rosgraph_msgs': {'ros'}, 'builtin_interfaces': {'ros'},
    'rosbags': {'recording'}, 'mcap': {'recording'}, 'zstandard': {'recording'},
    'lz4': {'recording'}, 'matplotlib': {'report'}, 'jinja2': {'report'}, 'pyulog': {'convert'},
    'pymavlink': {'convert'}, 'pyarrow': {'convert', 'fleet', 'recording'}, 'dask': {'fleet'},
    'distributed': {'fleet'}, 'fsspec': {'fleet'}, 'typer': {'cli', '__main__'},
    'rich': {'cli', '__main__'},
}  # fmt: skip

# Packages of mathematics; except for `CLOCK_EXCEPTIONS` their files must not read a clock.
PURE = {'thermal', 'unit', 'online', 'simulation', 'fitting', 'field'}
CLOCKS = {'time', 'datetime', 'sched', 'threading', 'asyncio'}
CLOCK_EXCEPTIONS = {'fitting/assembly.py'}  # writes the date of a fit into the provenance

SOURCES = sorted(PACKAGE.rglob('*.py'))


def unit_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix('.py')


@cache
def imports_of(path, with_types=True):
    """Return line and absolute dotted name of every import, also of imports inside functions."""
    here = ('thermo_comp', *path.relative_to(PACKAGE).with_suffix('').parts)
    tree = ast.parse(path.read_text(encoding='utf-8'), str(path))
    typing = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == 'TYPE_CHECKING'
        for inner in ast.walk(node)
    }
    collected = []
    for node in ast.walk(tree):
        if node in typing and not with_types:
            continue
        if isinstance(node, ast.Import):
            collected += [(node.lineno, name.name) for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = [*here[: -node.level]] if node.level else []
            base += (node.module or '').split('.') if node.module else []
            collected += [(node.lineno, '.'.join([*base, name.name])) for name in node.names]
    return collected


@cache
def own_unit(name):
    parts = name.split('.')
    if parts[0] != 'thermo_comp':
        return None
    names = (parts[1], f'{parts[1]}.py') if len(parts) > 1 else ()
    known = any((PACKAGE / name).exists() for name in names)
    return parts[1] if known else '__init__'


@pytest.mark.parametrize('path', SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_package_imports_from_a_higher_layer(path):
    unit, file = unit_of(path), path.relative_to(PACKAGE).as_posix()
    assert unit in LAYERS, f'{unit} has no layer: give it one in {Path(__file__).name}'
    wrong = []
    for line, name in imports_of(path, with_types=file != '__init__.py'):
        target = own_unit(name)
        if target is not None and LAYERS[target] > LAYERS[unit]:
            wrong.append(f'{path.name}:{line} imports {name} of layer {LAYERS[target]}')
        library = name.split('.')[0]
        if library in HOMES and unit not in HOMES[library]:
            wrong.append(f'{path.name}:{line} imports {library}, as only {HOMES[library]} may')
        if library in CLOCKS and unit in PURE and file not in CLOCK_EXCEPTIONS:
            wrong.append(f'{path.name}:{line} imports {library}: the arithmetic has no clock')
    assert not wrong


@cache
def own_file(name):
    """Return the dotted name of the thermo_comp file that contains an imported absolute name."""
    parts = name.split('.')[1:]
    while parts:
        path = PACKAGE.joinpath(*parts)
        if path.with_suffix('.py').is_file():
            return '.'.join(parts)
        if path.is_dir():
            return '.'.join([*parts, '__init__'])
        parts.pop()
    return '__init__'


def circle(uses):
    """Remove the leaves of a graph repeatedly; return the rest, empty if there is no circle."""
    while True:
        leaves = {file for file, targets in uses.items() if not targets & uses.keys()}
        if not leaves:
            return {file: targets & uses.keys() for file, targets in uses.items()}
        uses = {file: targets for file, targets in uses.items() if file not in leaves}


@pytest.mark.parametrize('by', ['package', 'file'])
def test_imports_between_packages_and_between_files_form_no_circle(by):
    # Imports that serve only type annotations may form circles, as they are not executed.
    uses = {}
    for path in SOURCES:
        text = '.'.join(path.relative_to(PACKAGE).with_suffix('').parts)
        here = unit_of(path) if by == 'package' else text
        imported = (name for _, name in imports_of(path, with_types=False))
        names = {name for name in imported if name.split('.')[0] == 'thermo_comp'}
        targets = {own_unit(name) if by == 'package' else own_file(name) for name in names}
        uses.setdefault(here, set()).update(target for target in targets if target != here)
    left = circle(uses)
    assert not left, f'these import each other: {left}'


def loaded_after(statement, *watched):
    """Run a statement in a new interpreter; return the watched modules that it imported."""
    code = f'{statement}\nimport sys\nprint(*[m for m in {watched!r} if m in sys.modules])'
    return ran(sys.executable, '-c', code, check=True, timeout=120).stdout.split()


def test_help_and_the_command_info_import_none_of_the_heavy_libraries():
    heavy = ('scipy', 'matplotlib', 'rosbags', 'rclpy', 'thermo_comp.fitting')
    assert loaded_after('import thermo_comp.cli.app', 'numpy', 'mcap', 'dask', *heavy) == []
    assert loaded_after('import thermo_comp.recording.overview', *heavy) == []


DOCS = ROOT / 'docs'


def test_tables_of_packages_and_of_groups_equal_those_of_the_source():
    text = (DOCS / 'architecture.md').read_text()
    rows = re.findall(r'^\| (\d) \| `(\w+)` \|', text, re.MULTILINE)
    assert {room: int(layer) for layer, room in rows} == LAYERS
    shown = re.findall(r'^\| `(\w+)` \|', (DOCS / 'theory.md').read_text(), re.MULTILINE)
    columns = bank(('case',), {'case': -0.5}, (-9.0, 9.0))
    # The group `part` has no columns of its own: its curves are sums of other columns.
    groups = {'part', *(column.group for column in columns)}
    assert groups <= GROUPS.keys()
    assert shown == [group for group in GROUPS if group in groups]
    command = (PACKAGE / 'cli' / 'fit.py').read_text()
    listed = re.search(r'Groups of regression columns: ([^.]*)\.', command)[1]
    assert set(re.findall(r'\w+', listed)) == {'curve', 'set', *groups}


@pytest.mark.parametrize('page', ['architecture.md', 'theory.md'])
def test_the_files_that_a_page_names_exist(page):
    for name in re.findall(r'[\w*/]+\.py\b', (DOCS / page).read_text()):
        places = (ROOT, ROOT / 'thermo_comp', ROOT / 'test')
        # A page gives the path of a file, or only its name after it has named the folder.
        is_path = any(list(place.glob(name)) for place in places)
        assert is_path or any(path.name == name for path in SOURCES), name
