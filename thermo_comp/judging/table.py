# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the windows as a table for other programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from ..unit.gravity import MICRO_G
from .windows import Windows

COLUMNS = (
    *('bag', 'position', 'start_ns', 'time_s', 'window_s', 'samples'),
    *('board_c', 'board_rate_k_min', 'regime', 'is_inside'),
    *('force_x_m_s2', 'force_y_m_s2', 'force_z_m_s2'),
    *('raw_residual_ug', 'residual_ug', 'claimed_sd_ug'),
)


def csv_of(windows: Windows, bags: Sequence[str]) -> str:
    """
    Write windows as CSV, with all digits.

    Parameters
    ----------
    windows : Windows
        The windows.
    bags : sequence of str
        Names of the bags.

    Returns
    -------
    str
        A line of headings, then one per window.

    """
    columns = (
        [bags[number] for number in windows.bag.tolist()],
        (windows.position + 1).tolist(),
        windows.start_ns.tolist(),
        windows.time.tolist(),
        [windows.window_s] * len(windows),
        windows.count.astype(int).tolist(),
        windows.board.tolist(),
        (windows.rate * 60.0).tolist(),
        ['dynamic' if dynamic else 'static' for dynamic in windows.is_dynamic.tolist()],
        windows.is_inside.astype(int).tolist(),
        *windows.force.T.tolist(),
        (windows.raw_residual / MICRO_G).tolist(),
        (windows.residual / MICRO_G).tolist(),
        (windows.claimed_sd / MICRO_G).tolist(),
    )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue()
