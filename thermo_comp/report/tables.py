# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the tables of the model and of the unit: steps, parts, axes, positions."""

from __future__ import annotations

import numpy as np

from ..unit.calibration import AXES, Calibration
from ..unit.gravity import MICRO_G
from .evidence import LEFT_OUT, Evidence
from .html import table
from .text import number

#: Steps of the model by their names in `fitting.ResidualRow`.
_STEPS = {
    'raw': 'raw',
    'one_set': 'one set',
    'two_sets': 'two sets',
    'fitted': 'response',
    'left_out': 'left out',
}
#: What the groups of `unit.columns` are, in words.
_GROUPS = {
    'curve': 'curve over temperature',
    'set': 'difference of the sets',
    'now': 'heat flow (case − board)',
    'rate': 'rate of the board',
    'board': 'parts that lag the board',
    'neighbour': 'parts between case and board',
    'product': 'lags, changing with temperature',
    'mixed': 'heat flow, changing with temperature',
    'square': 'curves of parts that lag',
    'even': 'size of the heat flow',
    'play': 'hysteresis',
}


def axes_table(calibration: Calibration | None) -> str:
    """Tell what the unit is at the reference temperature."""
    if calibration is None:
        return ''
    unit = 'counts' if calibration.unit.input == 'counts' else 'm/s²'
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    rows = [
        (
            axis,
            number(reference.scale_factor, 9),
            number(reference.bias, 6),
            number(reference.bias / reference.scale_factor / MICRO_G, 5),
            number(density / MICRO_G),
            *(f'{value:.6f}'.replace('-', '−') for value in row),
        )
        for axis, reference, density, row in zip(
            AXES,
            axes,
            calibration.noise_density_m_s2_sqrt_hz,
            calibration.misalignment,
            strict=True,
        )
    ]
    return '<h2>The unit at the reference temperature</h2>' + table(
        (
            'axis',
            f'scale factor, {unit} per m/s²',
            f'bias, {unit}',
            'bias, µg',
            'noise, µg/√Hz',
            'M₁',
            'M₂',
            'M₃',
        ),
        rows,
        caption='M, here by its columns, takes the sensitivity axes to the output frame.',
    )


def steps_table(evidence: Evidence) -> str:
    """Tell what each step of the model leaves; nothing without a fit."""
    rows = [
        (
            one.section,
            *(number(getattr(one, name).rms / MICRO_G) for name in _STEPS),
            str(one.raw.n),
        )
        for one in evidence.steps
        if one.raw.n
    ]
    if not rows:
        return ''
    return '<h2>What each step of the model leaves</h2>' + table(
        ('section', *(f'{words}, µg' for words in _STEPS.values()), 'windows'),
        rows,
        caption='RMS of |g| − g over the windows of the fit. One set: a curve over temperature, '
        'blind to the regime; two sets: one for each regime, as the paper has it; response: all '
        'of the model. Left out: each position with what the other positions say of the unit, '
        'which is what a new attitude will see; – where none can be done without.',
    )


def groups_table(calibration: Calibration | None) -> str:
    """Tell what each part of the model explains; nothing of a calibration without evidence."""
    if calibration is None or not calibration.evidence:
        return ''
    return '<h2>What each part of the model explains</h2>' + table(
        ('part', 'of the', 'explains, µg', 'parameters', 'log evidence'),
        [
            (
                _GROUPS.get(one.group, one.group),
                one.part,
                number(one.explains_m_s2 / MICRO_G),
                f'{one.effective_parameters:.1f}',
                f'{one.log_evidence_change:+.1f}'.replace('-', '−'),
            )
            for one in calibration.evidence
        ],
        texts=2,
        caption='Explains: RMS of its share in the correction over the windows of the fit; shares '
        'may cancel each other. Parameters: how many the data determine. Log evidence: by how '
        'much it falls without this part.',
    )


def positions_table(evidence: Evidence) -> str:
    """List the positions with what is left on each."""
    if not evidence.positions:
        return ''
    shown = [*evidence.residuals, *([LEFT_OUT] if evidence.left_out else [])]
    return '<h2>Positions</h2>' + table(
        ('no.', 'bag', 'rest, min', 'up x', 'up y', 'up z', *(f'{r}, µg RMS' for r in shown)),
        [
            (
                str(one.number),
                evidence.bags[one.bag].name,
                f'{one.duration_s / 60.0:.1f}',
                *(f'{value:+.4f}'.replace('-', '−') for value in one.up),
                *(number(one.residual_rms.get(rung, np.nan) / MICRO_G) for rung in shown),
            )
            for one in evidence.positions
        ],
        texts=2,
        caption='Up: the direction of the specific force in the output frame. Left out: with what '
        'the other positions say of the unit; – where it tells what no other does.'
        if evidence.left_out
        else 'Up: the direction of the specific force in the output frame.',
    )
