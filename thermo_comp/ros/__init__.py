# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns everything that touches ROS: node, parameters, diagnostics, player, recorders."""
