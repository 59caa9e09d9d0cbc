# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the way from a fit's result to a report's evidence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..fitting import FitResult
from ..fitting.verdict import Finding
from ..judging import judge_bags
from ..judging.windows import usual_window
from ..recording import inspect_recording
from .evidence import Evidence
from .gather import bag_facts, of_calibration, shown_of


def evidence_of_fit(
    result: FitResult,
    *,
    paths: Sequence[str | Path] = (),
    program: str | None = None,
    is_brief: bool = False,
) -> Evidence:
    """
    Gather what a fit has to show, on the bags that it was made of.

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
        Leave out what only figures show.

    Returns
    -------
    Evidence
        For `write_report`.

    Raises
    ------
    RecordingError
        If one of `paths` cannot be opened.
    ValueError
        If `program` cannot be read.

    """
    calibration = result.calibration
    judgement = judge_bags(result.bags, calibration, window_s=usual_window(result.bags))
    shown = None
    if not is_brief:
        metadata = [dict(inspect_recording(path).metadata) for path in paths]
        shown = shown_of(result.bags, calibration, program, metadata)
    against = [one.message for one in result.findings if _is_reservation(one)]
    return Evidence(
        serial=calibration.unit.serial,
        unit=calibration.unit.input,
        gravity=calibration.gravity_m_s2,
        calibration=calibration,
        bags=tuple(bag_facts(one) for one in result.bags),
        shown=shown,
        windows=None if judgement is None else judgement.windows,
        judgement=judgement,
        steps=result.residuals,
        left_out=_left_out(result),
        findings=tuple(dict.fromkeys((*of_calibration(calibration), *against))),
        checks=tuple(one.message for one in result.findings if not _is_reservation(one)),
        is_fit=True,
    )


def _is_reservation(finding: Finding) -> bool:
    # More positions than enough would be better still: no reservation.
    return finding.level == 'advice' and finding.name != 'positions'


def _left_out(result: FitResult) -> dict[int, float]:
    """Give what is left of each position without it, by `Windows.position`."""
    rests = [(bag.source.name, one.start_ns) for bag in result.bags for one in bag.intervals]
    by_rest = {(one.source, one.start_ns): one.left_out_rms for one in result.positions}
    return {k: by_rest[rest] for k, rest in enumerate(rests) if rest in by_rest}
