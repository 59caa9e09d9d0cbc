# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the folder of results: what is there already, and how a unit's files get there whole.

``OUT/units/NAME/`` holds calibration.yaml, certificate.html and, written last, result.json: a
unit without it has not been done, whatever else lies there.
"""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ..errors import FleetError
from ..files import CALIBRATION as CALIBRATION_FILE
from ..files import PAGE, RECORD, write_atomically
from .discovery import FoundUnit
from .row import Cell, empty_row, is_fitted
from .unit import FleetOptions, UnitOutcome

_FORMAT = 1
_LONGEST_NAME = 100
CALIBRATION, CERTIFICATE, RESULT = 'calibration.yaml', 'certificate.html', 'result.json'


@dataclass(frozen=True)
class Known:
    """
    What an earlier run left of a unit.

    Parameters
    ----------
    row : dict of str to str, int, float or None
        Its row.
    is_current : bool
        Whether bags, options and version are those of now, as far as a listing tells.

    """

    row: dict[str, Cell]
    is_current: bool

    @property
    def key(self) -> str:
        """Hash of what it was made of."""
        return str(self.row['key'])


class Ledger:
    """
    The folder of a fleet's results.

    Parameters
    ----------
    folder : Path
        Made if it is not there.

    Raises
    ------
    FleetError
        If it cannot be made.

    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            (folder / 'units').mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FleetError(f'{folder}: cannot be made: {error.strerror}') from error

    def folder_of(self, name: str) -> Path:
        """Return the folder of a unit's files; no name leads out of the fleet's."""
        return self.folder.joinpath('units', *map(_safe, name.split('/')))

    def certificate_of(self, name: str) -> str:
        """Return where a unit's certificate lies in the folder; empty where it has none."""
        path = self.folder_of(name) / CERTIFICATE
        return path.relative_to(self.folder).as_posix() if path.is_file() else ''

    def look_up(self, unit: FoundUnit, options: FleetOptions) -> Known | None:
        """
        Find what is there of a unit.

        Parameters
        ----------
        unit : FoundUnit
            The unit, as it is listed now.
        options : FleetOptions
            The options of now.

        Returns
        -------
        Known or None
            None where it must be done anew whatever its bags hold: never finished, other
            options, another version, a file of the result that is missing or was changed.

        """
        folder = self.folder_of(unit.name)
        try:
            said = json.loads((folder / RESULT).read_bytes())
            if said['format'] != _FORMAT or said['options'] != options.digest():
                return None
            row = empty_row(**said['row'])
            is_current = bool(said['files'] == _files(unit))
        except (OSError, ValueError, KeyError, TypeError):
            return None
        if not said['is_final'] or not _is_whole(folder, row, options):
            return None
        return Known(row, is_current)

    def store(
        self, unit: FoundUnit, options: FleetOptions, outcome: UnitOutcome | None
    ) -> dict[str, Cell]:
        """
        Write what came out of a unit.

        Parameters
        ----------
        unit : FoundUnit
            The unit.
        options : FleetOptions
            The options.
        outcome : UnitOutcome or None
            None keeps what is there, for bags that were only touched. One without a calibration,
            or from a file system that failed, takes no earlier calibration away.

        Returns
        -------
        dict of str to str, int, float or None
            Its row.

        Raises
        ------
        OutputError
            If it cannot be written.

        """
        folder = self.folder_of(unit.name)
        if outcome is None:
            said = json.loads((folder / RESULT).read_bytes())
            said['files'] = _files(unit)
        else:
            said = _record(unit, options, outcome)
            if (folder / CALIBRATION).is_file() and not (outcome.calibration and outcome.is_final):
                return _kept(said['row'], folder)
            if outcome.calibration:
                # Until the record is written its hash is not the file's: the unit is not done.
                write_atomically(folder / CALIBRATION, outcome.calibration, CALIBRATION_FILE)
                if outcome.certificate:
                    page = zlib.decompress(outcome.certificate)
                    write_atomically(folder / CERTIFICATE, page, PAGE)
                else:
                    (folder / CERTIFICATE).unlink(missing_ok=True)
        content = (json.dumps(said, indent=1) + '\n').encode()
        write_atomically(folder / RESULT, content, RECORD)
        return empty_row(**said['row'])


def _kept(row: dict[str, Cell], folder: Path) -> dict[str, Cell]:
    """Return the row of a run that leaves an earlier calibration, and its record, as they are."""
    kept = f'{folder / CALIBRATION} of an earlier run stays'
    said = '; '.join(str(part) for part in (row['problem'], kept) if part)
    return empty_row(**{**row, 'problem': said})


def _record(unit: FoundUnit, options: FleetOptions, outcome: UnitOutcome) -> dict[str, Any]:
    return {
        'format': _FORMAT,
        'options': options.digest(),
        'is_final': outcome.is_final,
        'files': _files(unit),
        'bags': [[bag.name, bag.sha256, bag.problem] for bag in outcome.bags],
        'row': {
            name: None if isinstance(cell, float) and not math.isfinite(cell) else cell
            for name, cell in outcome.row.items()
        },
    }


def _files(unit: FoundUnit) -> list[list[str | int]]:
    return [[file.name, file.size, file.stamp] for bag in unit.bags for file in bag.files]


def _is_whole(folder: Path, row: dict[str, Cell], options: FleetOptions) -> bool:
    """Whether the files that belong to a result are there as they were written."""
    if not is_fitted(row):
        return True
    if options.certificates and not (folder / CERTIFICATE).is_file():
        return False
    try:
        content = (folder / CALIBRATION).read_bytes()
    except OSError:
        return False
    return hashlib.sha256(content).hexdigest() == row['calibration_sha256']


def _safe(part: str) -> str:
    """Make a name that somebody else chose a name of one file."""
    name = quote(part, safe=" +,=@()'") or '%'
    if not name.strip('.'):
        name = name.replace('.', '%2E')
    if len(name) > _LONGEST_NAME:
        name = f'{name[:_LONGEST_NAME]}-{hashlib.sha256(part.encode()).hexdigest()[:16]}'
    return name
