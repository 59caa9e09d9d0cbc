# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns all code that uses rclpy: node, parameters, diagnostics, player, recorders."""
