# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the entry points of the console scripts and of ``python -m thermo_comp``."""

import sys


def main() -> None:
    """Run a command; report the missing library if only the node's dependencies are installed."""
    try:
        from .cli.app import main as run
    except ModuleNotFoundError as error:
        sys.exit(f'thermo_comp: error: the commands need {error.name}: pip install thermo_comp')
    run()


def node() -> int:
    """Run the node; report a library that cannot be imported, such as rclpy."""
    try:
        from .ros.node import main as run
    except ImportError as error:
        advice = "source the setup file of ROS 2, or pip install 'thermo_comp[ros]'"
        sys.exit(f'thermo_comp_node: error: {str(error).splitlines()[0]}: {advice}')
    return run()


if __name__ == '__main__':
    main()
