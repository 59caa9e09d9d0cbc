# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what the user may say of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from ..recording.stillness import STILL_SD
from ..thermal.settings import DetectorSettings
from ..unit.calibration import Calibration
from ..unit.gravity import STANDARD_GRAVITY

#: The converter of the paper's unit: 16 bits in two's complement.
COUNTS_FULL_SCALE = 32767.0
#: Families of the curve over temperature.
CURVES = ('linear', 'quadratic', 'cubic', 'spline', 'exponential')
#: What evidence judges: curve and set of the two sets, then the groups of the response.
GROUPS = (
    'curve', 'set', 'now', 'board', 'neighbour', 'product', 'mixed', 'square', 'even', 'play',
)  # fmt: skip
#: What is refused, and may be allowed by its name.
REFUSALS = ('saturation', 'units', 'jump', 'swapped')


@dataclass(frozen=True)
class Ageing:
    """
    What a unit has changed by since its last calibration.

    bias: standard deviation of each bias [m/s^2]
    scale: of each relative scale factor
    """

    bias: float = 0.0
    scale: float = 0.0

    def __post_init__(self) -> None:
        for name in ('bias', 'scale'):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f'`{name}` must be 0 or positive, got {getattr(self, name)}')


@dataclass(frozen=True)
class FitOptions:
    """
    Options of a fit.

    gravity: local gravity; see `gravity.resolve_gravity`
    model: the whole bank, thinned by evidence; or the paper: a linear static and a quadratic
        dynamic set, without a response
    static_curve, dynamic_curve: ``linear``, ``quadratic``, ``cubic``, ``spline`` or
        ``exponential``; None takes the model's own
    groups: groups of columns that may take part; None takes all
    forced: groups that stay whatever they earn
    prior: what is known beforehand: of the type of unit, or of this unit; its columns are the
        model
    ageing: what the prior's covariance has grown by since
    serial: unit serial; None takes the sources'
    input: unit of the samples
    full_scale: magnitude of a saturated sample; None takes 32767 for counts, and for m/s^2 the
        smallest usual range that holds the data
    offset: what raw words read without a force, as 32768; None finds it out
    reference_temperature: T_ref; the paper uses 20
    detector: thermometer and detector settings; None learns them from the bags
    transition_time_s: cross-over time of the sets, as the node will use
    window_s, cell_s: lengths of a window and of a cell
    min_rest_s: length of the shortest rest; None chooses, see `reduction`
    still_sd: largest scatter of the samples at rest [m/s^2]
    regression_window_s: length up to which neighbouring windows of a position are merged for the
        regression
    allow: names of refusals that the user overrides, see `verdict`

    Raises ValueError if a value is outside its range.
    """

    gravity: float
    model: Literal['response', 'golovach'] = 'response'
    static_curve: str | None = None
    dynamic_curve: str | None = None
    groups: tuple[str, ...] | None = None
    forced: tuple[str, ...] = ()
    prior: Calibration | None = None
    ageing: Ageing = Ageing()
    serial: str | None = None
    input: Literal['counts', 'm/s^2'] = 'counts'
    full_scale: float | None = None
    offset: float | None = None
    reference_temperature: float = 20.0
    detector: DetectorSettings | None = None
    transition_time_s: float = 30.0
    window_s: float = 10.0
    cell_s: float = 0.5
    min_rest_s: float | None = None
    still_sd: float = STILL_SD * STANDARD_GRAVITY
    regression_window_s: float = 60.0
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in (
            'gravity', 'window_s', 'cell_s', 'min_rest_s', 'still_sd', 'regression_window_s',
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f'`{name}` must be positive, got {value}')
        if self.full_scale is not None and not 0.0 < self.full_scale < math.inf:
            raise ValueError(f'`full_scale` must be positive, got {self.full_scale}')
        if self.offset is not None and not math.isfinite(self.offset):
            raise ValueError(f'`offset` must be finite, got {self.offset}')
        if self.input not in ('counts', 'm/s^2'):
            raise ValueError(f"`input` must be 'counts' or 'm/s^2', got {self.input!r}")
        if self.model not in ('response', 'golovach'):
            raise ValueError(f"`model` must be 'response' or 'golovach', got {self.model!r}")
        for name in ('static_curve', 'dynamic_curve'):
            value = getattr(self, name)
            if value is not None and value not in CURVES:
                raise ValueError(f'`{name}` must be one of {", ".join(CURVES)}, got {value!r}')
        for group in (*(self.groups or ()), *self.forced):
            if group not in GROUPS:
                raise ValueError(f'`groups` must be of {", ".join(GROUPS)}, got {group!r}')
        for name in self.allow:
            if name not in REFUSALS:
                raise ValueError(f'`allow` must be of {", ".join(REFUSALS)}, got {name!r}')
        if not self.cell_s <= self.window_s:
            raise ValueError(
                f'`cell_s` must not exceed `window_s` ({self.window_s}), got {self.cell_s}'
            )
