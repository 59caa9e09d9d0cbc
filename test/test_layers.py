# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Holds the house together: imports go down only, and each heavy library has one home.

"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / 'thermo_comp'

# One line per unit (a module or a sub-package of thermo_comp). A unit that is not here fails the
# test: whoever adds one says where it lives.
LAYERS = {
    '__init__': 0,
    'errors': 0,
    'files': 1,
    'plain_yaml': 1,
    'functions': 1,
    'modes': 1,
    'settings': 1,
    'thermometer': 1,
    'onset': 1,
    'regime': 1,
    'metrics': 1,
    'calibration': 2,
    'calibration_file': 2,
    'axis_correction': 2,
    'correction': 2,
    'batch': 2,
    'reading_queue': 2,
    'blocks': 2,
    'kernel': 2,
    'snapshot': 2,
    'plausibility': 2,
    'sample_guard': 2,
    'status': 2,
    'thermal': 2,
    'compensator': 2,
    'health': 2,
    'exchange': 2,
    'fitting': 2,
    'simulation': 2,
    'recording': 3,
    'replay': 3,
    'partial': 3,
    'survey': 3,
    'evaluation': 3,
    'fit_sources': 3,
    'report': 3,
    'convert': 3,
    'fleet': 3,
    'ros': 4,
    'cli': 4,
    '__main__': 4,
}

# Who may import what from outside. A library that is not here is free for all.
ROS = ['rclpy', 'rcl_interfaces', 'sensor_msgs', 'geometry_msgs', 'std_msgs', 'diagnostic_msgs']
HOMES = {
    **{name: {'ros'} for name in ROS},
    'rosgraph_msgs': {'ros'},
    'builtin_interfaces': {'ros'},
    'rosbags': {'recording'},
    'mcap': {'recording'},
    'zstandard': {'recording'},
    'lz4': {'recording'},
    'matplotlib': {'report'},
    'pyulog': {'convert'},
    'pymavlink': {'convert'},
    'pyarrow': {'convert', 'fleet'},
    'dask': {'fleet'},
    'distributed': {'fleet'},
    'fsspec': {'fleet'},
    'typer': {'cli', '__main__'},
    'rich': {'cli', '__main__'},
}

# Layers 0 to 2 are pure: they have no clock of their own.
CLOCKS = {'time', 'datetime', 'sched', 'threading', 'asyncio'}
CLOCK_EXCEPTIONS = {
    'fitting',  # the date of a fit is provenance, and stands in the calibration file
    'calibration',  # the same date, read back
}

SOURCES = sorted(PACKAGE.rglob('*.py'))


def unit_of(path: Path) -> str:
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix('.py')


def imports_of(path: Path, with_types: bool = True) -> Iterator[tuple[int, str]]:
    """
    Yield (line, absolute dotted name) of every import, also of those inside functions.

    """
    here = ('thermo_comp', *path.relative_to(PACKAGE).with_suffix('').parts)
    tree = ast.parse(path.read_text(encoding='utf-8'), str(path))
    typing = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == 'TYPE_CHECKING'
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if node in typing and not with_types:
            continue
        if isinstance(node, ast.Import):
            for name in node.names:
                yield node.lineno, name.name
        elif isinstance(node, ast.ImportFrom):
            base = [*here[: -node.level]] if node.level else []
            base += (node.module or '').split('.') if node.module else []
            for name in node.names:
                yield node.lineno, '.'.join([*base, name.name])


def own_unit(name: str) -> str | None:
    """
    Return the unit that an absolute name of this package belongs to, None for other packages.

    """
    parts = name.split('.')
    if parts[0] != 'thermo_comp':
        return None
    known = len(parts) > 1 and (
        (PACKAGE / parts[1]).is_dir() or (PACKAGE / f'{parts[1]}.py').is_file()
    )
    return parts[1] if known else '__init__'


@pytest.mark.parametrize('path', SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_down_only(path: Path) -> None:
    unit = unit_of(path)
    assert unit in LAYERS, f'{unit} has no layer: give it one in {Path(__file__).name}'
    wrong = []
    for line, name in imports_of(path):
        target = own_unit(name)
        if target is not None and LAYERS[target] > LAYERS[unit]:
            wrong.append(f'{path.name}:{line} imports {name} of layer {LAYERS[target]}')
        library = name.split('.')[0]
        if library in HOMES and unit not in HOMES[library]:
            wrong.append(f'{path.name}:{line} imports {library}, at home in {HOMES[library]}')
        if library in CLOCKS and LAYERS[unit] < 3 and unit not in CLOCK_EXCEPTIONS:
            wrong.append(f'{path.name}:{line} imports {library}: layers 0 to 2 have no clock')
    assert not wrong


def test_units_form_no_cycle() -> None:
    # Inside one layer a unit may use another, but never each the other; naming a type is no use.
    uses: dict[str, set[str]] = {}
    for path in SOURCES:
        targets = {own_unit(name) for _, name in imports_of(path, with_types=False)}
        uses.setdefault(unit_of(path), set()).update(
            target for target in targets if target not in (None, unit_of(path))
        )
    while True:
        leaves = {unit for unit, targets in uses.items() if not targets & uses.keys()}
        if not leaves:
            break
        uses = {unit: targets for unit, targets in uses.items() if unit not in leaves}
    assert not uses, f'these import each other: {uses}'


def loaded_after(statement: str, *watched: str) -> list[str]:
    """
    Return which of the watched modules a fresh interpreter holds after one statement.

    """
    code = f'{statement}\nimport sys\nprint(*[m for m in {watched!r} if m in sys.modules])'
    finished = subprocess.run(
        [sys.executable, '-c', code],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return finished.stdout.split()


def test_node_starts_without_the_offline_libraries() -> None:
    # The node runs on the robot's computer for weeks: what only a fit or a plot needs would cost
    # it memory and start-up time.
    pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')
    offline = ('rosbags', 'mcap', 'matplotlib', 'scipy', 'scipy.optimize', 'typer', 'rich')
    assert loaded_after('import thermo_comp.ros.node', *offline) == []


def test_help_starts_without_the_heavy_libraries() -> None:
    heavy = ('numpy', 'scipy', 'rosbags', 'mcap', 'matplotlib', 'pydantic', 'rclpy', 'dask')
    assert loaded_after('import thermo_comp.cli.app', *heavy) == []


def test_core_imports_no_files_and_no_ros() -> None:
    statement = 'import thermo_comp.online.compensator'
    assert loaded_after(statement, 'rclpy', 'rosbags', 'mcap', 'matplotlib', 'scipy') == []
