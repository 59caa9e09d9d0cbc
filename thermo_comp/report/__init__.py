# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the report: a unit's certificate as one HTML page, its figures, and its live view.

- `open_bag` reads a bag, `evidence_of_bags` judges bags with or without a calibration,
  `evidence_of_fit` takes what a fit has to show; `write_report` writes the page.
- The only place with matplotlib.

"""

from .evidence import Evidence
from .fitted import evidence_of_fit
from .gather import OpenedBag, evidence_of_bags, open_bag
from .verdict import Verdict, judge
from .write import render_report, write_report

__all__ = [
    'Evidence',
    'OpenedBag',
    'Verdict',
    'evidence_of_bags',
    'evidence_of_fit',
    'judge',
    'open_bag',
    'render_report',
    'write_report',
]
