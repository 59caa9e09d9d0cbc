# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the known truth: a unit in a thermal chamber, simulated from the physics up.

Chamber air -> case -> board -> parts; errors arise in the parts and between them, slowly, by the
way that was gone and by what is switched on; noise, a converter. Nothing here is built from a
compensator's regressors, reads a file or a clock.
"""
