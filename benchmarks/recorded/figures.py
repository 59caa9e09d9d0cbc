# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the plots of docs/real_data.md.

"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use('Agg')

from matplotlib import pyplot as plt
from thermo_comp.fitting.held_out import HeldOut

from .freezer import COLD_C, HOT_C, TEST_S, TRAIN_S, Freezer, Tracked
from .handheld import MG, PARAMETERS, Handheld

BLUE, ORANGE, GREEN, RED, GREY = '#0072b2', '#e69f00', '#009e73', '#d55e00', '#808080'
STYLE: dict[str, Any] = {
    'figure.dpi': 110,
    'savefig.dpi': 110,
    'font.size': 9,
    'axes.grid': True,
    'grid.color': '#e4e4e4',
    'axes.axisbelow': True,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.titlesize': 10,
    'axes.titlelocation': 'left',
    'legend.frameon': False,
    'legend.fontsize': 8,
    'svg.hashsalt': 'thermo_comp',
}


def save(figure: Any, folder: Path, name: str) -> str:
    """
    Write one figure and return its name.

    """
    path = folder / f'{name}.png'
    # Without a date or version of its own the same numbers give the same file.
    figure.savefig(path, bbox_inches='tight', metadata={'Software': None})
    plt.close(figure)
    return path.name


def regime_figure(tracked: Tracked, coarse: Tracked, folder: Path) -> str:
    """
    Plot temperatures, rate and the flag over the run.

    """
    with plt.rc_context(STYLE):
        figure, (top, middle, low) = plt.subplots(
            3, 1, figsize=(9, 6.4), sharex=True, height_ratios=(3, 2, 1)
        )
        top.plot(tracked.time, tracked.estimate, color=BLUE, label='die (board)')
        top.plot(tracked.time, tracked.case, color=ORANGE, label='air (case)')
        top.set(ylabel='temperature, °C', title='Freezer run: what the node would have known')
        top.legend(loc='upper right')
        middle.plot(tracked.time, tracked.rate, color=BLUE, lw=0.8)
        middle.set(ylabel='die rate, K/min', ylim=(-12, 6))
        for number, (which, run, colour) in enumerate(
            (('0.3', coarse, GREY), ('0.05', tracked, GREEN))
        ):
            is_dynamic = run.regime == 1
            low.fill_between(
                run.time, number, number + 0.8, where=is_dynamic, color=colour, lw=0, step='post'
            )
            low.text(60.0, number + 0.4, f'relaxed rate {which} K/min', va='center', color='white')
        low.set(ylim=(-0.1, 1.9), yticks=[], xlabel='time of the log, s')
        low.set_ylabel('dynamic')
        low.grid(visible=False)
        figure.align_ylabels()
        return save(figure, folder, 'freezer_regime')


def thermometer_figure(tracked: Tracked, folder: Path) -> str:
    """
    Plot the estimate against raw readings: in the ramp, at the plateau, at the reversal.

    """
    parts = (('ramp', 120.0, 126.0), ('plateau', 1500.0, 1506.0), ('reversal', 1938.0, 1962.0))
    with plt.rc_context(STYLE):
        figure, all_axes = plt.subplots(1, 3, figsize=(9, 3.1))
        for axes, (name, low, high) in zip(all_axes, parts, strict=True):
            part = (tracked.time >= low) & (tracked.time < high)
            t = tracked.time[part]
            axes.plot(t, tracked.reading[part], '.', ms=3, color=GREY, label='reading')
            axes.fill_between(
                t,
                tracked.estimate[part] - 2.0 * tracked.sd[part],
                tracked.estimate[part] + 2.0 * tracked.sd[part],
                color=BLUE,
                alpha=0.25,
                lw=0,
                label='± 2 sd claimed',
            )
            axes.plot(t, tracked.estimate[part], color=BLUE, label='estimate, causal')
            axes.plot(
                t, tracked.reference[part], '--', color=RED, lw=1, label='parabolas, 20 s, centred'
            )
            axes.set(title=name, xlabel='time of the log, s')
        all_axes[0].set_ylabel('die temperature, °C')
        figure.legend(
            *all_axes[0].get_legend_handles_labels(),
            loc='lower center',
            ncol=4,
            bbox_to_anchor=(0.5, -0.12),
        )
        figure.tight_layout()
        return save(figure, folder, 'freezer_thermometer')


def branches_figure(freezer: Freezer, folder: Path) -> str:
    """
    Plot |a| over time and over temperature, with jumps and the fit of each branch.

    """
    series, mg = freezer.pose.series, freezer.per_mg
    inside = series.branch >= 0
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(
            1, 2, figsize=(9.5, 4), sharey=True, width_ratios=(3, 2)
        )
        for axes, x in ((left, freezer.time), (right, series.temperature)):
            axes.plot(x[inside], series.norm[inside] / mg, '.', ms=2.5, color=GREY)
        for fit, colour in zip(freezer.fits, (BLUE, RED, RED, GREEN), strict=True):
            if fit.model is None:
                continue
            at = np.linspace(*fit.model.temperature_range, 100)
            begin, end = (t + freezer.origin_s for t in (fit.branch.start_s, fit.branch.end_s))
            label = f'{begin:.0f}..{end:.0f} s, order {fit.model.order}'
            right.plot(at, fit.model.reading(at) / mg, color=colour, lw=2, label=label)
            part = (freezer.time >= begin) & (freezer.time <= end)
            left.plot(
                freezer.time[part],
                fit.model.reading(series.temperature[part]) / mg,
                color=colour,
                lw=2,
            )
        for number, event in enumerate(freezer.pose.events):
            at_s = event.time + freezer.origin_s
            left.axvline(at_s, color=RED, lw=1, ls='--')
            left.text(
                560.0,
                962.0 + 7.0 * number,
                f'{event.along / mg:+.1f} mg at {at_s:.1f} s',
                color=RED,
                fontsize=8,
                bbox={'facecolor': 'white', 'edgecolor': 'none', 'pad': 1.0},
            )
        left.set(
            xlabel='time of the log, s',
            ylabel='|a| of 25 samples, mg',
            title='One attitude, never moved: the sensor jumps',
        )
        right.set(xlabel='die temperature, °C', title='No function of temperature')
        right.legend(loc='upper right')
        figure.tight_layout()
        return save(figure, folder, 'freezer_branches')


def jumps_figure(freezer: Freezer, time: Any, accel: Any, folder: Path) -> str:
    """
    Plot the raw samples around each jump.

    """
    events, mg = freezer.pose.events, freezer.per_mg
    with plt.rc_context(STYLE):
        figure, rows = plt.subplots(
            2, len(events), figsize=(9.5, 4), sharex='col', squeeze=False, height_ratios=(2, 1)
        )
        for column, event in enumerate(events):
            at = event.time + freezer.origin_s
            part = np.abs(time - at) < 4.0
            middle = np.median(accel[part], axis=0)
            for i, (name, colour) in enumerate(zip('xyz', (BLUE, ORANGE, GREEN), strict=True)):
                rows[0][column].plot(
                    time[part],
                    (accel[part, i] - middle[i]) / mg + 40.0 * (1 - i),
                    '.-',
                    ms=3,
                    lw=0.6,
                    color=colour,
                    label=name,
                )
            rows[1][column].plot(
                time[part],
                np.linalg.norm(accel[part], axis=1) / mg,
                '.-',
                ms=3,
                lw=0.6,
                color=GREY,
            )
            rows[0][column].set_title(f'{at:.1f} s: {event.along / mg:+.1f} mg along g')
            rows[1][column].set_xlabel('time of the log, s')
        rows[0][0].set_ylabel('reading, mg, 40 apart')
        rows[1][0].set_ylabel('|a|, mg')
        figure.tight_layout()
        figure.legend(
            *rows[0][0].get_legend_handles_labels(),
            loc='lower center',
            ncol=3,
            bbox_to_anchor=(0.5, -0.05),
        )
        return save(figure, folder, 'freezer_jumps')


def held_out_figure(
    freezer: Freezer, interleaved: HeldOut, forecast: HeldOut, folder: Path
) -> str:
    """
    Plot held-out residuals with the sd that was predicted for them.

    """
    mg = freezer.per_mg
    with plt.rc_context(STYLE):
        figure, all_axes = plt.subplots(1, 2, figsize=(9.5, 3.2), sharey=True)
        titles = (
            f'20 s blocks in turn, die {HOT_C:.0f}..{COLD_C:.0f} °C',
            f'fit {TRAIN_S[0]:.0f}..{TRAIN_S[1]:.0f} s, test {TEST_S[0]:.0f}..{TEST_S[1]:.0f} s',
        )
        for axes, found, title in zip(all_axes, (interleaved, forecast), titles, strict=True):
            order = np.argsort(found.time)
            t = found.time[order] + freezer.origin_s
            sd = found.predicted_sd[order] / mg
            axes.fill_between(t, -1.96 * sd, 1.96 * sd, color=BLUE, alpha=0.2, lw=0)
            axes.plot(t, found.residual[order] / mg, '.', ms=3, color=BLUE)
            axes.set(
                title=f'{title}\n{found.rms / mg:.2f} mg RMS, {100 * found.coverage:.0f} % within',
                xlabel='time of the log, s',
            )
        all_axes[0].set_ylabel('held-out residual, mg')
        figure.tight_layout()
        return save(figure, folder, 'freezer_held_out')


def handheld_figure(units: Sequence[Handheld], folder: Path) -> str:
    """
    Plot residuals by position, and our parameters against the direct ones.

    """
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.4), width_ratios=(3, 2))
        for unit, colour in zip(units, (BLUE, ORANGE, GREEN), strict=True):
            at = unit.ours.position + 0.2 * (unit.unit - 1)
            left.plot(
                at,
                unit.ours.residual / MG,
                '.',
                ms=4,
                color=colour,
                label=f'unit {unit.unit}: {unit.in_sample[0]:.2f} mg RMS',
            )
            right.errorbar(
                np.arange(9) + 0.2 * (unit.unit - 1),
                unit.pulls,
                yerr=unit.jackknife_sd / unit.ours.parameter_sd,
                fmt='o',
                ms=4,
                lw=1,
                color=colour,
            )
        left.set(xlabel='position', ylabel='|f| - g, mg', title='1 s windows at rest')
        left.legend(loc='upper left', ncol=3, columnspacing=0.8, handletextpad=0.1)
        left.set_ylim(-2.2, 2.8)
        right.set(
            xticks=np.arange(9),
            xticklabels=PARAMETERS,
            ylim=(-2, 2),
            ylabel='ours - direct, in our sd',
            title='Nine parameters; bars: jackknife sd',
        )
        figure.tight_layout()
        return save(figure, folder, 'handheld')
