# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns how a worker of this machine behaves: it minds its work, and leaves talking to its master.

Dask loads this module in each worker process that it starts, and calls `dask_setup`.
"""

from __future__ import annotations

import logging
import signal


def dask_setup(_worker: object) -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that was started in it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
