# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from a fit's result to a report's evidence.

"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..fitting import FitResult
from ..fitting.ladder import golovach_spec
from ..fitting.model import ModelSpec, polynomial
from ..fitting.regression import Freedom, regress
from ..fitting.solution import Solution, correct, regressors
from ..fitting.start import constant_calibration, position_means, starting_solution
from ..fitting.table import WindowTable
from ..fitting.verdict import Finding
from ..recording import inspect_recording
from ..simulation import Cyclogram, parse_cyclogram
from ..typing import Floats
from .evidence import (
    CHOSEN,
    ONE_SET,
    RAW,
    TWO_REGIMES,
    CandidateRow,
    Evidence,
    ShownBag,
    Windows,
)
from .gather import bag_facts, best_bag, recorded_program, span_of
from .trace import thermal_trace

# The rungs below the chosen model are fitted on windows of this length first, as the fit's own
# candidates are.
_COMPARISON_WINDOW_S = 60.0


def evidence_of_fit(
    result: FitResult,
    *,
    paths: Sequence[str | Path] = (),
    program: str | None = None,
    is_brief: bool = False,
) -> Evidence:
    """
    Gather what a fit has to show.

    Parameters
    ----------
    result : FitResult
        The fit.
    paths : sequence of str or Path, optional
        The bags it was made of, in its order, to look up what simulated ones say of their
        chamber's program.
    program : str or None, optional
        The chamber's program, as `simulation.parse_cyclogram` reads it.
    is_brief : bool, optional
        Leave out what only figures show: the verdict stays the same, at a fraction of the work.

    Returns
    -------
    Evidence
        For `write_report`, or, if brief, for `judge`.

    Raises
    ------
    RecordingError
        If one of `paths` cannot be opened.
    ValueError
        If `program` cannot be read.

    """
    calibration = result.calibration
    table = result.table
    return Evidence(
        serial=calibration.unit.serial,
        unit=calibration.unit.input,
        gravity=calibration.gravity_m_s2,
        calibration=calibration,
        bags=tuple(bag_facts(one) for one in result.bags),
        shown=None if is_brief else _shown(result, paths, program),
        windows=Windows(
            bag=table.bag,
            position=table.position,
            time=table.time,
            mean=table.mean,
            board=table.t + calibration.reference_temperature_c,
            is_dynamic=table.is_dynamic,
            forces=_ends(result) if is_brief else _ladder(result),
        ),
        candidates=_candidates(result),
        findings=tuple(one.message for one in result.findings if _is_reservation(one)),
        checks=tuple(one.message for one in result.findings if not _is_reservation(one)),
        is_fit=True,
    )


def _is_reservation(finding: Finding) -> bool:
    # More positions than enough would be better still: no reservation.
    return finding.level == 'advice' and finding.name != 'positions'


def _shown(result: FitResult, paths: Sequence[str | Path], program: str | None) -> ShownBag:
    index = best_bag(result.bags)
    bag = result.bags[index]
    span_ns = span_of(bag)
    trace, _ = thermal_trace(bag.board, bag.case, span_ns, result.calibration.detector)
    return ShownBag(
        index=index,
        start_ns=span_ns[0],
        board=bag.board,
        case=bag.case,
        trace=trace,
        cyclogram=_program(paths, index, program),
    )


def _program(paths: Sequence[str | Path], index: int, program: str | None) -> Cyclogram | None:
    if program is not None:
        return parse_cyclogram(program)
    if index < len(paths):
        return recorded_program(dict(inspect_recording(paths[index]).metadata))
    return None


def _ends(result: FitResult) -> dict[str, Floats]:
    """
    Correct with the constants alone, and with the calibration.

    """
    solution, table = result.solution, result.table
    raw = (table.mean - solution.bias[:, 0]) / solution.scale[:, 0] @ solution.misalignment.T
    return {RAW: np.asarray(raw), CHOSEN: _corrected(table, solution)}


def _ladder(result: FitResult) -> dict[str, Floats]:
    solution, table = result.solution, result.table
    ends = _ends(result)
    forces = {RAW: ends[RAW]}
    coarse = table.coarsened(_COMPARISON_WINDOW_S)
    with_misalignment = bool(np.any(solution.skew))
    constant = constant_calibration(position_means(coarse), solution.gravity, with_misalignment)
    for name, spec in (
        (ONE_SET, ModelSpec('quadratic', polynomial(2))),
        (TWO_REGIMES, golovach_spec()),
    ):
        if spec.name != solution.spec.name:
            start = starting_solution(coarse, spec, solution.gravity, constant, np.zeros(0))
            freedom = Freedom(misalignment=with_misalignment)
            first = regress(coarse, start, freedom).solution
            forces[name] = _corrected(table, regress(table, first, freedom).solution)
    forces[CHOSEN] = ends[CHOSEN]
    return forces


def _corrected(table: WindowTable, solution: Solution) -> Floats:
    columns = regressors(table, solution.spec, solution.time_constants_s, solution.start_memory)
    return correct(table, solution, columns)


def _candidates(result: FitResult) -> tuple[CandidateRow, ...]:
    return tuple(
        CandidateRow(
            name=one.name,
            n_parameters=one.n_parameters,
            fitted_rms=one.fitted_rms,
            held_out_rms=one.held_out_rms,
            is_chosen=one.is_chosen,
        )
        for one in result.candidates
    )
