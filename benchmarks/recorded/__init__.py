# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Finds recordings that other people made, for `test/test_real_data.py`.

The recordings are not part of the project: they are read from the folder THERMO_COMP_DATA, or else
from a folder beside the project, and converted to bags in a temporary directory.
"""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def data_folder() -> Path:
    """Return the folder of the recordings."""
    return Path(os.environ.get('THERMO_COMP_DATA', ROOT.parent / 'shared' / 'data'))
