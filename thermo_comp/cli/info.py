# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp info``: what is in a bag or a calibration, and whether it is fit for a fit.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ..text import counted
from . import options
from .options import argument
from .output import Output, micro_g, picked

if TYPE_CHECKING:
    from ..recording import Topics


def info(
    *,
    path: Annotated[Path, argument('Bag or calibration file.', metavar='BAG|YAML')],
    topics: options.TopicsPart,
    out: options.Out,
) -> None:
    """
    Say what is in a bag or a calibration.

    Of a bag: topics, rate, temperature span and ramps, gaps, and whether
    it is fit for a fit. Of a calibration: unit, ranges, sets, residuals.

    Example:
      thermo_comp info chamber.mcap
    """
    if path.suffix in ('.yaml', '.yml'):
        _calibration(out, path)
    else:
        _bag(out, path, topics)


def _bag(out: Output, path: Path, topics: Topics) -> None:
    from ..recording.overview import survey_recording

    with out.progress(f'reading {path.name}') as done:
        survey = survey_recording(path, topics, done)
    found, thermometers = survey.info, survey.thermometers
    out.line(f'{path}: {found.storage}, {found.n_messages} messages')
    for key, value in found.metadata.items():
        if key in ('serial', 'converted_from', 'corrected_from', 'simulated_by'):
            out.line(f'  {key.replace("_", " ")}: {value}')
    out.table(
        ('topic', 'type', 'messages'),
        [(name, kind, count) for name, (kind, count) in sorted(found.topics.items())],
    )
    if survey.n:
        out.line(
            f'{survey.n} samples of {found.input}, {survey.rate_hz:.4g} Hz, '
            f'{survey.duration_s:.1f} s; {counted(survey.n_still, "still interval")}, '
            f'{survey.still_s:.1f} s'
        )
    if found.chosen:
        out.line(found.chosen)
    if thermometers:
        out.table(
            ('sensor', 'Hz', 'min degC', 'max degC', 'max K/min', 'min K/min'),
            [
                (
                    *(name, one.rate_hz, one.lowest, one.highest),
                    *(one.steepest_heating_k_min, one.steepest_cooling_k_min),
                )
                for name, one in thermometers.items()
            ],
        )
    for finding in survey.findings:
        out.line(f'- {finding}')
    if not survey.findings:
        out.line('fit for a fit, together with other positions')
    out.json(
        {
            'path': path,
            **picked(found, 'storage truncated metadata input chosen'),
            'topics': {
                name: {'type': kind, 'messages': count}
                for name, (kind, count) in found.topics.items()
            },
            'samples': survey.n,
            'still_intervals': survey.n_still,
            'board': thermometers.get('board'),
            'case': thermometers.get('case'),
            **picked(survey, 'rate_hz duration_s still_s thermometers findings'),
        }
    )
    out.end(int(bool(found.truncated)))


def _calibration(out: Output, path: Path) -> None:
    from ..unit.calibration_file import load_calibration

    calibration = load_calibration(path)
    unit, provenance, axes = calibration.unit, calibration.provenance, calibration.axes
    out.line(f'{path}: unit {unit.serial}, {unit.input} up to {unit.full_scale:g}')
    out.line(
        f'  fitted {provenance.created or "at an unknown time"} by thermo_comp '
        f'{provenance.tool_version or "?"} from {len(provenance.sources)} bags, '
        f'model {provenance.model or "?"}'
    )
    out.line(
        f'  local gravity {calibration.gravity_m_s2:.6g} m/s^2, '
        f'reference {calibration.reference_temperature_c:g} degC'
    )
    out.table(
        ('axis', 'scale factor', 'bias', 'bias ug'),
        [
            (
                *(name, f'{axis.scale_factor:.8g}', f'{axis.bias:.6g}'),
                micro_g(axis.bias / axis.scale_factor),
            )
            for name, axis in zip('xyz', (axes.x, axes.y, axes.z), strict=True)
        ],
    )
    out.table(
        ('set', 'degC', 'K/min', 'bias(t)', 'scale(t)'),
        [
            (
                name,
                '{:.1f} .. {:.1f}'.format(*one.temperature_range_c),
                '{:.2f} .. {:.2f}'.format(*one.rate_range_k_min),
                one.x.bias_function.kind,
                one.x.scale_function.kind,
            )
            for name, one in zip(('static', 'dynamic'), calibration.regime_sets(), strict=True)
        ],
    )
    if provenance.residuals:
        out.table(
            ('section', 'windows', 'raw ug RMS', 'ug RMS', 'ug max'),
            [
                (
                    *(row.section, row.n_windows),
                    *map(micro_g, (row.raw_rms_m_s2, row.rms_m_s2, row.max_m_s2)),
                )
                for row in provenance.residuals
            ],
        )
    for note in provenance.notes:
        out.line(f'- {note}')
    out.json({'path': path, 'calibration': calibration})
