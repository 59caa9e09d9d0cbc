# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the entry point of the console script and of ``python -m thermo_comp``."""

import sys


def main() -> None:
    """Run a command; report the missing library if only the node's dependencies are installed."""
    try:
        from .cli.app import main as run
    except ModuleNotFoundError as error:
        sys.exit(f'thermo_comp: error: the commands need {error.name}: pip install thermo_comp')
    run()


if __name__ == '__main__':
    main()
