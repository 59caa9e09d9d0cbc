# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the known truth: a unit in a thermal chamber, simulated from the physics up.

Chamber air -> case -> board -> parts through heat capacities and conductances, solved exactly;
errors arise in the parts (tempcos, leakage), between them (gradients, heat flows), slowly (creep),
by the way that was gone (joints that slip) and by what is switched on; white noise, a bias that
walks; a charge-balancing converter that carries its remainder. Nothing here is built from a
compensator's regressors, reads a file or a clock.
"""
