# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the command line: arguments -> one library call -> table or JSON -> exit code.

Exit codes: 0 done, 1 the data or the result is bad, 2 the command line is wrong.
"""
