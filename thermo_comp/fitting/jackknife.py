# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the covariance due to effects that the model lacks: a jackknife over sections of the test.

The covariance of a fit contains only the errors due to noise. If the model lacks an effect, the
best weights differ between sections of the chamber program, and the error in another program is as
large as these differences. The jackknife [1]_ estimates these differences by fits without one
section.

References
----------
.. [1] B. Efron, The jackknife, the bootstrap and other resampling plans, SIAM (1982), chapter 3.

"""

from __future__ import annotations

import numpy as np

from ..typing import Floats
from .regression import PosteriorMode, Regression


def jackknife_covariance(regression: Regression, posterior: PosteriorMode) -> Floats:
    """
    Return the covariance of the unit's unknowns by the jackknife over the sections of the test,
    shape (n_unit, n_unit); 0 for one section, or if noise explains the changes of the unknowns.
    """
    n = posterior.layout.n_unit
    last = int(regression.windows.section.max())
    if not last:
        return np.zeros((n, n))
    products = regression.products(posterior.layout.used)
    step, factor = regression.at(posterior.state, posterior.prior, products.of_positions).solution
    changes, ratios = [], []
    for number in range(last + 1):
        grams = products.without(np.array([number]))
        other, remaining = regression.at(posterior.state, posterior.prior, grams).solution
        changes.append(other[:n] - step[:n])
        ratios.append(_ratios_to_noise(factor.T @ changes[-1], remaining.T @ posterior.root))
    ratio, without = np.concatenate(ratios), np.array(changes)
    # Under noise alone each ratio of a squared change to its variance has mean 1 and variance 2.
    if ratio.sum() - len(ratio) < 2.0 * np.sqrt(2.0 * len(ratio)):
        return np.zeros((n, n))
    return np.asarray(last / (last + 1) * without.T @ without)


def _ratios_to_noise(change: Floats, remaining: Floats) -> Floats:
    """
    Return the squared changes of k combinations of the unknowns if some windows are left out,
    divided by the variances of these changes due to noise, shape (k,).

    `change`: change of the unknowns, shape (n,), and `remaining`: root of the information of the
    remaining windows, ``remaining.T @ remaining``, shape (n, n), both scaled so that the
    covariance of the fit of all windows is the unit matrix
    """
    shares, directions = np.linalg.eigh(remaining.T @ remaining)
    # Use combinations about which the left-out windows have more than 1e-6 of the information.
    is_measured = shares < 1.0 - 1e-6
    shares = np.maximum(shares[is_measured], 1e-12)
    return np.asarray((change @ directions[:, is_measured]) ** 2 * shares / (1.0 - shares))
