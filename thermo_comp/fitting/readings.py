# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the readings of one thermometer over a bag, without implausible readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..thermal.thermometer import COLDEST, HOTTEST
from ..typing import Bools, Floats, Ints


class Readings(NamedTuple):
    """
    One thermometer's readings over a bag: rising stamps [ns] and temperatures [degC], shape (n,);
    without arguments, no readings.
    """

    stamp_ns: Ints = np.empty(0, np.int64)
    value: Floats = np.empty(0)


def thinned(stamp_ns: Ints, value: Floats, last_ns: Ints) -> Readings:
    """
    Keep plausible readings with rising stamps; average readings that are less than 0.2 s apart.

    No thermometer is faster than 0.2 s, and the recursion over all readings, in Python, is slow.
    """
    stamp_ns, value = np.asarray(stamp_ns, np.int64), np.asarray(value, np.float64)
    before = np.concatenate((last_ns if len(last_ns) else stamp_ns[:1] - 1, stamp_ns[:-1]))
    use = (value >= COLDEST) & (value <= HOTTEST)
    use &= stamp_ns > np.maximum.accumulate(before[: len(stamp_ns)])
    stamp_ns, value = stamp_ns[use], value[use]
    span_s = np.ptp(stamp_ns) * 1e-9 if len(stamp_ns) else 0.0
    size = int(0.2 * (len(stamp_ns) - 1) / span_s) if span_s else 1
    n = len(stamp_ns) // size * size if size > 1 else 0
    if n:
        first = stamp_ns[0]
        middle = np.mean((stamp_ns[:n] - first).reshape(-1, size), axis=1)
        stamp_ns = first + middle.astype(np.int64)
        value = np.mean(value[:n].reshape(-1, size), axis=1)
    return Readings(stamp_ns, value)


def is_spike(value: Floats) -> Bools:
    """
    Return which readings are more than 10 K from the median of five readings, shape (n,).

    A thermometer without contact reads -127 or 85 degC for a moment. The tracker rejects spikes,
    unless spikes have increased the noise that a fit expects of the thermometer.
    """
    far = np.zeros(len(value), dtype=bool)
    if len(value) > 4:
        middle = np.median(sliding_window_view(value, 5), axis=1)
        far[2:-2] = np.abs(value[2:-2] - middle) > 10.0
    return far
