# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the user may say of a fit.

"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from ..thermal.settings import DetectorSettings

#: The converter of the paper's unit: 16 bits in two's complement.
COUNTS_FULL_SCALE = 32767.0


@dataclass(frozen=True)
class FitOptions:
    """
    Options of a fit.

    Parameters
    ----------
    gravity : float
        Local gravity; see `gravity.resolve_gravity`.
    model : str, optional
        ``auto``, ``golovach`` (the paper: static linear, quadratic where the soaks bend;
        dynamic quadratic), or a candidate's name such as ``quadratic+gradient+memory2``.
    serial : str or None, optional
        Unit serial; None takes the sources'.
    input : {'counts', 'm/s^2'}, optional
        Unit of the samples.
    full_scale : float or None, optional
        Magnitude of a saturated sample; None takes 32767 for counts, and for m/s^2 the smallest
        usual range that holds the data.
    reference_temperature : float, optional
        T_ref; the paper uses 20.
    misalignment : bool or None, optional
        Whether M is estimated; None decides by the positions.
    detector : DetectorSettings or None, optional
        Thermometer and detector settings; None learns them from the bags.
    transition_time_s : float, optional
        Cross-over time of the sets, as the node will use.
    window_s, cell_s, min_still_s : float, optional
        Lengths of a window, of a cell and of the shortest still interval.
    selection_window_s : float, optional
        Length of the windows on which candidates are compared.
    allow : tuple of str, optional
        Names of refusals that the user overrides, see `verdict`.

    Raises
    ------
    ValueError
        If a value is outside its range.

    """

    gravity: float
    model: str = 'auto'
    serial: str | None = None
    input: Literal['counts', 'm/s^2'] = 'counts'
    full_scale: float | None = None
    reference_temperature: float = 20.0
    misalignment: bool | None = None
    detector: DetectorSettings | None = None
    transition_time_s: float = 30.0
    window_s: float = 10.0
    cell_s: float = 0.5
    min_still_s: float = 3.0
    selection_window_s: float = 60.0
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ('gravity', 'window_s', 'cell_s', 'min_still_s', 'selection_window_s'):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f'`{name}` must be positive, got {value}')
        if self.full_scale is not None and not 0.0 < self.full_scale < math.inf:
            raise ValueError(f'`full_scale` must be positive, got {self.full_scale}')
        if self.input not in ('counts', 'm/s^2'):
            raise ValueError(f"`input` must be 'counts' or 'm/s^2', got {self.input!r}")
        if not self.cell_s <= self.window_s:
            raise ValueError(
                f'`cell_s` must not exceed `window_s` ({self.window_s}), got {self.cell_s}'
            )
