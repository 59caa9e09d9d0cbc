# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the table of a fleet, with a row per unit: the columns, the cells of a fit, the files."""

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import ThermoCompError
from ..files import CSV, PARQUET, write_atomically
from ..fitting import FitResult
from ..fitting.coverage import distinct_directions
from ..fitting.data_checks import POSITIONS_NEEDED, determines_misalignment
from ..fitting.thermal_ranges import measured_board_lag
from ..judging.judgement import Judgement
from ..judging.verdicts import Verdict
from ..text import one_line
from ..typing import Floats
from ..unit.calibration import AXES, Calibration, parameter_layout
from ..unit.functions import basis_slopes
from ..unit.gravity import MICRO_G
from ..unit.prediction import in_a_soak

Cell = str | int | float | None
Row = Mapping[str, Cell]

#: Values of the column `verdict` for tests that `evaluate` has not judged.
REFUSED, FAILED, NOT_JUDGED = 'refused', 'failed', 'not judged'
_FORMULA = ('=', '+', '-', '@')  # characters with which a formula in a spreadsheet begins
# Findings of a fit that show incomplete data, so that the prior determines some parameters.
_LACKS = {'temperature', 'ramps', 'directions', 'misfit'}


class TableColumn(NamedTuple):
    """A column of the table: name with the unit of measurement, kind and meaning."""

    name: str
    kind: str  # 'text', 'whole' (integer) or 'number'
    meaning: str
    # The next fields describe a quantity that is compared between units; see `_COMPARED`.
    label: str = ''
    unit: str = ''
    by: str = 'value'  # comparison by values, by deviations in ppm, or by logarithms
    sd: str = ''  # name of the column with the standard deviation


_BELOW = ((1, 0), (2, 0), (2, 1))  # elements of the misalignment matrix below the diagonal
_TABLE = (
    ('name', 'text', 'folder of the bags, or serial; also the name of the folder of results'),
    ('serial', 'text', "serial in the bags' metadata, else the name of the folder"),
    ('lot', 'text', '`lot` in the metadata, else the folder above the unit'),
    ('verdict', 'text', 'verdict of evaluate on the bags of the fit; or refused, failed'),
    ('reason', 'text', 'numbers that decided the verdict'),
    ('problem', 'text', 'reason why there is no calibration'),
    ('reservations', 'text', 'reservations on the certificate'),
    ('left_out', 'text', 'bags that the fit did not use, each with its reason'),
    ('chosen', 'text', 'topics chosen by their type, because the usual name is missing'),
    ('n_bags', 'whole', 'number of bags of the unit'),
    ('n_left_out', 'whole', 'number of bags that the fit did not use'),
    ('n_torn', 'whole', 'number of incomplete bags; their readable part was used'),
    ('n_positions', 'whole', 'number of positions at rest'),
    ('n_samples', 'whole', 'number of accelerometer samples'),
    ('n_bytes', 'whole', 'size of the bags in bytes'),
    ('model', 'text', 'model of the fit'),
    ('is_whole', 'whole', '1 if the bags determine all parameters; prior.yaml needs such units'),
    ('prior', 'text', 'SHA-256 of the prior.yaml used in the fit'),
    ('start', 'text', 'time of the first sample, UTC'),
    ('hours', 'number', 'total duration of the bags'),
    ('gravity_m_s2', 'number', 'local gravity assumed in the fit'),
    ('reference_temperature_c', 'number', 'T_ref, the temperature at which constants are stated'),
    ('lowest_c', 'number', 'lower end of the calibrated range of the board temperature'),
    ('highest_c', 'number', 'upper end of the calibrated range of the board temperature'),
    ('cooling_k_min', 'number', 'fastest calibrated fall of the board temperature, negative'),
    ('heating_k_min', 'number', 'fastest calibrated rise of the board temperature'),
    ('scale_{0}', 'number', '{1}: scale factor at T_ref, input units per m/s^2'),
    ('scale_sd_{0}_ppm', 'number', '{1}: standard deviation of the scale factor'),
    ('scale_slope_{0}_ppm_k', 'number', '{1}: slope of the static scale curve at T_ref'),
    ('scale_slope_sd_{0}_ppm_k', 'number', '{1}: sd of the scale slope; empty if undetermined'),
    ('bias_{0}_ug', 'number', '{1}: bias in a soak at T_ref'),
    ('bias_sd_{0}_ug', 'number', '{1}: standard deviation of the bias'),
    ('bias_slope_{0}_ug_k', 'number', '{1}: slope of the static bias curve at T_ref'),
    ('bias_slope_sd_{0}_ug_k', 'number', '{1}: sd of the bias slope; empty if undetermined'),
    ('m_{0}_urad', 'number', 'element `{1}` of the misalignment matrix'),
    ('m_sd_{0}_urad', 'number', 'standard deviation of `{1}`'),
    ('noise_{0}_ug_sqrt_hz', 'number', '{1}: white noise'),
    (
        'board_lag_s',
        'number',
        'lag of the board temperature behind the case in ramps; negative if the board leads',
    ),
    ('window_s', 'number', 'length of the windows at rest'),
    ('raw_ug', 'number', 'RMS of |f| - g at rest, corrected with the constants at T_ref alone'),
    ('static_ug', 'number', 'RMS of |f| - g at rest in the static regime, corrected'),
    ('dynamic_ug', 'number', 'RMS of |f| - g at rest in the dynamic regime, corrected'),
    ('all_ug', 'number', 'RMS of |f| - g at rest in both regimes together, corrected'),
    ('peak_ug', 'number', 'largest magnitude of |f| - g of a window at rest, corrected'),
    ('unseen_ug', 'number', 'RMS of |f| - g, or of the drift, in positions left out of the fit'),
    ('claimed_ug', 'number', 'RMS over the windows of the claimed standard deviation of |f|'),
    ('cpu_s', 'number', 'processor time of reading and fit'),
    ('tool_version', 'text', 'version of thermo_comp that fitted the unit'),
    ('calibration_sha256', 'text', 'SHA-256 of calibration.yaml'),
)
# Quantities compared between units: fields `label`, `unit`, `by`, `sd` of `TableColumn`.
_COMPARED = {
    'scale_{0}': ('scale factor {1}', 'ppm', 'ppm', 'scale_sd_{0}_ppm'),
    'scale_slope_{0}_ppm_k': ('slope of scale {1}', 'ppm/K', 'value', 'scale_slope_sd_{0}_ppm_k'),
    'bias_{0}_ug': ('bias {1}', 'µg', 'value', 'bias_sd_{0}_ug'),
    'bias_slope_{0}_ug_k': ('slope of bias {1}', 'µg/K', 'value', 'bias_slope_sd_{0}_ug_k'),
    'm_{0}_urad': ('{1}', 'µrad', 'value', 'm_sd_{0}_urad'),
    'noise_{0}_ug_sqrt_hz': ('noise {1}', 'µg/√Hz', 'logarithm'),
    'board_lag_s': ('lag of the board', 's'),
    'static_ug': ('residual, static', 'µg', 'logarithm'),
    'dynamic_ug': ('residual, dynamic', 'µg', 'logarithm'),
}


def _places(name: str) -> dict[str, str]:
    """Return the texts that replace {0} and {1} in a line of `_TABLE`: axes or elements of M."""
    if '{0}' not in name:
        return {'': ''}
    if name.startswith('m_'):
        return {f'{i}{j}': f'M[{i}][{j}]' for i, j in _BELOW}
    return dict(zip(AXES, AXES, strict=True))


COLUMNS = tuple(
    TableColumn(*(text.format(*place) for text in (*line, *_COMPARED.get(line[0], ()))))
    for line in _TABLE
    for place in _places(line[0]).items()
)


def row_of(**known: Any) -> dict[str, Cell]:
    """Build a row from the given cells; missing texts are empty, missing numbers None."""
    row: dict[str, Cell] = {col.name: '' if col.kind == 'text' else None for col in COLUMNS}
    strange = known.keys() - row.keys()
    if strange:
        raise ValueError(f'no column {sorted(strange)[0]!r}')
    for name, cell in known.items():
        if isinstance(cell, str):
            row[name] = one_line(cell)
        elif isinstance(cell, int) or (cell is not None and math.isfinite(cell)):
            row[name] = cell
    return row


def is_fitted(row: Row) -> bool:
    """Whether a unit has a calibration."""
    return row['verdict'] not in ('', REFUSED, FAILED)


def is_valid(row: Row) -> bool:
    """Whether `evaluate` judges a unit's calibration as valid on the bags of its fit."""
    return str(row['verdict']).startswith((Verdict.VALID.value, Verdict.WIDE.value))


def fitted_cells(
    result: FitResult, judgement: Judgement | None, *, has_prior: bool = False
) -> dict[str, Any]:
    """Return the cells of the table that a unit's fit, and the verdict on its bags, determine."""
    calibration, bags = result.calibration, result.bags
    start = datetime.fromtimestamp(min(bag.start_ns for bag in bags) // 10**9, timezone.utc)
    sets = calibration.regime_sets()
    bias, bias_sd, scale, scale_sd = in_a_soak(calibration)
    up = np.array([position.up for position in result.positions])
    lacking = {finding.name for finding in result.findings if finding.level != 'good'}
    unseen = next(row.left_out for row in result.residuals if row.section == 'all')
    parts: dict[str, Sequence[float] | Floats] = {
        'scale_{0}': scale,
        'scale_sd_{0}_ppm': scale_sd * 1e6,
        'bias_{0}_ug': bias / MICRO_G,
        'bias_sd_{0}_ug': bias_sd / MICRO_G,
        'm_{0}_urad': [calibration.misalignment[i][j] * 1e6 for i, j in _BELOW],
        'm_sd_{0}_urad': np.array(calibration.misalignment_sd) * 1e6,
        'noise_{0}_ug_sqrt_hz': np.array(calibration.noise_density_m_s2_sqrt_hz) / MICRO_G,
    }
    # Without a prior, few positions do not separate the slopes of bias and of scale: omit the sds.
    is_separable = has_prior or len(distinct_directions(up)) >= POSITIONS_NEEDED
    for quantity, unit, slope, sd in _slopes(calibration):
        parts[f'{quantity}_slope_{{0}}_{unit}'] = slope
        parts[f'{quantity}_slope_sd_{{0}}_{unit}'] = sd if is_separable else sd * np.nan
    cells = {
        'verdict': NOT_JUDGED,
        'n_positions': len(result.positions),
        'n_samples': sum(bag.n_samples for bag in bags),
        'model': calibration.provenance.model,
        'is_whole': int(determines_misalignment(up) and not _LACKS & lacking),
        'start': start.strftime('%Y-%m-%dT%H:%M:%SZ'),
        'hours': sum(bag.end_ns - bag.start_ns for bag in bags) * 1e-9 / 3600.0,
        'gravity_m_s2': calibration.gravity_m_s2,
        'reference_temperature_c': calibration.reference_temperature_c,
        'lowest_c': min(part.temperature_range_c[0] for part in sets),
        'highest_c': max(part.temperature_range_c[1] for part in sets),
        'cooling_k_min': min(part.rate_range_k_min[0] for part in sets),
        'heating_k_min': max(part.rate_range_k_min[1] for part in sets),
        **{
            name: float(value)
            for pattern, values in parts.items()
            for name, value in zip(map(pattern.format, _places(pattern)), values, strict=True)
        },
        'board_lag_s': measured_board_lag(result.fit.windows),
        'unseen_ug': unseen.rms / MICRO_G,
    }
    if judgement is not None:
        of = judgement.sections
        whole = of['all']
        cells |= {
            'verdict': judgement.verdict,
            'reason': judgement.reason,
            'window_s': judgement.windows.window_s,
            'raw_ug': whole.raw_rms / MICRO_G,
            **{f'{name}_ug': of[name].rms / MICRO_G for name in ('static', 'dynamic', 'all')},
            'peak_ug': whole.peak / MICRO_G,
            'claimed_ug': whole.claimed_rms / MICRO_G,
        }
    return cells


def _slopes(calibration: Calibration) -> Iterator[tuple[str, str, Floats, Floats]]:
    """
    Yield, for bias and for scale: name, unit, slopes of the static curves at T_ref and their sds,
    (3,). The sd of an axis is NaN if the calibration has no covariance or no curve of this axis.
    """
    layout, posterior = parameter_layout(calibration), calibration.posterior
    K = np.array([axis.scale_factor for axis in calibration.axes])
    biases, scales = zip(
        *((axis.bias_function, axis.scale_function) for axis in calibration.static.axes()),
        strict=True,
    )
    for quantity, unit, curves, blocks, size in (
        ('bias', 'ug_k', biases, layout.bias, K * MICRO_G),
        ('scale', 'ppm_k', scales, layout.scale, np.full(3, 1e-6)),
    ):
        variances = np.full(3, np.nan)
        for axis, (curve, block) in enumerate(zip(curves, blocks, strict=True)):
            by, first = np.array(basis_slopes(curve, 0.0)), block.static + 1
            if posterior is not None and len(by):
                rows = slice(first, first + len(by))
                common = by @ posterior.matrix[rows]
                variances[axis] = common @ common + by**2 @ posterior.variances[rows]
        slopes = np.array([float(curve.slope(0.0)) for curve in curves])
        sd = np.sqrt(np.where(variances > 0.0, variances, np.nan))
        yield quantity, unit, slopes / size, sd / np.abs(size)


def write_tables(rows: Sequence[Row], folder: Path) -> tuple[Path, Path]:
    """Write the table as Parquet, with the meanings of the columns, and as CSV."""
    import pyarrow as pa
    from pyarrow import parquet

    types = {'text': pa.string(), 'whole': pa.int64(), 'number': pa.float64()}
    schema = pa.schema(
        [pa.field(c.name, types[c.kind], metadata={'meaning': c.meaning}) for c in COLUMNS]
    )
    buffer = pa.BufferOutputStream()
    parquet.write_table(pa.Table.from_pylist(list(rows), schema=schema), buffer)
    text = io.StringIO()
    writer = csv.DictWriter(text, [column.name for column in COLUMNS], lineterminator='\n')
    writer.writeheader()
    for row in rows:
        # Put an apostrophe before texts that a spreadsheet would evaluate as a formula.
        armed = [k for k, v in row.items() if isinstance(v, str) and v.startswith(_FORMULA)]
        writer.writerow({**row, **{name: f"'{row[name]}" for name in armed}})
    paths = folder / 'fleet.parquet', folder / 'fleet.csv'
    write_atomically(paths[0], bytes(buffer.getvalue()), PARQUET)
    write_atomically(paths[1], text.getvalue().encode(), CSV)
    return paths


def read_parquet(path: Path) -> list[Row]:
    """Read the known columns of an earlier run's table; ThermoCompError for another file."""
    from pyarrow import ArrowException, parquet

    no_table = f'{path}: not a fleet table'
    try:
        rows = parquet.read_table(path).to_pylist()
    except (ArrowException, OSError) as error:
        raise ThermoCompError(f'{no_table}: {" ".join(str(error).split())}') from error
    names = {column.name for column in COLUMNS}
    if not all('serial' in row and 'verdict' in row for row in rows):
        raise ThermoCompError(f'{no_table}: it lacks the columns serial and verdict')
    return [row_of(**{k: v for k, v in row.items() if k in names}) for row in rows]
