# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the physical simulation of a unit in a thermal chamber, with known true errors.

Heat flows from the chamber air to the case, the board and other parts. Errors of bias and scale
follow from the temperatures of the parts and the differences between them, with lags, creep and
switched loads; noise and the rounding of a converter are added. The simulation does not use a
compensator's regressors, and reads no file and no clock.
"""
