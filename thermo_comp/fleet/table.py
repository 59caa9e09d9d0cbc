# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fleet table: its columns, what a fit puts into them, and its files.

Parquet is for programs, CSV for people. Texts that somebody else chose stand in a row as one line.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import FleetError
from ..files import CSV, PARQUET, write_atomically
from ..fitting import FitResult
from ..judging import Judgement, Verdict
from ..text import one_line
from ..unit.calibration import AXES, Calibration
from ..unit.gravity import MICRO_G
from ..unit.prediction import in_a_soak

Cell = str | int | float | None
Row = Mapping[str, Cell]

#: What stands in the column `verdict` where there is no verdict of the judge.
REFUSED, FAILED, NOT_JUDGED = 'refused', 'failed', 'not judged'


@dataclass(frozen=True)
class Column:
    """One column: its heading with the unit of measurement, what stands in it, and its meaning."""

    name: str
    kind: Literal['text', 'whole', 'number']
    meaning: str


def _by_axis(pattern: str, meaning: str) -> list[Column]:
    return [Column(pattern.format(axis), 'number', f'{axis}: {meaning}') for axis in AXES]


_SKEW = (('10', 1, 0), ('20', 2, 0), ('21', 2, 1))

COLUMNS: tuple[Column, ...] = (
    Column('name', 'text', 'folder of the bags, or serial; the folder of the results'),
    Column('serial', 'text', "serial in the bags' metadata, else the folder's own name"),
    Column('lot', 'text', '`lot` in the metadata, else the folder above the unit'),
    Column('verdict', 'text', 'that of evaluate on its own bags; refused by the fit; failed'),
    Column('reason', 'text', 'the numbers of the verdict'),
    Column('problem', 'text', 'why there is no calibration'),
    Column('reservations', 'text', 'what the certificate holds against the calibration'),
    Column('left_out', 'text', 'bags that were left out, each with its reason'),
    Column('n_bags', 'whole', 'bags found'),
    Column('n_left_out', 'whole', 'of them left out'),
    Column('n_torn', 'whole', 'bags that were cut off, and are read up to there'),
    Column('n_positions', 'whole', 'still positions'),
    Column('n_samples', 'whole', 'accelerometer samples'),
    Column('n_bytes', 'whole', 'size of the bags'),
    Column('model', 'text', 'the model of the fit'),
    Column('is_whole', 'whole', '1 where its own bags tell all of it: siblings can begin with it'),
    Column('prior', 'text', 'SHA-256 of the prior.yaml that its fit began with'),
    Column('start', 'text', 'UTC of the first sample'),
    Column('hours', 'number', 'length of the bags together'),
    Column('gravity_m_s2', 'number', 'local gravity used'),
    Column('reference_temperature_c', 'number', 'T_ref'),
    Column('lowest_c', 'number', 'lower end of the calibrated range'),
    Column('highest_c', 'number', 'upper end of the calibrated range'),
    Column('cooling_k_min', 'number', 'fastest fall of the board in the range'),
    Column('heating_k_min', 'number', 'fastest rise of the board in the range'),
    *_by_axis('scale_{}', 'scale factor at T_ref, input units per m/s^2'),
    *_by_axis('scale_sd_{}_ppm', 'its standard deviation'),
    *_by_axis('scale_slope_{}_ppm_k', 'slope of the static scale at T_ref'),
    *_by_axis('bias_{}_ug', 'bias at T_ref in still air'),
    *_by_axis('bias_sd_{}_ug', 'its standard deviation'),
    *_by_axis('bias_slope_{}_ug_k', 'slope of the static bias at T_ref'),
    *(Column(f'm_{name}_urad', 'number', f'`M[{i}][{j}]`') for name, i, j in _SKEW),
    *(
        Column(f'm_sd_{name}_urad', 'number', f'standard deviation of `M[{i}][{j}]`')
        for name, i, j in _SKEW
    ),
    *_by_axis('noise_{}_ug_sqrt_hz', 'white noise'),
    Column('board_lag_s', 'number', 'time constant of the board behind the case'),
    Column('window_s', 'number', 'length of the windows at rest'),
    Column('raw_ug', 'number', '|f| - g at rest, RMS, constants at T_ref only'),
    Column('static_ug', 'number', '|f| - g at rest, RMS, static regime'),
    Column('dynamic_ug', 'number', '|f| - g at rest, RMS, dynamic regime'),
    Column('all_ug', 'number', '|f| - g at rest, RMS'),
    Column('peak_ug', 'number', '|f| - g at rest, largest window'),
    Column('unseen_ug', 'number', '|f| - g of each position by what the others say, RMS'),
    Column('claimed_ug', 'number', 'RMS of what the calibration claims for these windows'),
    Column('cpu_s', 'number', 'processor time of reading and fit'),
    Column('tool_version', 'text', 'version that fitted it'),
    Column('calibration_sha256', 'text', 'of calibration.yaml'),
)


def empty_row(**known: Cell) -> dict[str, Cell]:
    """Make a row in which only so much is known; other texts are empty, other numbers None."""
    row: dict[str, Cell] = {
        column.name: '' if column.kind == 'text' else None for column in COLUMNS
    }
    strange = known.keys() - row.keys()
    if strange:
        raise ValueError(f'no column {sorted(strange)[0]!r}')
    return row | {k: one_line(v) if isinstance(v, str) else v for k, v in known.items()}


def is_fitted(row: Row) -> bool:
    """Whether a unit has a calibration."""
    return row['verdict'] not in ('', REFUSED, FAILED)


def is_valid(row: Row) -> bool:
    """Whether a unit's calibration was shown to be valid on its own bags."""
    return str(row['verdict']).startswith((Verdict.VALID.value, Verdict.WIDE.value))


def fitted_cells(result: FitResult) -> dict[str, Cell]:
    """Take the cells of a fitted unit from its fit."""
    calibration = result.calibration
    start_ns = min(bag.start_ns for bag in result.bags)
    started = datetime.fromtimestamp(start_ns // 10**9, timezone.utc)
    cells: dict[str, Cell] = {
        'n_positions': len(result.positions),
        'n_samples': sum(bag.n_samples for bag in result.bags),
        'model': calibration.provenance.model,
        'start': started.strftime('%Y-%m-%dT%H:%M:%SZ'),
        'hours': sum(bag.end_ns - bag.start_ns for bag in result.bags) * 1e-9 / 3600.0,
        'tool_version': calibration.provenance.tool_version,
    }
    unseen = next(row.left_out for row in result.residuals if row.section == 'all')
    if unseen.n:
        cells['unseen_ug'] = unseen.micro_g.rms
    return cells | calibration_cells(calibration)


def judged_cells(judgement: Judgement) -> dict[str, Cell]:
    """Take the cells of a unit's verdict on its own bags."""
    whole = judgement.sections['all']
    numbers = {
        'window_s': judgement.windows.window_s,
        'raw_ug': whole.raw_rms / MICRO_G,
        'peak_ug': whole.peak / MICRO_G,
        'claimed_ug': whole.claimed_rms / MICRO_G,
        **{
            f'{section}_ug': judgement.sections[section].rms / MICRO_G
            for section in ('static', 'dynamic', 'all')
        },
    }
    known = {name: value for name, value in numbers.items() if np.isfinite(value)}
    return {'verdict': judgement.verdict, 'reason': judgement.reason, **known}


def calibration_cells(calibration: Calibration) -> dict[str, Cell]:
    """Take the cells that a calibration alone fills."""
    sets = calibration.regime_sets()
    bias, bias_sd, scale, scale_sd = in_a_soak(calibration)
    cells: dict[str, Cell] = {
        'gravity_m_s2': calibration.gravity_m_s2,
        'reference_temperature_c': calibration.reference_temperature_c,
        'lowest_c': min(one.temperature_range_c[0] for one in sets),
        'highest_c': max(one.temperature_range_c[1] for one in sets),
        'cooling_k_min': min(one.rate_range_k_min[0] for one in sets),
        'heating_k_min': max(one.rate_range_k_min[1] for one in sets),
        'board_lag_s': calibration.board_lag_s,
    }
    for i, axis in enumerate(AXES):
        static = getattr(calibration.static, axis)
        one_ug = getattr(calibration.axes, axis).scale_factor * MICRO_G
        cells |= {
            f'scale_{axis}': float(scale[i]),
            f'scale_sd_{axis}_ppm': float(scale_sd[i]) * 1e6,
            f'scale_slope_{axis}_ppm_k': static.scale_function.slope(0.0) * 1e6,
            f'bias_{axis}_ug': float(bias[i]) / MICRO_G,
            f'bias_sd_{axis}_ug': float(bias_sd[i]) / MICRO_G,
            f'bias_slope_{axis}_ug_k': static.bias_function.slope(0.0) / one_ug,
            f'noise_{axis}_ug_sqrt_hz': calibration.noise_density_m_s2_sqrt_hz[i] / MICRO_G,
        }
    for k, (name, i, j) in enumerate(_SKEW):
        cells[f'm_{name}_urad'] = calibration.misalignment[i][j] * 1e6
        cells[f'm_sd_{name}_urad'] = calibration.misalignment_sd[k] * 1e6
    return {name: float(value) for name, value in cells.items() if value is not None}


def write_tables(rows: Sequence[Row], folder: Path) -> tuple[Path, Path]:
    """Write the table as fleet.parquet and fleet.csv; each is replaced as a whole."""
    parquet, text = folder / 'fleet.parquet', folder / 'fleet.csv'
    write_atomically(parquet, to_parquet(rows), PARQUET)
    write_atomically(text, to_csv(rows).encode(), CSV)
    return parquet, text


def to_parquet(rows: Sequence[Row]) -> bytes:
    """Return the table as Parquet; what a column means stands in its metadata."""
    import pyarrow as pa
    from pyarrow import parquet

    types = {'text': pa.string(), 'whole': pa.int64(), 'number': pa.float64()}
    schema = pa.schema(
        [
            pa.field(column.name, types[column.kind], metadata={'meaning': column.meaning})
            for column in COLUMNS
        ]
    )
    columns = {column.name: [row[column.name] for row in rows] for column in COLUMNS}
    buffer = pa.BufferOutputStream()
    parquet.write_table(pa.table(columns, schema=schema), buffer)
    return bytes(buffer.getvalue())


def to_csv(rows: Sequence[Row]) -> str:
    """Return the table as CSV with a heading; numbers have all their digits."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator='\n')
    writer.writerow([column.name for column in COLUMNS])
    for row in rows:
        writer.writerow([_text(row[column.name]) for column in COLUMNS])
    return out.getvalue()


def _text(cell: Cell) -> str:
    if cell is None:
        return ''
    if isinstance(cell, float):
        return repr(cell)
    text = str(cell)
    # A spreadsheet would run a cell that begins like a formula.
    return f"'{text}" if text[:1] in ('=', '+', '-', '@', '\t', '\r') else text


def read_parquet(path: Path) -> list[Row]:
    """Read a table of an earlier run; what it lacks is empty. Raises FleetError if it is none."""
    from pyarrow import ArrowException, parquet

    try:
        found = parquet.read_table(path).to_pylist()
    except (ArrowException, OSError) as error:
        raise FleetError(f'{path}: no fleet table: {" ".join(str(error).split())}') from error
    names = {column.name for column in COLUMNS}
    if not all('serial' in row and 'verdict' in row for row in found):
        raise FleetError(f'{path}: no fleet table: it lacks the columns serial and verdict')
    return [empty_row(**{k: v for k, v in row.items() if k in names}) for row in found]
