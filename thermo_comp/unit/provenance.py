# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the record of a calibration's origin: bags, residuals and the evidence for the columns."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from ..quantities import QUANTITIES

_Error = Annotated[float, QUANTITIES['error']]
_Number = Annotated[int, QUANTITIES['number']]
_WeightSd = Annotated[float, QUANTITIES['deviation of a weight']]


@dataclass(frozen=True)
class GroupEvidence:
    """Contribution of one group of columns to the correction in the fitted data."""

    group: Annotated[str, 'Name of the group, as in the key `response`.']
    part: Annotated[Literal['bias', 'scale'], 'Quantity that the group corrects.']
    explains_m_s2: Annotated[_Error, 'RMS of the correction by the columns, in the fitted data.']
    effective_parameters: Annotated[
        float, QUANTITIES['number'], 'Effective number of weights determined by the data.'
    ]
    log_evidence_change: Annotated[
        float,
        QUANTITIES['log evidence'],
        'Loss of log evidence if the group is left out or, in a fit with a prior, if the weights '
        'of the group keep the mean of the prior.',
    ]
    prior_sd: Annotated[tuple[_WeightSd, ...], "Prior sd of the group's weights."]


@dataclass(frozen=True)
class Source:
    """One bag of a fit, or all rest logs of an update."""

    name: str
    sha256: str = ''
    n_samples: _Number = 0


@dataclass(frozen=True)
class ResidualSummary:
    """
    Residual ``|f| - g`` of the fitted windows of one regime or of both regimes. `raw_rms_m_s2` is
    the RMS of windows corrected for bias and scale at T_ref only.
    """

    section: str
    n_windows: _Number
    raw_rms_m_s2: _Error
    rms_m_s2: _Error
    max_m_s2: _Error
    left_out_rms_m_s2: Annotated[
        _Error | None,
        'RMS error of the magnitude of the force in positions, each corrected by a fit to the '
        'other positions; null if these do not determine the magnitude in each position.',
    ] = None
    left_out_drift_m_s2: Annotated[
        _Error | None,
        'RMS drift of an axis (force less its mean in the position) on data that the fit leaves '
        'out: each position in turn or, if the other positions do not determine its drift, each '
        'section of the temperature program; null if unknown.',
    ] = None


@dataclass(frozen=True)
class Provenance:
    """Origin of the numbers of a calibration."""

    created: str = ''
    tool_version: str = ''
    model: str = ''
    sources: tuple[Source, ...] = ()
    residuals: tuple[ResidualSummary, ...] = ()
    notes: tuple[str, ...] = ()
    tested: Annotated[str, "End of the last bag or rest (UTC), if the bags' stamps are dates."] = (
        ''
    )

    @property
    def date(self) -> str:
        """The date of the test if it is known, else the date of the fit, or ''."""
        return self.tested or self.created

    @property
    def left_out_rms(self) -> float:
        """RMS of ``|f| - g`` on positions left out of the fit [m/s^2]; NaN where unknown."""
        return _of_all([(row.section, row.left_out_rms_m_s2) for row in self.residuals])

    @property
    def left_out_drift(self) -> float:
        """RMS drift of an axis on data left out of the fit [m/s^2]; NaN where unknown."""
        return _of_all([(row.section, row.left_out_drift_m_s2) for row in self.residuals])


def _of_all(values: list[tuple[str, float | None]]) -> float:
    """Return the value of the section ``all``; NaN if it is unknown."""
    value = dict(values).get('all')
    return math.nan if value is None else value
