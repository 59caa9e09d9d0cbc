# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what makes a report a certificate: statements, results, budget, after ISO/IEC 17025."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from ..errors import ThermoCompError
from ..judging.verdicts import Verdict
from ..plain_yaml import read_plain_yaml
from ..quantities import Bounds
from ..typing import Floats
from ..unit.calibration import AXES, Calibration
from ..unit.gravity import MICRO_G
from ..unit.prediction import bias_and_scale, in_a_soak, ramp_states
from ..unit.schema import NotNegative, SchemaError, build
from .evidence import Evidence
from .html import number, rounded

#: Coverage factor of an expanded uncertainty: 95 % of a normal distribution.
COVERAGE = 2.0
_N_SLOPE = 33

Text = Annotated[str, Bounds(longest=500)]


@dataclass(frozen=True)
class Party:
    """Who calibrates, or for whom."""

    name: Text = ''
    address: Text = ''
    accreditation: Text = ''


@dataclass(frozen=True)
class Item:
    """What was calibrated."""

    maker: Text = ''
    model: Text = ''
    serial: Text = ''


@dataclass(frozen=True)
class Instrument:
    """What it was calibrated with: the chamber, a thermometer."""

    name: Text
    model: Text = ''
    serial: Text = ''
    traceability: Text = ''


@dataclass(frozen=True)
class GravityStatement:
    """How well local gravity is known, and from where."""

    standard_uncertainty_m_s2: NotNegative | None = None
    source: Text = ''


@dataclass(frozen=True)
class Thermometers:
    """How far the unit's thermometers may drift between the calibration and its use."""

    standard_uncertainty_k: NotNegative | None = None


@dataclass(frozen=True)
class Dates:
    """When, as in 2026-03-31."""

    test: Text = ''
    issue: Text = ''
    due: Text = ''

    def __post_init__(self) -> None:
        for name in ('test', 'issue', 'due'):
            value = getattr(self, name)
            try:
                _ = value and dt.date.fromisoformat(value)
            except ValueError:
                raise ValueError(
                    f'`{name}` must be a date like 2026-03-31, got {value!r}'
                ) from None


@dataclass(frozen=True)
class CertificateInfo:
    """What a laboratory says of a calibration, key by key as in its file; all may be left out."""

    number: Text = ''
    laboratory: Party = Party()
    customer: Party = Party()
    operator: Text = ''
    unit: Item = Item()
    instruments: tuple[Instrument, ...] = ()
    gravity: GravityStatement = GravityStatement()
    thermometers: Thermometers = Thermometers()
    dates: Dates = Dates()
    conditions: Text = ''
    remarks: Text = ''
    signatory: Text = ''


def load_certificate_info(path: str | Path, serial: str | None = None) -> CertificateInfo:
    """Read a laboratory's statements; ThermoCompError, with file and key, if one is wrong."""
    data = read_plain_yaml(path)
    try:
        info = build(CertificateInfo, {} if data is None else data)
        if serial and info.unit.serial and info.unit.serial != serial:
            raise SchemaError(
                'unit.serial', f'must be that of the calibration, {serial}, got {info.unit.serial}'
            )
    except ValueError as error:
        raise ThermoCompError(f'{path}: {error}') from error
    return info


class Contribution(NamedTuple):
    """One line of the uncertainty budget: a standard uncertainty of |f| [m/s^2]."""

    name: str
    evaluation: str
    standard: float | None  # None where nobody has said it
    basis: str


class Result(NamedTuple):
    """One line of the results, with its expanded uncertainty (k = 2), rounded as such are."""

    quantity: str
    value: str
    expanded: str
    unit: str


def budget(evidence: Evidence, info: CertificateInfo) -> tuple[Contribution, ...]:
    """Split the uncertainty of ``|f|`` at rest into what it comes from; empty unjudged."""
    judgement, calibration = evidence.judgement, evidence.calibration
    if judgement is None or calibration is None or not judgement.sections['all'].n:
        return ()
    windows = judgement.windows.select(judgement.windows.is_inside)
    noise = _rms(windows.noise_sd)
    attitude = model = None
    claimed = noise
    if calibration.has_uncertainty:
        x, y, z = (windows.force / np.linalg.norm(windows.force, axis=1, keepdims=True)).T
        # d|f| / dM for the three elements below the diagonal, of a vector of length g.
        by_element = np.stack((x * y, x * z, y * z)) * windows.gravity
        attitude = _rms(np.linalg.norm(by_element.T * calibration.misalignment_sd, axis=1))
        claimed = _rms(windows.claimed_sd)
        model = float(np.sqrt(max(claimed**2 - noise**2 - attitude**2, 0.0)))
    rest = float(np.sqrt(max(judgement.headline_rms**2 - claimed**2, 0.0)))
    drift_k, drift, slope = info.thermometers.standard_uncertainty_k, None, ''
    if drift_k is not None:
        drift = drift_k * _slope(calibration)
        slope = f'{drift_k:g} K times the slope of the correction'
    seconds = f'white noise of a mean over {windows.window_s:g} s'
    beyond = 'what the residual exceeds noise, attitude and model by'
    return (
        Contribution('noise', 'A', noise, seconds),
        Contribution('gravity', 'B', info.gravity.standard_uncertainty_m_s2, info.gravity.source),
        Contribution('attitude', 'A', attitude, 'axes not at right angles; |f| needs no fixture'),
        Contribution('thermometers', 'B', drift, slope),
        Contribution('model', 'A', model, 'posterior of all parameters at the judged windows'),
        Contribution('repeatability', 'A', rest, beyond),
    )


def combined(contributions: tuple[Contribution, ...]) -> float:
    """Add up a budget: the combined standard uncertainty of what was said [m/s^2]."""
    return float(np.sqrt(sum((one.standard or 0.0) ** 2 for one in contributions)))


def results(
    evidence: Evidence, info: CertificateInfo, contributions: tuple[Contribution, ...]
) -> list[Result]:
    """List the constants at the reference temperature, and the error that is left of |f|."""
    calibration = evidence.calibration
    if calibration is None:
        return []
    unit = 'counts' if calibration.unit.input == 'counts' else 'm/s²'
    bias, bias_sd, scale, scale_sd = in_a_soak(calibration)
    # Without a claim there is no uncertainty to expand.
    known = COVERAGE if calibration.has_uncertainty else np.nan
    by_gravity = (info.gravity.standard_uncertainty_m_s2 or 0.0) / calibration.gravity_m_s2
    scale_sd = np.hypot(scale_sd, by_gravity) * np.abs(scale)
    below = ((1, 0), (2, 0), (2, 1))
    said = {
        'scale factor {}': (AXES, scale, scale_sd, f'{unit} per m/s²'),
        'bias {}': (AXES, bias / MICRO_G, bias_sd / MICRO_G, 'µg'),
        'misalignment {}': (
            [AXES[i] + AXES[j] for i, j in below],
            1e6 * np.array([calibration.misalignment[i][j] for i, j in below]),
            1e6 * np.array(calibration.misalignment_sd),
            'µrad',
        ),
    }
    found = [
        Result(name.format(part), *rounded(float(value), float(known * sd)), of)
        for name, (parts, values, sds, of) in said.items()
        for part, value, sd in zip(parts, values, sds, strict=True)
    ]
    if contributions and evidence.judgement is not None:
        expanded_ug = COVERAGE * combined(contributions) / MICRO_G
        for name in ('static', 'dynamic'):
            one = evidence.judgement.sections[name]
            if one.n:
                texts = rounded(one.mean / MICRO_G, expanded_ug if known > 0.0 else np.nan)
                found.append(Result(f'mean of |f| − g, {name}', *texts, 'µg'))
    return found


def conformity_rule(evidence: Evidence) -> str:
    """Say by which rule the verdict was found."""
    judgement = evidence.judgement
    if judgement is None:
        return 'No recording was judged: no statement of conformity is made.'
    if judgement.tolerance is not None:
        limit = number(judgement.tolerance / MICRO_G)
        return (
            f'Simple acceptance: the RMS of |f| − g of each regime within the calibrated ranges '
            f'is at most the limit of {limit} µg and below that without the correction; the '
            'uncertainty is not subtracted from the limit (guard band 0).'
        )
    if judgement.kind is Verdict.NO_CLAIM:
        return (
            'No limit was specified and the calibration states no uncertainty: no statement of '
            'conformity is made.'
        )
    return (
        'No limit was specified. The calibration conforms to its own statement: in each regime '
        'the RMS of |f| − g is at most twice the RMS of what is claimed for the same windows, '
        'and below that without the correction.'
    )


def _slope(calibration: Calibration) -> float:
    """RMS over the static range and the axes of the bias per kelvin [m/s^2/K]."""
    temperature = np.linspace(*calibration.static.temperature_range_c, _N_SLOPE)
    bias, _ = bias_and_scale(calibration, ramp_states(calibration, temperature))
    return _rms(np.diff(bias, axis=0) / np.diff(temperature)[:, None])


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
