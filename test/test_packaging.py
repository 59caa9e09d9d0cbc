# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""All files state the same version, licence and dependencies; the ROS linters find nothing."""

import ast
import os
import re
import sys
import xml.etree.ElementTree as ET

import pytest
import yaml
from conftest import ROOT, ran

import thermo_comp

MANIFEST = ET.parse(ROOT / 'package.xml').getroot()  # noqa: S314 - our own file

# rosdep can install these dependencies on Ubuntu 24.04: Python packages and ROS 2 Jazzy.
KNOWN_KEYS = {
    *('rclpy', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'rcl_interfaces'),
    *('rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'launch_xml', 'launch_ros', 'ament_flake8'),
    *('ament_pep257', 'ament_xmllint', 'python3-numpy', 'python3-yaml', 'python3-hypothesis'),
    *('python3-pytest', 'python3-pytest-xdist'),
}


def test_version_and_dependencies_are_equal_wherever_they_are_stated():
    assert MANIFEST.findtext('version') == thermo_comp.__version__
    assert re.fullmatch(r'\d+\.\d+\.\d+', thermo_comp.__version__)
    finished = ran(sys.executable, 'setup.py', '--version', check=True)
    assert finished.stdout.split()[-1] == thermo_comp.__version__
    assert (MANIFEST.get('format'), MANIFEST.findtext('name')) == ('3', 'thermo_comp')
    assert MANIFEST.findtext('export/build_type') == 'ament_python'
    tags = ('depend', 'exec_depend', 'build_depend', 'test_depend')
    assert {node.text for tag in tags for node in MANIFEST.iter(tag)} == KNOWN_KEYS
    # Further dependencies of the commands come from PyPI.
    keys = {node.text for node in MANIFEST.iter('exec_depend')}
    assert {key for key in keys if key.startswith('python3-')} == {'python3-numpy', 'python3-yaml'}
    install = re.search(r'^INSTALL = (\[.*?^\])', (ROOT / 'setup.py').read_text(), re.M | re.S)[1]
    install = ast.literal_eval(install)
    assert isinstance(install, list)
    assert all('>=' in requirement for requirement in install), 'no lowest version'


def test_every_source_file_states_the_apache_licence_and_has_at_most_500_lines():
    licence = (ROOT / 'LICENSE').read_text()
    assert 'Version 2.0, January 2004' in licence
    assert 'END OF TERMS AND CONDITIONS' in licence
    node = MANIFEST.find('license')
    assert (node.text, node.get('file')) == ('Apache-2.0', 'LICENSE')
    first = 'SPDX-FileCopyrightText: 2026 thermo_comp contributors'
    second = 'SPDX-License-Identifier: Apache-2.0'
    for path in tracked('*.py', 'Makefile', '.ci/run'):
        lines = path.read_text().splitlines()
        lines = lines[1:] if lines and lines[0].startswith('#!') else lines
        assert lines[:2] == [f'# {first}', f'# {second}'], path
    lengths = {path: len(path.read_text().splitlines()) for path in tracked('*.py')}
    assert {path.name: n for path, n in lengths.items() if n > 500} == {}


def tracked(*patterns):
    listing = ran('git', 'ls-files', '-z', '--', *patterns)
    names = [name for name in listing.stdout.split('\0') if name]
    if listing.returncode or not names:
        pytest.skip('not a git working tree: an installed or unpacked copy')
    return [ROOT / name for name in names if (ROOT / name).exists()]


def test_hosted_ci_installs_as_the_readme_describes():
    jobs = yaml.safe_load((ROOT / '.github/workflows/ci.yaml').read_text())['jobs']
    lowest = re.search(r"python_requires='>=([\d.]+)'", (ROOT / 'setup.py').read_text())
    assert jobs['wheels']['strategy']['matrix']['python'][0] == lowest[1]
    run = '\n'.join(step.get('run', '') for step in jobs['ros']['steps'])
    readme = (ROOT / 'README.md').read_text()
    for line in re.findall(r'^ *((?:rosdep|pip) install .*?) *(?:#.*)?$', run, re.MULTILINE):
        assert line in readme, line
    assert jobs['ros']['container'] == 'ros:jazzy'


def test_the_installed_share_folder_contains_the_files_that_ros_needs(tmp_path):
    words = (*('build', '--build-base', tmp_path / 'build'), 'install_data', '--install-dir')
    environment = {**os.environ, 'PYTHONWARNINGS': 'ignore'}
    command = (sys.executable, 'setup.py', '-q', *words, tmp_path / 'prefix')
    ran(*command, check=True, env=environment)
    share = tmp_path / 'prefix' / 'share'
    assert (share / 'ament_index/resource_index/packages/thermo_comp').is_file()
    assert (share / 'thermo_comp/package.xml').is_file()
    for folder in ('config', 'config/columns', 'config/drivers', 'launch'):
        kept = {p.name for p in (ROOT / folder).glob('*') if p.suffix in ('.yaml', '.xml')}
        there = share / 'thermo_comp' / folder
        assert kept <= {p.name for p in there.glob('*')}, folder


SOURCES = [str(ROOT / name) for name in ('thermo_comp', 'test', 'setup.py')]
#: Docstring rules that setup.cfg ignores, too: a summary may begin on line 2 and have two lines.
STYLE = ['D200', 'D205', 'D400', 'D403']


@pytest.mark.filterwarnings('ignore')
@pytest.mark.parametrize(
    ('name', 'arguments'),
    [
        ('flake8', ['--config', str(ROOT / 'setup.cfg'), *SOURCES]),
        ('pep257', ['--add-ignore', *STYLE, '--', *SOURCES]),
        ('xmllint', [str(ROOT / name) for name in ('package.xml', 'config', 'launch')]),
    ],
)
def test_the_linters_of_ament_find_nothing(name, arguments, capfd):
    linter = pytest.importorskip(f'ament_{name}.main')
    assert linter.main(argv=arguments) == 0, capfd.readouterr().out
