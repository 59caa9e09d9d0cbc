# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the drawings of the pages: the chamber test with its cyclogram, an afternoon at home, a unit
in the year after its calibration, and the viewer's layout.

    python docs/make_pictures.py
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle

import thermo_comp as tc
from thermo_comp.field.series import series_of, source_of
from thermo_comp.field.update import update
from thermo_comp.simulation.campaign import parse_cyclogram, positions
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.simulation.run import simulate

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / 'docs' / 'images'
LAYOUT = ROOT / 'config' / 'thermo_comp.foxglove.json'
BLUE, RED, GREY = '#0072B2', '#D55E00', '#5A5A5A'
sys.path.insert(0, str(ROOT / 'benchmarks'))


def draw_chamber(axes: Axes) -> None:
    """Draw the chamber test, not to scale."""
    axes.set_xlim(0, 10)
    axes.set_ylim(0, 6)
    axes.set_axis_off()
    axes.add_patch(
        FancyBboxPatch((0.3, 0.6), 5.6, 4.9, 'round,pad=0.1', fc='#F2F6F9', ec='black', lw=2)
    )
    axes.text(0.5, 5.15, 'chamber: its air follows the cyclogram', fontsize=8)
    axes.add_patch(Rectangle((0.9, 0.85), 4.4, 0.25, fc='#BBBBBB'))
    axes.add_patch(Polygon([(2.0, 1.1), (4.2, 1.1), (3.9, 1.75), (2.3, 1.75)], fc='#DDDDDD'))
    axes.text(1.1, 1.3, 'holder', fontsize=8, color=GREY)
    corners = np.array([(2.15, 2.2), (3.75, 1.75), (4.25, 3.45), (2.65, 3.9)])
    axes.add_patch(Polygon(corners, fc='white', ec='black', lw=1.6))
    axes.add_patch(Polygon(corners * 0.5 + (1.6, 1.42), fc='#E3EFE3', ec='black', lw=1.0))
    axes.text(3.2, 2.82, 'board', fontsize=7, ha='center', va='center', rotation=-15)
    axes.add_patch(Circle((3.62, 2.98), 0.09, color=BLUE))
    axes.add_patch(Circle((4.02, 2.66), 0.09, color=RED))
    for text, at, beside, color in (
        ('T case: leads', (4.08, 2.62), (4.2, 2.0), RED),
        ('T board: lags', (3.66, 3.04), (3.9, 4.3), BLUE),
    ):
        line = {'arrowstyle': '-', 'color': color}
        axes.annotate(text, at, beside, fontsize=8, color=color, arrowprops=line)
    axes.text(0.45, 3.9, 'unit, at rest\nin any attitude', fontsize=8)
    axes.annotate(
        'g', (1.2, 1.5), (1.2, 2.6), ha='center', arrowprops={'arrowstyle': '-|>', 'lw': 1.5}
    )
    axes.plot([4.25, 6.9], [3.4, 3.4], color='black', lw=1.2)
    axes.add_patch(FancyBboxPatch((7.0, 2.5), 2.6, 1.7, 'round,pad=0.1', fc='white', lw=1.6))
    axes.text(8.3, 3.35, 'ros2 bag record\ncounts, T board,\nT case', ha='center', va='center')
    axes.text(8.3, 1.7, 'one bag\nper position', ha='center', va='center', color=GREY)


def draw_cyclogram(axes: Axes) -> None:
    """Draw the chamber program of Golovach's paper, and the readings of two thermometers."""
    program = parse_cyclogram('chamber')
    run = simulate(unit_preset('thermostatted', 1), program, positions(1, 0)[0], rate_hz=0.2)
    hours = np.array(program.time_s) / 3600.0
    axes.plot(hours, program.temperature_c, color='black', lw=1.0, ls=':', label='chamber')
    for name, stamps, value, color in (
        ('T case', run.case_stamp_ns, run.case, RED),
        ('T board', run.board_stamp_ns, run.board, BLUE),
    ):
        axes.plot((stamps - stamps[0]) / 3.6e12, value, color=color, lw=1.2, label=name)
    for start, stop, *pair in zip(
        hours, hours[1:], program.temperature_c, program.temperature_c[1:], strict=False
    ):
        word = 'soak' if pair[0] == pair[1] else 'ramp'
        if word == 'ramp':
            axes.axvspan(start, stop, color='#E9E9E9', lw=0)
        if stop - start > 0.25:
            axes.text((start + stop) / 2, 39.2, word, ha='center', fontsize=7, color=GREY)
    axes.set(xlabel='time, h', ylabel='°C', ylim=(2, 41), xlim=(0, hours[-1]))
    axes.legend(loc='lower left', fontsize=7, frameon=False)


def draw_afternoon(axes: Axes) -> None:
    """Draw an afternoon at home: the temperature of the surroundings and of the chip."""
    legs = [('desk', 22.0, 10.0), ('freezer', -15.0, 30.0), ('desk', 22.0, 40.0)]
    legs += [('dryer', 45.0, 15.0), ('desk', 22.0, 30.0)]
    minute = np.arange(0.0, sum(leg[2] for leg in legs), 0.1)
    ends = np.cumsum([leg[2] for leg in legs])
    outside = np.array([leg[1] for leg in legs])[np.searchsorted(ends, minute, 'right')]
    chip = np.empty_like(minute)
    chip[0] = outside[0]
    for row in range(1, len(minute)):
        chip[row] = chip[row - 1] + 0.1 / 9.0 * (outside[row] - chip[row - 1])
    axes.plot(minute, outside, color=GREY, lw=1, label='surroundings')
    axes.plot(minute, chip, color=BLUE, lw=2, label='chip, as measured')
    begins = np.concatenate(([0.0], ends[:-1]))
    names = {'desk': 'on the desk', 'freezer': 'in the freezer', 'dryer': 'hair dryer'}
    for (name, _, long), begin in zip(legs, begins, strict=True):
        axes.axvspan(
            begin, begin + long, color='#F2F6F9' if name == 'desk' else '#DCE8F0', zorder=0
        )
        axes.text(begin + long / 2.0, 53.0, names[name], ha='center', fontsize=7)
    axes.set_ylim(-20.0, 60.0)
    axes.set_xlabel('time, min')
    axes.set_ylabel('degC')
    axes.legend(loc='lower right', fontsize=8, frameon=False)


def series() -> dict[str, tuple[Any, Any]]:
    """Return time [min] and values of the signals of the Foxglove layout, for the held-out bag."""
    recording = tc.read(ROOT / 'bags' / 'held_out.mcap')
    calibration = tc.fit(sorted((ROOT / 'bags' / 'fit').glob('*.mcap')), gravity=9.80665)
    out = calibration.correct(recording.time_s, recording.counts, **recording.temperatures)
    minutes = recording.time_s / 60.0
    found: dict[str, tuple[Any, Any]] = {'/regime/dynamic.data': (minutes, out.dynamic)}
    for i, axis in enumerate('xyz'):
        found[f'/accel/counts.vector.{axis}'] = minutes, recording.counts[:, i]
        found[f'/imu/data_raw.linear_acceleration.{axis}'] = minutes, out.specific_force[:, i]
        sd = np.sqrt(out.covariance[:, i, i])
        found[f'/imu/data_raw.linear_acceleration_covariance[{4 * i}].@sqrt'] = minutes, sd
    script = '/studio_script/temperature_rates.'
    for name, (time, value) in recording.temperatures.items():
        found[f'/temperature/{name}.temperature'] = time / 60.0, value
        smooth = np.convolve(value, np.ones(25) / 25, 'valid')
        inner = time[12:-12] / 60.0
        found[f'{script}{name}_k_min'] = inner, np.gradient(smooth, inner)
    return found


def draw_layout(figure: Figure) -> None:
    """Draw the panels of the Foxglove layout, in their positions, with the held-out bag."""
    saved = json.loads(LAYOUT.read_text(encoding='utf-8'))
    data = series()

    def place(node: Any, x: float, y: float, width: float, height: float) -> None:
        if isinstance(node, dict):
            share = node.get('splitPercentage', 50) / 100.0
            if node['direction'] == 'row':
                place(node['first'], x, y, width * share, height)
                place(node['second'], x + width * share, y, width * (1 - share), height)
            else:
                place(node['first'], x, y, width, height * share)
                place(node['second'], x, y + height * share, width, height * (1 - share))
            return
        panel = saved['configById'][node]
        title = panel.get('title') or panel.get('foxglovePanelTitle') or node.split('!')[1]
        # Each panel has axis labels beside and below, and a title above.
        left, below, above = 0.04, 0.048, 0.032
        axes = figure.add_axes(
            (x + left, 1.0 - y - height + below, width - left - 0.016, height - below - above)
        )
        axes.set_title(title, fontsize=7, loc='left', pad=2)
        axes.tick_params(labelsize=5.5, length=2)
        drawn = [p['value'] for p in panel.get('paths', []) if p['value'] in data]
        axes.ticklabel_format(axis='y', useMathText=True, scilimits=(-2, 5))
        axes.yaxis.get_offset_text().set_fontsize(5.5)
        for path in drawn:
            axes.plot(*data[path], lw=0.7)
        if not drawn:
            axes.set(xticks=[], yticks=[])
            axes.text(0.5, 0.5, '/diagnostics of the live node', ha='center', fontsize=6)

    place(saved['layout'], 0.0, 0.0, 1.0, 1.0)


def draw_year(axes: Axes) -> None:
    """Draw |f| - g of a vehicle's unit over a year, with and without weekly updates."""
    import field_units as units

    laboratory = units.calibration()
    history = units.live('level', 5, 364, units.Process(shock_day=140.0))
    day, calibrated = np.array(history.day), laboratory
    error: dict[str, list[float]] = {'old': [], 'new': [], 'claim': []}
    for week in range(52):
        chosen = [history.rests[k] for k in np.flatnonzero(day // 7 == week)]
        old, new = (series_of(chosen, cal) for cal in (laboratory, calibrated))
        for day in np.unique(new.day):
            at = new.day == day
            for name, values in (
                ('old', old.residual),
                ('new', new.residual),
                ('claim', new.claim),
            ):
                error[name].append(float(np.sqrt(np.mean(values[at] ** 2))) / units.UG)
        updated = update(new, calibrated, source_of(chosen, '', 7.0), ahead=7.0)
        if updated.judged.is_better:
            calibrated = updated.calibration
    days = np.arange(len(error['old']))
    axes.plot(days, error['old'], color=RED, lw=0.8, label="the chamber's calibration")
    axes.plot(days, error['new'], color=BLUE, lw=0.8, label='updated every week')
    claim = 2.0 * np.array(error['claim'])
    axes.fill_between(days, 0.0, claim, color=BLUE, alpha=0.15, label='2 claimed sd')
    axes.axvline(140.0, color=GREY, lw=0.8, ls=':')
    axes.text(142.0, 0.9 * max(error['old']), 'a shock', color=GREY)
    axes.set(xlabel='days after the chamber', ylabel='|f| - g at rest, RMS of a day [ug]')
    axes.set(xlim=(0, 364), ylim=(0, None))
    axes.legend(loc='upper right', frameon=False)


def main() -> None:
    """Write the drawings into docs/images."""
    plt.rcParams.update({'svg.hashsalt': 'thermo_comp', 'font.size': 8, 'svg.fonttype': 'none'})
    figure = plt.figure(figsize=(9, 3.3), layout='constrained')
    left, right = figure.subplots(1, 2, width_ratios=(1, 1))
    draw_chamber(left)
    draw_cyclogram(right)
    figure.savefig(IMAGES / 'chamber_test.png', dpi=130, metadata={'Software': None})
    figure = plt.figure(figsize=(9, 3.0), layout='constrained')
    draw_afternoon(figure.subplots())
    figure.savefig(IMAGES / 'afternoon.png', dpi=110, metadata={'Software': None})
    figure = plt.figure(figsize=(9, 3.2), layout='constrained')
    draw_year(figure.subplots())
    figure.savefig(IMAGES / 'year.png', dpi=110, metadata={'Software': None})
    figure = plt.figure(figsize=(9, 5))
    draw_layout(figure)
    figure.savefig(IMAGES / 'viewer.png', dpi=110, metadata={'Software': None})


if __name__ == '__main__':
    main()
