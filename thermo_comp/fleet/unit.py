# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the work of one worker: read the bags of a unit one after the other, and fit it."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np

from .. import __version__
from ..errors import FitError, RecordingError, ThermoCompError
from ..fitting import FitOptions, FitResult, ReducedBag, fit_bags, reduce_bag
from ..fitting.fit_sources import digest, recording_source
from ..fitting.verdict import can_tell_misalignment
from ..recording import Input, Role, Topics
from ..text import one_line
from ..unit.calibration_file import dump_calibration
from .discovery import FoundBag, FoundUnit
from .storage import Storage
from .table import FAILED, NOT_JUDGED, REFUSED, Cell, empty_row, fitted_cells, judged_cells

_NEEDED: tuple[Role, ...] = ('accel', 'board')
# What the fit has to say of bags that leave something of the unit to its prior.
_LACKS = frozenset({'temperature', 'ramps', 'directions', 'misfit'})


@dataclass(frozen=True)
class FleetOptions:
    """What the user says of all units alike; serial and input are those of the bags."""

    fit: FitOptions
    topics: Topics | None = None
    input: Input = 'auto'
    certificates: bool = True

    @property
    def prior_sha256(self) -> str:
        """Hash of the calibration that fits begin with; empty where there is none."""
        prior = self.fit.prior
        return (
            '' if prior is None else hashlib.sha256(dump_calibration(prior).encode()).hexdigest()
        )

    def digest(self) -> str:
        """Hash everything that a result depends on besides its bags."""
        plain = replace(self, fit=replace(self.fit, prior=None))
        said = {'version': __version__, 'prior': self.prior_sha256, **asdict(plain)}
        text = json.dumps(said, sort_keys=True, default=repr)
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class UnitOutcome:
    """
    What came out of one unit, small enough to travel.

    `is_final`: the same bags would give the same again; a failed file system may not. Files and
    hashes that there are not are empty.
    """

    row: dict[str, Cell]
    hashes: dict[str, str]
    is_final: bool
    calibration: str = ''
    certificate: str = ''


@dataclass(frozen=True)
class _Bag:
    """What a unit's fit has of one bag: its sufficient statistics, or why there are none."""

    name: str
    sha256: str = ''
    reduced: ReducedBag | None = None
    input: Literal['counts', 'm/s^2'] = 'counts'
    problem: str = ''
    is_passing: bool = False  # the file system failed, not the bag


def process_unit(unit: FoundUnit, url: str, options: FleetOptions) -> UnitOutcome:
    """Read and fit a unit; no bag stops it, no unit stops the fleet."""
    began = time.process_time()
    storage = Storage(url)
    bags = [_read(storage, bag, options) for bag in unit.bags]
    good = [one.reduced.source for one in bags if one.reduced is not None]
    serials = sorted({source.serial for source in good if source.serial})
    serial = serials[0] if serials else unit.name.rpartition('/')[2]
    outcome = UnitOutcome(
        row=empty_row(
            name=unit.name,
            serial=serial,
            lot=next(filter(None, (one.metadata.get('lot') for one in good)), unit.lot),
            n_bags=len(bags),
            n_left_out=len(bags) - len(good),
            n_torn=sum(bool(source.missing()) for source in good),
            left_out='; '.join(one.problem for one in bags if one.problem),
            n_bytes=sum(bag.n_bytes for bag in unit.bags),
            prior=options.prior_sha256,
            tool_version=__version__,
        ),
        hashes={one.name: one.sha256 for one in bags},
        is_final=not any(one.is_passing for one in bags),
    )
    try:
        if len(serials) > 1:
            raise FitError(f'the bags are of different units: {", ".join(serials)}')
        outcome = _fitted(outcome, bags, serial, options)
    except FitError as refusal:
        outcome.row.update(verdict=REFUSED, problem=one_line(str(refusal)))
    except ThermoCompError as failure:
        outcome.row.update(verdict=FAILED, problem=one_line(str(failure)))
    outcome.row['cpu_s'] = time.process_time() - began
    return outcome


def _read(storage: Storage, bag: FoundBag, options: FleetOptions) -> _Bag:
    """Hash a bag and keep its sufficient statistics, some kilobytes per hour."""
    result = _Bag(bag.name)
    try:
        with storage.here(bag.name, bag.files) as path:
            result = replace(result, sha256=digest(path))
            source, info = recording_source(path, options.topics, options.input, require=_NEEDED)
            source = replace(source, sha256=result.sha256)
            unit: Literal['counts', 'm/s^2'] = 'm/s^2' if info.input == 'imu' else 'counts'
            reduced = reduce_bag(source, 0, replace(options.fit, input=unit))
    except RecordingError as error:
        # Named as the fleet does, wherever it lies.
        said = ': '.join(part for part in (bag.name, error.topic, error.message) if part)
        return replace(result, problem=said, is_passing=isinstance(error.__cause__, OSError))
    except OSError as error:
        said = f'{bag.name}: {error.strerror or error}'
        return replace(result, problem=said, is_passing=True)
    except FitError as error:
        return replace(result, problem=str(error))
    return replace(result, reduced=reduced, input=unit)


def _fitted(
    outcome: UnitOutcome, bags: Sequence[_Bag], serial: str, options: FleetOptions
) -> UnitOutcome:
    from ..report import evidence_of_fit, render_report

    row = outcome.row
    good = [(one, one.reduced) for one in bags if one.reduced is not None]
    if not good:
        raise ThermoCompError('none of its bags can be used')
    kinds = {one.input: one.name for one, _ in good}
    if len(kinds) > 1:
        said = ', '.join(f'{name} holds {kind}' for kind, name in sorted(kinds.items()))
        raise FitError(f'{said}: choose one with --input')
    settings = replace(options.fit, input=good[0][0].input, serial=serial)
    result = fit_bags(_numbered([reduced for _, reduced in good]), settings)
    calibration = dump_calibration(result.calibration)
    sources = [reduced.source for _, reduced in good]
    lost = [f'{source.name}: {torn}' for source in sources if (torn := source.missing())]
    if row['n_left_out']:
        lost.append(f'{row["n_left_out"]} of {row["n_bags"]} bags are left out: {row["left_out"]}')
    evidence = evidence_of_fit(result, is_brief=not options.certificates)
    evidence = replace(evidence, findings=(*evidence.findings, *lost))
    judged = evidence.judgement
    cells = {
        **row,
        **fitted_cells(result),
        'reservations': '; '.join(evidence.findings),
        'is_whole': int(_tells_all(result)),
        'calibration_sha256': hashlib.sha256(calibration.encode()).hexdigest(),
        **({'verdict': NOT_JUDGED} if judged is None else judged_cells(judged)),
    }
    page = render_report(evidence) if options.certificates else ''
    return replace(outcome, row=empty_row(**cells), calibration=calibration, certificate=page)


def _numbered(bags: Sequence[ReducedBag]) -> list[ReducedBag]:
    """Give each bag's intervals the number of its place."""
    return [
        replace(bag, intervals=tuple(replace(one, bag=number) for one in bag.intervals))
        for number, bag in enumerate(bags)
    ]


def _tells_all(result: FitResult) -> bool:
    """Whether nothing of the unit was left to the fit's prior: it can speak for its type."""
    up = np.array([one.up for one in result.positions])
    lacking = {one.name for one in result.findings if one.level != 'good'}
    return can_tell_misalignment(up) and not _LACKS & lacking
