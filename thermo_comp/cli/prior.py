# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp prior``: calibrations of siblings to what their type has in common."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from . import options
from .output import Output


def prior(
    calibrations: Annotated[
        list[Path],
        typer.Argument(help='Calibrations of different units of one type.', metavar='YAML...'),
    ],
    output: Annotated[Path, typer.Option('--output', '-o', help='Prior to write (YAML).')],
    force: options.Force = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Make the prior of a type of unit from the calibrations of some.

    Mean and scatter of what the units' calibrations say; `fit --prior` begins
    with it, so that a further unit of the type needs less time in the chamber.

    Example:
      thermo_comp prior unit01.yaml unit02.yaml unit03.yaml -o type.yaml
    """
    from ..files import CALIBRATION, check_output
    from ..fitting.priors import population
    from ..unit.calibration_file import load_calibration, save_calibration

    out = Output(as_json, quiet)
    check_output(output, CALIBRATION, overwrite=force, others=calibrations)
    units = [load_calibration(path) for path in calibrations]
    found = population(units)
    save_calibration(found, output, overwrite=force)
    out.line(f'{output}: what {len(units)} units have in common, {len(found.response)} columns')
    out.json({'output': output, 'units': [one.unit.serial for one in units]})
