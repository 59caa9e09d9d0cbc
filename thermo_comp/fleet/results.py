# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the folder of results: what is there already, and how a unit's files get there whole.

``OUT/units/NAME/`` holds calibration.yaml, certificate.html and, written last, result.json: a
unit without it has not been done, whatever else lies there. What was fitted with a prior lies in
``OUT/with_prior/NAME/``.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from urllib.parse import quote

from ..errors import FleetError
from ..files import CALIBRATION as CALIBRATION_FILE
from ..files import PAGE, RECORD, write_atomically
from .discovery import FoundUnit
from .table import Row, empty_row, is_fitted
from .unit import FleetOptions, UnitOutcome

_FORMAT = 2
_LONGEST_NAME = 100
CALIBRATION, CERTIFICATE, RESULT = 'calibration.yaml', 'certificate.html', 'result.json'


class Results:
    """The folder of results, made if it is not there; raises FleetError if it cannot be."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            (folder / 'units').mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FleetError(f'{folder}: cannot be made: {error.strerror}') from error

    def folder_of(self, name: str, with_prior: object = False) -> Path:
        """Return the folder of a unit's files; no name leads out of the fleet's."""
        kind = 'with_prior' if with_prior else 'units'
        return self.folder.joinpath(kind, *map(_safe, name.split('/')))

    def files_of(self, row: Row) -> tuple[Path, Path]:
        """Return where calibration and certificate of a row lie, or would lie."""
        folder = self.folder_of(str(row['name']), row['prior'])
        return folder / CALIBRATION, folder / CERTIFICATE

    def look_up(self, unit: FoundUnit, options: FleetOptions) -> Row | None:
        """Find the row of an earlier run; None where something changed, or was never finished."""
        folder = self.folder_of(unit.name, options.fit.prior)
        try:
            said = json.loads((folder / RESULT).read_bytes())
            row = empty_row(**said['row'])
            if (said['format'], said['options']) != (_FORMAT, options.digest()):
                return None
            if not said['is_final'] or said['files'] != _files(unit):
                return None
            if is_fitted(row):
                content = (folder / CALIBRATION).read_bytes()
                if hashlib.sha256(content).hexdigest() != row['calibration_sha256']:
                    return None
                if options.certificates and not (folder / CERTIFICATE).is_file():
                    return None
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return row

    def store(self, unit: FoundUnit, options: FleetOptions, outcome: UnitOutcome) -> Row:
        """
        Write what came out of a unit, and return its row.

        A failure takes no earlier calibration away. Raises OutputError if it cannot be written.
        """
        folder = self.folder_of(unit.name, options.fit.prior)
        row = outcome.row
        if (folder / CALIBRATION).is_file() and not (outcome.calibration and outcome.is_final):
            kept = f'{folder / CALIBRATION} of an earlier run stays'
            problem = '; '.join(str(part) for part in (row['problem'], kept) if part)
            return empty_row(**{**row, 'problem': problem})
        if outcome.calibration:
            # Until the record is written its hash is not the file's: the unit is not done.
            content = outcome.calibration.encode()
            write_atomically(folder / CALIBRATION, content, CALIBRATION_FILE)
            if outcome.certificate:
                write_atomically(folder / CERTIFICATE, outcome.certificate.encode(), PAGE)
            else:
                (folder / CERTIFICATE).unlink(missing_ok=True)
        said = {
            name: None if isinstance(cell, float) and not math.isfinite(cell) else cell
            for name, cell in row.items()
        }
        record = {
            'format': _FORMAT,
            'options': options.digest(),
            'is_final': outcome.is_final,
            'files': _files(unit),
            'bags': outcome.hashes,
            'row': said,
        }
        content = (json.dumps(record, indent=1) + '\n').encode()
        write_atomically(folder / RESULT, content, RECORD)
        return said


def _files(unit: FoundUnit) -> list[list[str | int]]:
    return [[file.name, file.size, file.stamp] for bag in unit.bags for file in bag.files]


def _safe(part: str) -> str:
    """Make a name that somebody else chose a name of one file."""
    name = quote(part, safe=" +,=@()'") or '%'
    if not name.strip('.'):
        name = name.replace('.', '%2E')
    if len(name) > _LONGEST_NAME:
        name = f'{name[:_LONGEST_NAME]}-{hashlib.sha256(part.encode()).hexdigest()[:16]}'
    return name
