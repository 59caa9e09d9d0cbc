# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the peers: what other open tools do with one attitude over temperature, in their own manner.

Each is written anew from its public description. Each corrects vectors by a function of
temperature per axis; what is compared is the norm, less the mean norm of its training windows,
because none of them claims to know the level.

"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thermo_comp.typing import Floats

#: Training vectors and temperatures in, a predictor of the norm out; told whether to carry the
#: polynomial on beyond the training temperatures instead of holding its edge, as they all do.
Peer = Callable[[Floats, Floats], Callable[[Floats, Floats, bool], Floats]]

_ARDUPILOT_REFERENCE = 35.0
_ARDUPILOT_STEP = 0.5
_ARDUPILOT_MEANS = 4


def no_correction(
    _vectors: Floats, _temperature: Floats
) -> Callable[[Floats, Floats, bool], Floats]:
    """
    Leave the reading as it is.

    """
    return lambda vectors, _temperature, _extend: vectors


def linear(vectors: Floats, temperature: Floats) -> Callable[[Floats, Floats, bool], Floats]:
    """
    Correct each axis by a straight line in T.

    """
    return _polynomial(vectors, temperature, float(np.mean(temperature)), 1, temperature)


def px4_cubic(vectors: Floats, temperature: Floats) -> Callable[[Floats, Floats, bool], Floats]:
    """
    Fit a cubic per axis about the middle of the range, on all windows, as PX4's tools do.

    """
    reference = 0.5 * float(temperature.min() + temperature.max())
    return _polynomial(vectors, temperature, reference, 3, temperature)


def ardupilot_cubic(
    vectors: Floats, temperature: Floats
) -> Callable[[Floats, Floats, bool], Floats]:
    """
    Fit a cubic per axis about 35 degC on means per half a kelvin, as ArduPilot's learning does.

    On board it learns while the temperature rises only; here it may learn on the way down, too.

    """
    means, at = [], []
    first = 0
    for i in range(1, len(temperature) + 1):
        moved = i < len(temperature) and (
            abs(temperature[i] - temperature[first]) >= _ARDUPILOT_STEP
        )
        if moved and i - first >= _ARDUPILOT_MEANS:
            means.append(vectors[first:i].mean(axis=0))
            at.append(temperature[first:i].mean())
            first = i
    return _polynomial(np.array(means), np.array(at), _ARDUPILOT_REFERENCE, 3, temperature)


def _polynomial(
    vectors: Floats, temperature: Floats, reference: float, order: int, seen: Floats
) -> Callable[[Floats, Floats, bool], Floats]:
    columns = np.vander(temperature - reference, order + 1, increasing=True)
    coefficients = np.linalg.lstsq(columns, vectors, rcond=None)[0]
    low, high = float(seen.min()), float(seen.max())
    # Only changes are taken out, from a temperature at which the unit would have been calibrated:
    # the middle of what was seen. The reference itself may be far outside.
    usual = np.vander([0.5 * (low + high) - reference], order + 1, increasing=True) @ coefficients

    def correct(measured: Floats, at: Floats, extend: bool) -> Floats:
        held = at if extend else np.clip(at, low, high)
        powers = np.vander(held - reference, order + 1, increasing=True)
        return np.asarray(measured - (powers @ coefficients - usual))

    return correct


PEERS: dict[str, Peer] = {
    'no correction': no_correction,
    'linear in T': linear,
    'PX4-style cubic': px4_cubic,
    'ArduPilot-style cubic': ardupilot_cubic,
}


def residual(
    peer: Peer,
    train: tuple[Floats, Floats],
    test: tuple[Floats, Floats],
    extend: bool,
) -> Floats:
    """
    Train a peer on some windows, correct others, and say what the norm misses its level by.

    Parameters
    ----------
    peer : callable
        One of `PEERS`.
    train, test : (ndarray of shape (n, 3), ndarray of shape (n,))
        Window means and their temperatures.
    extend : bool
        Whether the polynomial is carried on beyond the training temperatures.

    Returns
    -------
    ndarray, shape (m,)
        Of the test windows.

    """
    correct = peer(*train)
    level = float(np.mean(np.linalg.norm(correct(*train, extend), axis=1)))
    return np.asarray(np.linalg.norm(correct(*test, extend), axis=1) - level)
