# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the simulation: a unit in a thermal chamber, from its physics, with known truth.

Chamber air -> case -> board -> parts; errors arise in the parts and between them, with lags,
hysteresis and switched loads; noise, a converter. The model does not use a compensator's
regressors; it reads no file and no clock.
"""
