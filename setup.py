# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
import atexit
import contextlib
import importlib.metadata
import importlib.util
import os
import re
import shutil
import sys
import sysconfig
import tempfile
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError

NAME = 'thermo_comp'
ROOT = Path(__file__).resolve().parent
VERSION = re.search(
    r"^__version__ = '([^']+)'$", (ROOT / NAME / '__init__.py').read_text(), re.MULTILINE
).group(1)

# On Ubuntu 24.04 apt satisfies every floor but those of typer, rosbags and mcap.
INSTALL = [
    'numpy>=1.26',
    'PyYAML>=6.0',
    'scipy>=1.11',
    'typer>=0.20',
    'rich>=13.7',
    'rosbags>=0.11',
    'mcap>=1.1',
    'zstandard>=0.22',
    'lz4>=4.0',
    'matplotlib>=3.6',
]
EXTRAS = {
    'ros': ['ros-jazzy-rclpy[fastrtps]>=7.1,<8', 'ros-jazzy-common-interfaces>=5.3,<6'],
    'parquet': ['pyarrow>=14'],
    'px4': ['pyulog>=1.0'],
    'ardupilot': ['pymavlink>=2.4.40'],
    'fleet': ['dask>=2024.1', 'distributed>=2024.1', 'fsspec>=2023.6', 'pyarrow>=14'],
    'test': ['pytest>=7.4', 'pytest-xdist>=3.4', 'hypothesis>=6.98', 'mypy>=1.18'],
    'dev': ['ruff>=0.15', 'mypy>=1.11', 'types-PyYAML', 'scipy-stubs', 'pre-commit>=3.5'],
    'fuzz': ['atheris>=3.0'],
    'docs': ['mkdocs-material>=9.5'],
}

# C extensions are made of these, from the same source, where that can be done: what runs for each
# reading and each sample, in the node, too. Their .py files are installed beside them. The
# arithmetic of many samples, which is numpy's otherwise, is written in C. Nothing here may log
# through rclpy at more than one severity: it tells the callers apart by their Python frames.
CORE = [
    'online/batch',
    'online/compensator',
    'online/health',
    'thermal/modes',
    'thermal/onset',
    'thermal/plausibility',
    'thermal/reading_queue',
    'thermal/regime',
    'ros/conversions',
    'ros/relay',
    'ros/scheduling',
    'ros/waitloop',
    'online/sample_guard',
    'thermal/tracker',
    'thermal/thermometer',
]
COMPILER = 'mypy'
COMPILER_FLOOR = (1, 18)
#: Empty: compiled where that can be done. 0: interpreted. Anything else: compiled, or an error.
WISH = os.environ.get('THERMO_COMP_COMPILE', '')
COMMANDS = set(sys.argv[1:])


def requirements():
    """
    Name what pip shall bring for a build; it asks with the command egg_info alone.

    """
    is_asked = 'setuptools.build_meta' in sys.modules and sys.argv[1:] == ['egg_info']
    if not is_asked or WISH == '0':
        return []
    compiler = f'{COMPILER}>={".".join(map(str, COMPILER_FLOOR))}'
    # Elsewhere the compiler would have to be compiled itself: only for those who ask for it.
    usual = '' if WISH else '; platform_machine in "x86_64 AMD64 aarch64 arm64"'
    return [compiler + usual]


def missing():
    """
    Say what is not there to compile with; empty where nothing.

    """
    version = ''
    if importlib.util.find_spec('mypyc') is not None:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            version = importlib.metadata.version(COMPILER)
    found = tuple(int(digits) for digits in re.findall(r'\d+', version)[:2])
    if found < COMPILER_FLOOR:
        floor = '.'.join(map(str, COMPILER_FLOOR))
        return f"mypyc of {COMPILER} {floor} or newer: pip install '{COMPILER}>={floor}'"
    compiler = os.environ.get('CC') or sysconfig.get_config_var('CC') or 'cc'
    if os.name == 'posix' and shutil.which(compiler.split()[0]) is None:
        return f'a C compiler, {compiler}: sudo apt install build-essential'
    if not Path(sysconfig.get_path('include'), 'Python.h').exists():
        return 'the headers of Python: sudo apt install python3-dev'
    return ''


def stays_interpreted(reason):
    """
    Say why the core is not compiled, where that was not asked for; end where it was.

    """
    if WISH:
        sys.exit(f'{NAME}: THERMO_COMP_COMPILE: {reason}')
    print(f'{NAME}: the core stays interpreted: {reason}', file=sys.stderr)


def compiled():
    """
    Make the C extensions of the core; none where it stays interpreted.

    """
    if WISH == '0':
        return []
    if WISH and COMMANDS & {'develop', 'editable_wheel'}:
        sys.exit(
            f'{NAME}: THERMO_COMP_COMPILE does not go with an editable install, whose edited '
            'sources would not run: unset it, or install without -e (colcon: --symlink-install)'
        )
    if not COMMANDS & {'build', 'build_ext', 'bdist_wheel', 'install'}:
        return []
    reason = missing()
    if reason:
        stays_interpreted(f'it needs {reason}')
        return []
    # Types of other libraries make no code here, so those need not be there. Nothing is written
    # beside the source: colcon builds elsewhere, and it may not be ours to write to.
    options = ['--config-file=', '--no-site-packages', '--ignore-missing-imports']
    options += ['--follow-imports=silent', f'--cache-dir={os.devnull}']
    made = tempfile.mkdtemp(prefix=f'{NAME}-')
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    files = [f'{NAME}/{module}.py' for module in CORE]
    try:
        from mypyc.build import mypycify

        extensions = mypycify(
            [*options, *files],
            target_dir=made,
            group_name=f'{NAME}._core',
            opt_level='1',
            debug_level='0',
        )
    except (Exception, SystemExit) as error:  # noqa: BLE001 - a future mypyc must not end an install
        stays_interpreted(f'mypyc failed: {error}')
        return []
    kernel = Extension(f'{NAME}._kernel', [f'{NAME}/_kernel.c'], extra_compile_args=['-O3'])
    for extension in (*extensions, kernel):
        # The same bits on every architecture: nothing is fused, nothing computed in advance.
        # And what another compiler warns of is no error.
        exact = ['-ffp-contract=off', *(f'-fno-builtin-{f}' for f in ('exp', 'log', 'pow'))]
        extension.extra_compile_args += [*exact, '-Wno-error']
    return [*extensions, kernel]


class BuildCore(build_ext):
    """
    Build all of the extensions or, where that fails and nobody insists, none.

    """

    def run(self):
        """
        Build them.

        """
        extensions = self.extensions
        try:
            super().run()
        except (BaseError, CCompilerError) as error:
            stays_interpreted(f'the C compiler failed: {error}')
            for extension in extensions:
                Path(self.get_ext_fullpath(extension.name)).unlink(missing_ok=True)
            self.extensions = []


def shared(folder, *patterns):
    """
    Pair a folder of the source with its place under share/.

    """
    files = sorted(
        str(path.relative_to(ROOT))
        for pattern in patterns
        for path in (ROOT / folder).glob(pattern)
        if path.is_file()
    )
    return (f'share/{NAME}/{folder}', files)


setup(
    name=NAME,
    version=VERSION,
    description='Thermal-drift compensation of a three-axis accelerometer, as a ROS 2 package.',
    long_description=(ROOT / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    author='thermo_comp contributors',
    maintainer='thermo_comp contributors',
    maintainer_email='maintainers@thermo-comp.example',
    license='Apache-2.0',
    keywords=['ROS', 'accelerometer', 'calibration', 'inertial navigation', 'temperature'],
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={
        NAME: ['py.typed', '*.pyi', '**/*.html', '**/*.css', '**/*.yaml', '**/*.json', '**/*.xml']
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        shared('config', '*.yaml', '*.json', '*.xml'),
        shared('config/columns', '*.yaml'),
        shared('launch', '*.xml', '*.py'),
    ],
    ext_modules=compiled(),
    cmdclass={'build_ext': BuildCore},
    setup_requires=requirements(),
    install_requires=INSTALL,
    extras_require=EXTRAS,
    entry_points={
        'console_scripts': [
            'thermo_comp = thermo_comp.cli.app:main',
            'thermo_comp_node = thermo_comp.ros.node:main',
        ],
    },
    zip_safe=True,
)
