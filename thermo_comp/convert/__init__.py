# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the conversion of logs to bags, and of calibrations to and from other tools' files."""
