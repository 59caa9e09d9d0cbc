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
from pathlib import Path
from typing import Any
from urllib.parse import quote

from .. import files
from ..errors import FleetError
from .table import Row, is_fitted, row_of
from .unit import FleetOptions, UnitOutcome
from .units import FoundUnit

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

    def look_up(self, unit: FoundUnit, options: FleetOptions) -> Row | None:
        """Find the row of an earlier run; None where something changed, or was never finished."""
        folder = self.folder_of(unit.name, options.fit.prior)
        try:
            said = json.loads((folder / RESULT).read_bytes())
            row = row_of(**said.pop('row'))
            if not said['is_final'] or said != said | _key(unit, options):
                return None
            if is_fitted(row):
                content = (folder / CALIBRATION).read_bytes()
                is_there = (folder / CERTIFICATE).is_file() or not options.certificates
                if not is_there or _sha256(content) != row['calibration_sha256']:
                    return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
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
            return row_of(
                **{**row, 'problem': '; '.join(filter(None, (str(row['problem']), kept)))}
            )
        if outcome.calibration:
            # Until the record is written its hash is not the file's: the unit is not done.
            content = outcome.calibration.encode()
            files.write_atomically(folder / CALIBRATION, content, files.CALIBRATION)
            if outcome.certificate:
                content = outcome.certificate.encode()
                files.write_atomically(folder / CERTIFICATE, content, files.PAGE)
            else:
                (folder / CERTIFICATE).unlink(missing_ok=True)
        said = {'is_final': outcome.is_final, 'bags': outcome.hashes, 'row': row}
        content = (json.dumps(_key(unit, options) | said, indent=1) + '\n').encode()
        files.write_atomically(folder / RESULT, content, files.RECORD)
        return row


def _key(unit: FoundUnit, options: FleetOptions) -> dict[str, Any]:
    """Give what a result depends on, as JSON has it."""
    found = [list(file) for bag in unit.bags.values() for file in bag]
    return {'format': _FORMAT, 'options': options.digest(), 'files': found}


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _safe(part: str) -> str:
    """Make a name that somebody else chose a name of one file."""
    name = quote(part, safe=" +,=@()'") or '%'
    if not name.strip('.'):
        name = name.replace('.', '%2E')
    return (
        name
        if len(name) <= _LONGEST_NAME
        else f'{name[:_LONGEST_NAME]}-{_sha256(part.encode())[:16]}'
    )
