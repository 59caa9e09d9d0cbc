# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a recording tells that is too little for a calibration.

One attitude over temperature gives the drift along gravity; many attitudes without temperature
give bias, scale and misalignment as they were that day. Neither is written as a calibration.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import FitError
from ..recording import Input, Topics
from .fit_sources import recording_source
from .one_pose import (
    BranchFit,
    Pose,
    PoseOptions,
    fit_branches,
    fit_whole,
    read_pose,
)
from .reduction import ReducedBag, reduce_source
from .rests import ONE_ATTITUDE_DEG, attitudes_apart
from .triad import TriadFit, fit_triad

# A hand holds still for seconds only.
_WINDOW_S, _CELL_S, _MIN_STILL_S = 1.0, 0.5, 2.0


@dataclass(frozen=True)
class Partial:
    """
    What a recording tells; one of the two.

    Parameters
    ----------
    source : str
        The recording.
    missing : str or None
        What of it could not be read.
    pose : Pose or None
        One attitude: the reduced recording, with its jumps.
    fits : tuple of BranchFit
        One attitude: the whole rest as one branch, or each branch.
    triad : TriadFit or None
        Several attitudes.
    bag : ReducedBag
        The still intervals.

    """

    source: str
    missing: str | None
    pose: Pose | None
    fits: tuple[BranchFit, ...]
    triad: TriadFit | None
    bag: ReducedBag


def tell(
    path: str | Path,
    options: PoseOptions,
    *,
    by_branch: bool = False,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
) -> Partial:
    """
    Say what a recording tells.

    Parameters
    ----------
    path : str or Path
        The recording.
    options : PoseOptions
        Local gravity, part of the recording; its unit is taken from the recording.
    by_branch : bool, optional
        Fit each run between jumps by itself, instead of refusing the whole.
    topics : Topics or None, optional
        Names of the inputs.
    input : {'auto', 'counts', 'imu'}, optional
        What is read.

    Returns
    -------
    Partial
        The result.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    FitError
        If it tells nothing, with the reason.

    """
    source, info = recording_source(path, topics, input)
    options = replace(options, input='m/s^2' if info.input == 'imu' else 'counts')
    bag = reduce_source(
        source,
        0,
        window_s=_WINDOW_S,
        cell_s=_CELL_S,
        min_still_s=_MIN_STILL_S,
        full_scale=options.full_scale,
    )
    apart = attitudes_apart([bag]) if bag.intervals else 0.0
    if apart > ONE_ATTITUDE_DEG:
        if options.gravity is None:
            raise FitError(
                f'{source.name}: it rests in attitudes {apart:.0f} deg apart; bias '
                'and scale need local gravity: give `--gravity`, or `--latitude` and `--height`'
            )
        return Partial(
            source.name, source.missing(), None, (), fit_triad(bag.intervals, options.gravity), bag
        )
    pose = read_pose(source, options)
    if by_branch:
        fits = fit_branches(pose)
    else:
        model = fit_whole(pose)
        fits = (BranchFit(pose.branches[0], model, ''),)
    return Partial(source.name, source.missing(), pose, fits, None, pose.bag)


def temperature_span(bag: ReducedBag) -> float:
    """
    Return highest less lowest board temperature [K], 0 where there is none.

    """
    return float(np.ptp(bag.board.value)) if len(bag.board.value) else 0.0
