# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the statements of a laboratory on a certificate, and the reading of their file."""

import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ..errors import ThermoCompError
from ..plain_yaml import read_plain_yaml
from ..quantities import Bounds, NotNegative
from ..unit.schema import SchemaError, build

Text = Annotated[str, Bounds(longest=500)]


@dataclass(frozen=True)
class Party:
    """The laboratory that calibrates, or its customer."""

    name: Text = ''
    address: Text = ''
    accreditation: Text = ''


@dataclass(frozen=True)
class Item:
    """The calibrated unit, and its condition at receipt."""

    maker: Text = ''
    model: Text = ''
    serial: Text = ''
    condition: Text = ''


@dataclass(frozen=True)
class Instrument:
    """An instrument of the calibration: the chamber, a thermometer."""

    name: Text
    model: Text = ''
    serial: Text = ''
    traceability: Text = ''


@dataclass(frozen=True)
class GravityStatement:
    """Standard uncertainty of local gravity, and its source."""

    standard_uncertainty_m_s2: NotNegative | None = None
    source: Text = ''


@dataclass(frozen=True)
class Thermometers:
    """Standard uncertainty of the unit's thermometers due to drift between calibration and use."""

    standard_uncertainty_k: NotNegative | None = None


@dataclass(frozen=True)
class Dates:
    """Dates like 2026-03-31; `receipt` is the day on which the laboratory received the unit."""

    receipt: Text = ''
    test: Text = ''
    issue: Text = ''
    due: Text = ''

    def __post_init__(self) -> None:
        for name in ('receipt', 'test', 'issue', 'due'):
            value = getattr(self, name)
            try:
                _ = value and dt.date.fromisoformat(value)
            except ValueError:
                raise ValueError(
                    f'`{name}` must be a date like 2026-03-31, got {value!r}'
                ) from None


@dataclass(frozen=True)
class CertificateInfo:
    """Statements of a laboratory about a calibration; all keys of its file are optional."""

    number: Text = ''
    laboratory: Party = Party()
    customer: Party = Party()
    place: Text = ''
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
    """Read a laboratory's statements; ThermoCompError names file and key of a wrong value."""
    data = read_plain_yaml(path)
    try:
        info = build(CertificateInfo, {} if data is None else data)
        if serial and info.unit.serial and info.unit.serial != serial:
            raise SchemaError(
                'unit.serial', f'must be {serial}, as in the calibration, got {info.unit.serial}'
            )
    except ValueError as error:
        raise ThermoCompError(f'{path}: {error}') from error
    return info
