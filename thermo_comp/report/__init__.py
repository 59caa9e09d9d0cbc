# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the report: a unit's certificate, its figures, its live view; has matplotlib and Jinja2."""

from .certificate import CertificateInfo, load_certificate_info
from .evidence import Evidence, evidence_of_bags, evidence_of_fit
from .page import render_report, write_report

__all__ = [
    'CertificateInfo',
    'Evidence',
    'evidence_of_bags',
    'evidence_of_fit',
    'load_certificate_info',
    'render_report',
    'write_report',
]
