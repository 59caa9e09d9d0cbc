# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the work of one worker: read the bags of a unit one after the other, and fit it."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from .. import __version__
from ..errors import FitError, RecordingError, ThermoCompError
from ..fitting import FitOptions, ReducedBag, fit_bags, reduce_bag
from ..fitting.sources import digest, recording_source
from ..recording import Input, Topics
from ..text import one_line
from ..unit.calibration_file import dump_calibration
from .table import FAILED, REFUSED, Cell, fitted_cells, row_of
from .units import FoundUnit, Storage

_UNIT_OF: dict[str | None, Literal['counts', 'm/s^2']] = {'counts': 'counts', 'imu': 'm/s^2'}


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
        return '' if self.fit.prior is None else _sha256(dump_calibration(self.fit.prior))

    def digest(self) -> str:
        """Hash everything that a result depends on besides its bags."""
        plain = replace(self, fit=replace(self.fit, prior=None))
        said = {'version': __version__, 'prior': self.prior_sha256, **asdict(plain)}
        return _sha256(json.dumps(said, sort_keys=True, default=repr))


@dataclass(frozen=True)
class UnitOutcome:
    """
    What came out of one unit, small enough to travel: its row, the hashes of its bags, its files.

    `is_final`: the same bags would give the same again; a failed file system may not.
    """

    row: dict[str, Cell]
    hashes: dict[str, str]
    is_final: bool
    calibration: str = ''
    certificate: str = ''


def started_row(unit: FoundUnit, **known: Any) -> dict[str, Cell]:
    """Make the row of a unit of which nothing is known but its files, and what is given."""
    started = {
        'name': unit.name,
        'serial': unit.name.rpartition('/')[2],
        'lot': unit.lot,
        'n_bags': len(unit.bags),
        'n_bytes': unit.n_bytes,
        'tool_version': __version__,
    }
    return row_of(**(started | known))


def process_unit(unit: FoundUnit, url: str, options: FleetOptions) -> UnitOutcome:
    """Read and fit a unit; no bag stops it, no unit stops the fleet."""
    began = time.process_time()
    storage = Storage(url)
    hashes = dict.fromkeys(unit.bags, '')
    # Of a bag its sufficient statistics are kept, some kilobytes per hour.
    bags: dict[str, ReducedBag] = {}
    problems = []
    is_final = True
    for name, files in unit.bags.items():
        try:
            with storage.here(name, files) as path:
                hashes[name] = digest(path)
                source, info = recording_source(
                    path, options.topics, options.input, require=('accel', 'board')
                )
                how = replace(options.fit, input=_UNIT_OF[info.input])
                bags[name] = reduce_bag(replace(source, sha256=hashes[name]), how)
        except RecordingError as error:  # noqa: PERF203 - no bag stops the others
            # Named as the fleet does, wherever it lies.
            problems.append(': '.join(one for one in (name, error.topic, error.message) if one))
            is_final = is_final and not isinstance(error.__cause__, OSError)
        except OSError as error:
            problems.append(f'{name}: {error.strerror or error}')
            is_final = False
        except FitError as error:
            problems.append(str(error))
    infos = [bag.info for bag in bags.values()]
    serials = sorted({serial for info in infos if (serial := info.metadata.get('serial'))})
    serial = serials[0] if serials else unit.name.rpartition('/')[2]
    row = started_row(
        unit,
        serial=serial,
        lot=next((lot for info in infos if (lot := info.metadata.get('lot'))), unit.lot),
        n_left_out=len(problems),
        n_torn=sum(bool(info.truncated) for info in infos),
        left_out='; '.join(problems),
        chosen='; '.join(dict.fromkeys(info.chosen for info in infos if info.chosen)),
        prior=options.prior_sha256,
    )
    calibration = page = ''
    try:
        if len(serials) > 1:
            raise FitError(f'the bags are of different units: {", ".join(serials)}')
        if not bags:
            raise ThermoCompError('none of its bags can be used')
        kinds = {_UNIT_OF[bag.info.input]: name for name, bag in bags.items()}
        if len(kinds) > 1:
            said = ', '.join(f'{name} holds {kind}' for kind, name in sorted(kinds.items()))
            raise FitError(f'{said}: choose one with --input')
        how = replace(options.fit, input=next(iter(kinds)), serial=serial)
        row, calibration, page = _fitted(row, list(bags.values()), how, options.certificates)
    except FitError as refusal:
        row.update(verdict=REFUSED, problem=one_line(str(refusal)))
    except ThermoCompError as failure:
        row.update(verdict=FAILED, problem=one_line(str(failure)))
    row['cpu_s'] = time.process_time() - began
    return UnitOutcome(row, hashes, is_final, calibration, page)


def _fitted(
    row: dict[str, Cell], bags: Sequence[ReducedBag], how: FitOptions, has_page: bool
) -> tuple[dict[str, Cell], str, str]:
    """Fit bags; give the whole row, the calibration and the certificate."""
    from ..report import evidence_of_fit, render_report

    result = fit_bags(bags, how)
    calibration = dump_calibration(result.calibration)
    lost = [f'{bag.source.name}: {bag.info.truncated}' for bag in bags if bag.info.truncated]
    if row['n_left_out']:
        lost.append(f'{row["n_left_out"]} of {row["n_bags"]} bags are left out: {row["left_out"]}')
    evidence = evidence_of_fit(result, is_brief=not has_page)
    evidence = replace(evidence, findings=(*evidence.findings, *lost))
    known = {
        **fitted_cells(result, evidence.judgement),
        'reservations': '; '.join(evidence.findings),
        'calibration_sha256': _sha256(calibration),
    }
    page = render_report(evidence) if has_page else ''
    return row_of(**(row | known)), calibration, page


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
