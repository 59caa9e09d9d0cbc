# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns everything that touches ROS: the node, its parameters and diagnostics, player and recorder.
"""
