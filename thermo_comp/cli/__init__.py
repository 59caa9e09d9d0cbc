# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the command line: arguments -> one library call -> table or JSON -> exit code."""
