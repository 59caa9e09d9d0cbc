# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the columns of the thermal response: what there is to regress bias and scale on.

"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from .schema import Bounds, NotNegative


@dataclass(frozen=True)
class Column:
    """
    One regressor of the thermal response; its keys are the calibration file's.

    Raises
    ------
    ValueError
        If the keys contradict each other: naming the key, the rule and the value.

    """

    group: Annotated[
        Literal['now', 'rate', 'board', 'neighbour', 'product', 'even', 'play'],
        'What evidence judges together.',
    ]
    kind: Annotated[
        Literal['now', 'rate', 'board', 'neighbour', 'even', 'play'],
        'g_s; dT_board/dt [K/s]; T - lagged T; lagged g_s; tanh((g_s / width)^2); '
        'play of t minus t, where g_s = T_s - T_board.',
    ]
    sensor: Annotated[str, 'Which further thermometer g_s is of.'] = 'case'
    tau_s: Annotated[
        NotNegative, 'Time constant of the lag (board, neighbour; play: 0 = none).'
    ] = 0.0
    width_k: Annotated[NotNegative, 'Width of even, half-width of play.'] = 0.0
    power: Annotated[int, Bounds(at_least=0), 'The value is multiplied by t to this power.'] = 0
    during: Annotated[
        Literal['always', 'static', 'dynamic'],
        'always, or multiplied by 1 - w (static) or by w (dynamic), w = weight of the regime.',
    ] = 'always'
    range: Annotated[
        tuple[float, float],
        'Range of the value before t and w multiply it; held at its edges outside.',
    ] = field(kw_only=True)

    def __post_init__(self) -> None:
        lower, upper = self.range
        if not lower < upper:
            raise ValueError(
                f'`range` must be [lower, upper] with lower < upper, got [{lower}, {upper}]'
            )
        for key, kinds in (('tau_s', ('board', 'neighbour')), ('width_k', ('even', 'play'))):
            if self.kind in kinds and not getattr(self, key) > 0.0:
                raise ValueError(
                    f'`{key}` must be greater than 0 for {self.kind}, got {getattr(self, key):g}'
                )
