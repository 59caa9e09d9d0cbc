# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the report as files: one HTML page and, if wanted, its figures as PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..files import PAGE, PICTURE, write_atomically
from ..fitting import FitResult
from .evidence import Evidence
from .fitted import evidence_of_fit
from .page import render_page
from .plates import drawn_plates, png_files


def render_report(evidence: Evidence) -> str:
    """Make a certificate for whoever writes it: the HTML document."""
    return render_page(evidence, drawn_plates(evidence))


def write_report(
    subject: FitResult | Evidence,
    path: str | Path,
    *,
    figures: str | Path | None = None,
    paths: Sequence[str | Path] = (),
    program: str | None = None,
    overwrite: bool = True,
) -> Evidence:
    """
    Write a certificate as one self-contained HTML page.

    Parameters
    ----------
    subject : FitResult or Evidence
        A fit, or what `evidence_of_bags` gathered.
    path : str or Path
        The page.
    figures : str or Path or None, optional
        Folder that gets the figures as PNG files, made if it is not there.
    paths : sequence of str or Path, optional
        The bags of a fit, in its order, to look up what simulated ones say of their chamber.
    program : str or None, optional
        The chamber's program of a fit, as `simulation.parse_cyclogram` reads it.
    overwrite : bool, optional
        Replace a page and pictures that are there.

    Returns
    -------
    Evidence
        What the page is made of.

    Raises
    ------
    OutputError
        If a file may not or cannot be written.
    RecordingError
        If one of `paths` cannot be opened.
    ValueError
        If `program` cannot be read.

    """
    evidence = subject
    if isinstance(evidence, FitResult):
        evidence = evidence_of_fit(evidence, paths=paths, program=program)
    page = render_report(evidence)
    if figures is not None:
        for name, content in png_files(evidence).items():
            write_atomically(Path(figures) / name, content, PICTURE, overwrite=overwrite)
    write_atomically(path, page.encode(), PAGE, overwrite=overwrite)
    return evidence
