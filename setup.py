# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
import re
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'thermo_comp'
ROOT = Path(__file__).resolve().parent
VERSION = re.search(
    r"^__version__ = '([^']+)'$", (ROOT / NAME / '__init__.py').read_text(), re.MULTILINE
).group(1)

# Libraries of the commands; the node needs only numpy and yaml, which package.xml names.
INSTALL = [
    'numpy>=1.26',
    'PyYAML>=6.0',
    'scipy>=1.11',
    'threadpoolctl>=3.1',
    'typer>=0.26',
    'rich>=13.7',
    'rosbags>=0.11',
    'mcap>=1.1',
    'zstandard>=0.22',
    'lz4>=4.0',
    'matplotlib>=3.7',
    'Jinja2>=3.1',
]
EXTRAS = {
    'ros': ['ros-jazzy-rclpy[fastrtps]>=7.1,<8', 'ros-jazzy-common-interfaces>=5.3,<6'],
    'parquet': ['pyarrow>=14'],
    'px4': ['pyulog>=1.0'],
    'ardupilot': ['pymavlink>=2.4.40'],
    'fleet': ['dask>=2024.1', 'distributed>=2024.1', 'fsspec>=2023.6', 'pyarrow>=14'],
    'test': ['pytest>=7.4', 'pytest-xdist>=3.8', 'hypothesis>=6.98'],
    'dev': ['ruff>=0.15', 'mypy>=1.11', 'types-PyYAML', 'scipy-stubs', 'pre-commit>=3.5'],
    'fuzz': ['atheris>=3.0'],
    'docs': ['mkdocs-material>=9.5', 'mkdocstrings[python]>=0.27', 'mkdocs-jupyter>=0.25'],
}


def shared(folder, *patterns):
    """Return a folder under share/ and the files to install there from the source folder."""
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
        NAME: ['py.typed', '**/*.html', '**/*.css', '**/*.yaml', '**/*.json', '**/*.xml']
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        shared('config', '*.yaml', '*.json', '*.xml'),
        shared('config/columns', '*.yaml'),
        shared('config/drivers', '*.yaml'),
        shared('launch', '*.xml', '*.py'),
    ],
    install_requires=INSTALL,
    extras_require=EXTRAS,
    entry_points={
        'console_scripts': [
            'thermo_comp = thermo_comp.__main__:main',
            'thermo_comp_node = thermo_comp.__main__:node',
        ]
    },
    zip_safe=True,
)
