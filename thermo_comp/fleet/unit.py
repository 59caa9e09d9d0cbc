# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns a unit's fit as a tree: statistics of its bags, merged in any order, then one regression.

Merging is a union sorted by name: associative, commutative, and nothing is added up in it, so
the fit sees the same numbers in the same order whoever reduced what, and when.
"""

from __future__ import annotations

import hashlib
import json
import time
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

from .. import __version__
from ..errors import FitError, ThermoCompError
from ..fitting import FitOptions, FitResult, ReducedBag, fit_bags
from ..recording import Input, Topics
from ..unit.calibration_file import dump_calibration
from .bag import BagStatistics, reduce_found
from .discovery import FoundUnit
from .row import FAILED, NOT_JUDGED, REFUSED, Cell, empty_row, fitted_cells, judged_cells

if TYPE_CHECKING:
    from ..report import Evidence

#: Statistics of some bags of one unit, sorted by name.
Statistics = tuple[BagStatistics, ...]


@dataclass(frozen=True)
class FleetOptions:
    """
    What the user says of a fleet; the same for all units.

    Parameters
    ----------
    fit : FitOptions
        Of each fit; its serial and input are the bags'.
    topics : Topics or None, optional
        Names of the inputs.
    input : {'auto', 'counts', 'imu'}, optional
        What is read.
    certificates : bool, optional
        Whether each unit gets one.

    """

    fit: FitOptions
    topics: Topics | None = None
    input: Input = 'auto'
    certificates: bool = True

    def digest(self) -> str:
        """Hash everything that a result depends on besides its bags."""
        said = {'version': __version__, **asdict(self)}
        text = json.dumps(said, sort_keys=True, default=repr)
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class BagRecord:
    """
    What became of one bag.

    Parameters
    ----------
    name, sha256, problem : str
        As in `BagStatistics`.

    """

    name: str
    sha256: str
    problem: str


@dataclass(frozen=True)
class UnitOutcome:
    """
    What came out of one unit; small enough to travel.

    Parameters
    ----------
    row : dict of str to str, int, float or None
        Its row of the fleet table.
    bags : tuple of BagRecord
        Its bags.
    is_final : bool
        Whether the same bags would give the same again; a failed file system may not.
    calibration : bytes
        The calibration file; empty where there is none.
    certificate : bytes
        The page, packed by zlib; empty where there is none.

    """

    row: dict[str, Cell]
    bags: tuple[BagRecord, ...] = ()
    is_final: bool = False
    calibration: bytes = b''
    certificate: bytes = b''

    @property
    def key(self) -> str:
        """Hash of what it was made of."""
        return str(self.row['key'])


def merged(parts: Iterable[Statistics]) -> Statistics:
    """
    Merge statistics of bags of one unit.

    Parameters
    ----------
    parts : iterable of tuple of BagStatistics
        In any order, a bag as often as it was reduced.

    Returns
    -------
    tuple of BagStatistics
        Each bag once, sorted by name.

    """
    by_name = {one.name: one for part in parts for one in part}
    return tuple(by_name[name] for name in sorted(by_name))


def reduce_unit(url: str, unit: FoundUnit, options: FleetOptions) -> Statistics:
    """Reduce all bags of a unit here, one after the other."""
    return merged(
        (reduce_found(url, bag, options.fit, options.topics, options.input),) for bag in unit.bags
    )


def unit_key(bags: Iterable[tuple[str, str]], options: FleetOptions) -> str:
    """
    Hash what a unit's result is made of.

    Parameters
    ----------
    bags : iterable of (str, str)
        Name and SHA-256 of each.
    options : FleetOptions
        The options.

    Returns
    -------
    str
        Hexadecimal.

    """
    text = json.dumps([options.digest(), sorted(bags)])
    return hashlib.sha256(text.encode()).hexdigest()


def process_unit(
    url: str, unit: FoundUnit, options: FleetOptions, known: str = ''
) -> UnitOutcome | None:
    """
    Reduce and fit a unit: the work of one worker.

    Parameters
    ----------
    url : str
        The fleet's folder.
    unit : FoundUnit
        The unit.
    options : FleetOptions
        The options.
    known : str, optional
        Key of a result that is there already.

    Returns
    -------
    UnitOutcome or None
        None where the result that is there holds.

    """
    return conclude(unit, options, [reduce_unit(url, unit, options)], known)


def conclude(
    unit: FoundUnit, options: FleetOptions, parts: Sequence[Statistics], known: str = ''
) -> UnitOutcome | None:
    """
    Merge a unit's statistics and fit it.

    Parameters
    ----------
    unit : FoundUnit
        The unit.
    options : FleetOptions
        The options.
    parts : sequence of tuple of BagStatistics
        Statistics of its bags, from wherever they were reduced.
    known : str, optional
        Key of a result that is there already.

    Returns
    -------
    UnitOutcome or None
        Calibrated, refused or failed; None where the result that is there holds.

    """
    began = time.process_time()
    statistics = merged(parts)
    key = unit_key(((one.name, one.sha256) for one in statistics), options)
    if key == known:
        return None
    good = [one for one in statistics if one.reduced is not None]
    bad = [one for one in statistics if one.reduced is None]
    row = empty_row(
        name=unit.name,
        serial=_serial(good, unit),
        lot=next((one.lot for one in good if one.lot), unit.lot),
        n_bags=len(statistics),
        n_left_out=len(bad),
        n_torn=sum(bool(one.note) for one in good),
        left_out='; '.join(one.problem for one in bad),
        n_bytes=sum(one.n_bytes for one in statistics),
        tool_version=__version__,
        key=key,
    )
    outcome = UnitOutcome(
        row=row,
        bags=tuple(BagRecord(one.name, one.sha256, one.problem) for one in statistics),
        is_final=not any(one.is_passing for one in statistics),
    )
    try:
        outcome = _fitted(outcome, unit, good, options)
    except FitError as refusal:
        outcome.row.update(verdict=REFUSED, problem=str(refusal))
    except ThermoCompError as failure:
        outcome.row.update(verdict=FAILED, problem=str(failure))
    spent = time.process_time() - began + sum(one.cpu_s for one in statistics)
    outcome.row['cpu_s'] = spent
    return outcome


def _fitted(
    outcome: UnitOutcome, unit: FoundUnit, good: Sequence[BagStatistics], options: FleetOptions
) -> UnitOutcome:
    if not good:
        outcome.row.update(verdict=FAILED, problem='none of its bags can be used')
        return outcome
    kinds = {one.input: one.name for one in good}
    if len(kinds) > 1:
        said = ', '.join(f'{name} holds {kind}' for kind, name in sorted(kinds.items()))
        raise FitError(f'{said}: choose one with --input')
    settings = _settings(good, unit, options.fit)
    result = fit_bags(numbered([one.reduced for one in good if one.reduced]), settings)
    calibration = dump_calibration(result.calibration).encode()
    certificate, evidence = _certified(result, _losses(outcome, good), options.certificates)
    judgement = evidence.judgement
    outcome.row.update(
        fitted_cells(result),
        reservations='; '.join(evidence.findings),
        calibration_sha256=hashlib.sha256(calibration).hexdigest(),
    )
    if judgement is None:
        outcome.row.update(verdict=NOT_JUDGED)
    else:
        outcome.row.update(judged_cells(judgement))
    return replace(outcome, calibration=calibration, certificate=certificate)


def numbered(bags: Iterable[ReducedBag]) -> list[ReducedBag]:
    """Give each bag's intervals the number of its place."""
    return [
        replace(bag, intervals=tuple(replace(one, bag=number) for one in bag.intervals))
        for number, bag in enumerate(bags)
    ]


def _serial(good: Sequence[BagStatistics], unit: FoundUnit) -> str:
    serials = [one.reduced.source.serial for one in good if one.reduced]
    return next((one for one in serials if one), None) or unit.name.rpartition('/')[2]


def _settings(good: Sequence[BagStatistics], unit: FoundUnit, options: FitOptions) -> FitOptions:
    """
    Complete the fit's options from the bags.

    Raises
    ------
    FitError
        If the bags are of different units.

    """
    serials = sorted({one.reduced.source.serial or '' for one in good if one.reduced} - {''})
    if len(serials) > 1:
        raise FitError(f'the bags are of different units: {", ".join(serials)}')
    return replace(options, input=good[0].input, serial=_serial(good, unit))


def _losses(outcome: UnitOutcome, good: Sequence[BagStatistics]) -> list[str]:
    """Say what of the unit's bags the fit did not see."""
    lost = [one.note for one in good if one.note]
    n_left_out = len(outcome.bags) - len(good)
    if n_left_out:
        lost.append(
            f'{n_left_out} of {len(outcome.bags)} bags are left out: {outcome.row["left_out"]}'
        )
    return lost


def _certified(
    result: FitResult, losses: Sequence[str], with_page: bool
) -> tuple[bytes, Evidence]:
    """Judge a fit, and make the page if it is wanted."""
    from ..report import evidence_of_fit, render_report

    evidence = evidence_of_fit(result, is_brief=not with_page)
    evidence = replace(evidence, findings=(*evidence.findings, *losses))
    return zlib.compress(render_report(evidence).encode()) if with_page else b'', evidence
