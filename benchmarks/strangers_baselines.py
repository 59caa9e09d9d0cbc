# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fits the baselines of the benchmark `strangers.py` by scipy, to means over a minute.

The baseline 'constants' has nine numbers: bias, scale and misalignment. The baseline 'cubic' adds
for each axis a cubic of the bias and a line of the scale over board temperature. Both baselines
are fitted by least squares on ``|f| - g`` or, in a single pose, on the samples of each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from strangers_units import GRAVITY, REFERENCE_C, Bag, Floats

Ints = npt.NDArray[np.int64]

WINDOW_S = 60.0  # length of the means whose errors are evaluated [s]
#: Largest fitted bias [g], relative error of the scale and misalignment [rad]. A fit without
#: bounds to few attitudes finds scale factors that make the forces of all attitudes equal.
LARGEST = 0.2
SPAN_K = (
    15.0  # temperatures are divided by this unit [K], so that their powers have equal magnitudes
)


@dataclass(frozen=True)
class Minutes:
    """Means over 60 s: samples (w, 3), board (w,) [degC], true force (w, 3) [m/s^2] or NaN."""

    samples: Floats
    board: Floats
    force: Floats


def slots(bag: Bag) -> tuple[Ints, Ints]:
    """Return first row and number of rows of windows of 60 s with at least 95 % of their rows."""
    number = np.floor((bag.time_s - bag.time_s[0]) / WINDOW_S)
    first = np.flatnonzero(np.diff(number, prepend=-1.0))
    size = np.diff(first, append=len(number))
    is_whole = size >= 0.95 * np.median(size)
    return first[is_whole], size[is_whole]


def means(values: Floats, first: Ints, size: Ints) -> Floats:
    """Average the rows of each window."""
    edges = np.stack((first, first + size), axis=1).ravel()
    total = np.add.reduceat(values, edges[edges < len(values)], axis=0)[::2]
    return np.asarray(total / size.reshape(-1, *[1] * (values.ndim - 1)))


def minutes(bag: Bag) -> Minutes:
    """Average the samples and readings of a bag over windows."""
    first, size = slots(bag)
    board = np.full(len(first), REFERENCE_C)
    if 'board' in bag.temperatures:
        board = means(np.interp(bag.time_s, *bag.temperatures['board']), first, size)
    force = np.nan if bag.force is None else bag.force
    force = np.broadcast_to(force, bag.samples.shape)
    return Minutes(means(bag.samples, first, size), board, means(force, first, size))


def _curved(p: Floats, order: int, samples: Floats, board: Floats) -> Floats:
    """Correct samples in g; p: bias, scale, misalignment, then coefficients of both curves."""
    t = ((board - REFERENCE_C) / SPAN_K)[:, None]
    bias, scale = p[:3], 1.0 + p[3:6]
    if order:
        curve = p[9 : 9 + 3 * order].reshape(order, 3)
        bias = bias + sum(c * t ** (k + 1) for k, c in enumerate(curve))
        scale = scale + p[-3:] * t
    x = (samples - bias) / scale
    a, b, c = p[6:9]
    return np.stack((x[:, 0], x[:, 1] + a * x[:, 0], x[:, 2] + b * x[:, 0] + c * x[:, 1]), axis=1)


def by_norm(
    bags: Sequence[Minutes], gravity: float = GRAVITY, *, order: int = 0
) -> Callable[[Minutes], Floats]:
    """Fit constants, and curves if `order` is above 0, to ``|f| - g``; return the correction."""
    samples = np.concatenate([bag.samples for bag in bags])
    board = np.concatenate([bag.board for bag in bags])
    # The RMS norm of the samples is a first value of the counts per g for the three axes.
    size = np.sqrt(np.mean(np.sum(samples**2, axis=1)))

    def missed(p: Floats, order: int) -> Floats:
        return np.linalg.norm(_curved(p, order, samples / size, board), axis=1) - 1.0

    bounded = {'x_scale': 1e-3, 'bounds': (-LARGEST, LARGEST)}
    start = least_squares(missed, np.zeros(9), args=(0,), **bounded).x
    if order:
        start = np.concatenate((start, np.zeros(3 * order + 3)))
        start = least_squares(missed, start, args=(order,), **bounded).x
    return lambda bag: gravity * _curved(start, order, bag.samples / size, bag.board)


def by_drift(
    bags: Sequence[Minutes], scale: float, *, order: int = 0
) -> Callable[[Minutes], Floats]:
    """Fit each axis in a pose by a polynomial of board temperature; `scale`: counts per m/s^2."""
    t = np.concatenate([bag.board for bag in bags])
    y = np.concatenate([bag.samples for bag in bags]) / scale
    powers = np.vander((t - REFERENCE_C) / SPAN_K, order + 1, increasing=True)
    coefficients = np.linalg.lstsq(powers, y, rcond=None)[0]

    def corrected(bag: Minutes) -> Floats:
        of_bag = np.vander((bag.board - REFERENCE_C) / SPAN_K, order + 1, increasing=True)
        return np.asarray(bag.samples / scale - of_bag[:, 1:] @ coefficients[1:])

    return corrected
