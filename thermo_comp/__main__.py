# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``python -m thermo_comp``: the same door as the console script."""

from .cli.app import main

if __name__ == '__main__':
    main()
