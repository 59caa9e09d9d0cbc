# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The linters of a ROS installation, declared in package.xml, find nothing."""

import pytest
from conftest import ROOT

SOURCES = [str(ROOT / name) for name in ('thermo_comp', 'test', 'setup.py')]
#: As in setup.cfg: the summary of a docstring is on its second line and may have two lines.
STYLE = ['D200', 'D205', 'D400', 'D403']
pytestmark = pytest.mark.filterwarnings('ignore')


def test_ament_flake8_finds_nothing():
    linter = pytest.importorskip('ament_flake8.main')
    code, errors = linter.main_with_errors(argv=['--config', str(ROOT / 'setup.cfg'), *SOURCES])
    assert code == 0, '\n'.join(errors)


def test_ament_pep257_finds_nothing():
    linter = pytest.importorskip('ament_pep257.main')
    assert linter.main(argv=['--add-ignore', *STYLE, '--', *SOURCES]) == 0


def test_ament_xmllint_finds_nothing():
    linter = pytest.importorskip('ament_xmllint.main')
    assert (
        linter.main(argv=[str(ROOT / name) for name in ('package.xml', 'config', 'launch')]) == 0
    )
