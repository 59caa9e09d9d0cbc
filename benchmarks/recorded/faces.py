# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what is found in a session of six faces: bias and scale come out, M is refused.

"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from thermo_comp.fitting.partial import recording_source
from thermo_comp.fitting.triad import TriadFit, fit_triad

from thermo_comp.errors import FitError
from thermo_comp.typing import Floats

from .data import GRAVITY, faces_bag, still_bag


@dataclass(frozen=True)
class Faces:
    """
    The session.

    Parameters
    ----------
    n_positions : int
        Still intervals, found by themselves beside three rotations.
    fit : TriadFit
        Bias and scale.
    refusal : str
        What is said when M is asked for.
    by_hand_bias, by_hand_scale : ndarray, shape (3,)
        Half the sum and half the difference of each axis' largest and smallest mean, the latter
        over g: what six faces give where each is exactly level.

    """

    n_positions: int
    fit: TriadFit
    refusal: str
    by_hand_bias: Floats
    by_hand_scale: Floats


def read_faces(folder: Path, work: Path) -> Faces:
    """
    Find the faces and fit them.

    """
    source, _ = recording_source(faces_bag(folder, work))
    intervals = still_bag(source).intervals
    means = np.array([np.average(one.mean, axis=0, weights=one.count) for one in intervals])
    refusal = ''
    try:
        fit_triad(intervals, GRAVITY, misalignment=True)
    except FitError as refused:
        refusal = str(refused)
    high, low = means.max(axis=0), means.min(axis=0)
    return Faces(
        n_positions=len(intervals),
        fit=fit_triad(intervals, GRAVITY),
        refusal=refusal,
        by_hand_bias=0.5 * (high + low),
        by_hand_scale=0.5 * (high - low) / GRAVITY,
    )
