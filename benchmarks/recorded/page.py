# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the text of docs/real_data.md: what was found, in sentences and tables.

"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thermo_comp.fitting.rests import describe

from .faces import Faces
from .freezer import (
    Freezer,
    Tracked,
    forecast,
    interleaved,
    ours,
    peers,
    peers_on_the_whole,
)
from .handheld import FOLDS, PARAMETERS, Handheld
from .null import Crossed

COMMAND = 'python benchmarks/real_data.py'
SHIFTS_S = (0.0, 5.0, 10.0, 15.0)

HEAD = f"""<!-- Made by `{COMMAND}`; edit benchmarks/recorded/page.py instead. -->
# Real recordings: what holds on data that nobody here made

Everything on this page is made by one command from three public recordings, in about a minute:

```sh
{COMMAND}        # THERMO_COMP_DATA=folder where the recordings are not in ../shared/data
```

The recordings are not part of the project. They are:

| recording | licence | what it is |
|---|---|---|
| `freezer-mpu6050` (github.com/Iaroslav-Baskov/aurora_IMU_calibrator) | none stated: read, never \
copied | MPU6050 in a freezer, one attitude, three thermometers, 33 min at 12.7 Hz |
| `mikoff-mpu9150` (github.com/mikoff/imu-calib) | MIT, (c) 2020 Aleksandr Mikov | three \
MPU-9150, turned by hand, 160 s at 100 Hz, no temperature |
| `ferraris` (github.com/mad-lab-fau/imucal) | MIT | six faces and three rotations, raw counts |

1 mg is 9.80665e-3 m/s². Times of the freezer run are those of the log's own clock.
"""


def freezer_section(freezer: Freezer, names: dict[str, str]) -> str:
    """
    Say what jumped, what was refused, and what each branch gives.

    """
    lines = [
        '## Freezer run: one attitude, a ramp, and a sensor that jumps',
        '',
        f'![|a| over time and temperature]({names["branches"]})',
        '',
        'The unit was never moved between 49 and 1945 s. Found by themselves:',
        '',
        '| jump at, s | along gravity, mg | x, y, z, mg | within, s | die meanwhile, K | turn '
        'needed, ° | turn seen by the gyro, ° |',
        '|---|---|---|---|---|---|---|',
    ]
    for event in freezer.pose.events:
        vector = ', '.join(f'{v / freezer.per_mg:+.1f}' for v in event.step)
        lines.append(
            f'| {event.time + freezer.origin_s:.1f} | {event.along / freezer.per_mg:+.1f} '
            f'± {event.along_sd / freezer.per_mg:.1f} | {vector} | {event.duration_s:.2f} '
            f'| {event.temperature_change:+.2f} ± {event.temperature_change_sd:.2f} '
            f'| {np.degrees(event.turn_needed):.2f} '
            f'| {np.degrees(event.turn_seen):.2f} |'
        )
    lines += [
        '',
        f'![raw samples around the jumps]({names["jumps"]})',
        '',
        'The first two change the norm, which no turn does; at the third the norm stays, but the '
        'gyroscope saw no turn of the size needed (its own bias jumped with the first and the '
        'third, too). The 0.2 K that the die may have warmed at the second are 0.3 mg of its 18 '
        'at the slopes below. Bumps that pass, near 860 and 1134 s, are no events. '
        '`thermo_comp partial freezer` refuses the whole run:',
        '',
        f'> {freezer.refusal}',
        '',
        'and so does `thermo_comp fit freezer --gravity 9.80665`:',
        '',
        f'> {freezer.full_refusal}',
        '',
        'Branch by branch (`thermo_comp partial freezer --branches`), the reading along gravity '
        'in this attitude; bias and scale of the axes cannot be told apart from it:',
        '',
        '| branch, s | die, °C | order | slope at the middle, mg/K | left, mg | or refused |',
        '|---|---|---|---|---|---|',
    ]
    for fit in freezer.fits:
        begin, end = (t + freezer.origin_s for t in (fit.branch.start_s, fit.branch.end_s))
        where = f'{begin:.0f}..{end:.0f}'
        if fit.model is None:
            lines.append(f'| {where} | | | | | {fit.refusal.split(":")[0]} |')
            continue
        low, high = fit.model.temperature_range
        middle = np.array([-0.5, 0.5]) + 0.5 * (low + high)
        slope = float(np.diff(fit.model.reading(middle))[0]) / freezer.per_mg
        lines.append(
            f'| {where} | {high:.1f}..{low:.1f} | {fit.model.order} | {slope:+.2f} '
            f'| {fit.model.residual_rms / freezer.per_mg:.2f} | |'
        )
    return '\n'.join([*lines, ''])


def held_out_section(freezer: Freezer, names: dict[str, str]) -> str:
    """
    Say what is left of windows that no fit has seen, ours and the peers'.

    """
    mg = freezer.per_mg
    splits = [interleaved(freezer, shift) for shift in SHIFTS_S]
    first, later = splits[0], forecast(freezer)
    mine = {
        (name, extend): ours(freezer, split, extend)[0]
        for name, split in (('first', first), ('later', later))
        for extend in (False, True)
    }
    four = np.sqrt(np.mean([(ours(freezer, s, extend=True)[0].rms / mg) ** 2 for s in splits]))
    theirs = {
        (name, extend): peers(freezer, split, extend)
        for name, split in (('first', first), ('later', later))
        for extend in (False, True)
    }
    theirs_four = {
        name: float(np.sqrt(np.mean([peers(freezer, s, extend=True)[name] ** 2 for s in splits])))
        for name in theirs['first', True]
    }
    whole = peers_on_the_whole(freezer)
    other = {order: ours(freezer, later, extend=True, order=order)[0] for order in (2, 3)}
    bent = {order: found.rms / mg for order, found in other.items()}
    bent_coverage = {order: found.coverage for order, found in other.items()}
    lines = [
        '### Held out: windows that no fit has seen, and the peers on the same split',
        '',
        f'![held-out residuals]({names["held_out"]})',
        '',
        'Means of 25 samples. *Blocks*: 20 s blocks in turn while the die falls from 36 to 15 °C, '
        'both ways round, pooled; in brackets pooled over four phases of the blocks. *Later*: fit '
        '520..1200 s, test 1200..1900 s, 1.1 K below what was seen. The predicted sd '
        'counts noise, the doubt about the curve, and the wander of the level.',
        '',
        '| ours | RMS, mg | limit | residual / predicted sd, RMS | within 95 % interval |',
        '|---|---|---|---|---|',
    ]
    for name, title, limit, extra in (
        ('first', 'blocks', 0.75, f' ({four:.2f})'),
        ('later', 'later', 0.85, ''),
    ):
        found = mine[name, True]
        lines.append(
            f'| {title} | {found.rms / mg:.3f}{extra} | {limit} | {found.normalised_rms:.2f} '
            f'| {100 * found.coverage:.1f} % |'
        )
    lines += [
        '',
        'The same split for everybody; RMS in mg. *Held*: outside the temperatures of the fit '
        'the correction stays at its edge, as all of them (and this compensator) do in '
        'operation; *carried on*: the polynomial goes on. *Whole run*: fitted over all jumps, '
        'residual RMS and largest.',
        '',
        '| | blocks, carried on | later, held | later, carried on | claims an sd | whole run |',
        '|---|---|---|---|---|---|',
    ]
    for name, (rms, largest) in whole.items():
        lines.append(
            f'| {name} | {theirs["first", True][name]:.2f} ({theirs_four[name]:.2f}) '
            f'| {theirs["later", False][name]:.2f} | {theirs["later", True][name]:.2f} | no '
            f'| {rms:.1f}, {largest:.0f}; no complaint |'
        )
    lines += [
        f'| **ours** | {mine["first", True].rms / mg:.2f} ({four:.2f}) '
        f'| {mine["later", False].rms / mg:.2f} | {mine["later", True].rms / mg:.2f} | yes '
        '| refused, with the jumps |',
        '',
        'The peers are written anew from their public descriptions, per axis: PX4-style on all '
        "windows about the range's middle, ArduPilot-style on means per half a kelvin about "
        '35 °C. On board, ArduPilot learns while the temperature rises only and would have '
        'learnt nothing here. White noise alone leaves about 0.6 to 0.7 mg of a 25-sample mean, '
        'so a tenth of a mg between methods is little. On one ramp, bending and a wandering level '
        "look alike, and the order's rule (a line below 10 K, a parabola below 25 K) is prudence "
        'with this run in sight: on *later*, carried on, a parabola of ours would have left '
        f'{bent[2]:.2f} mg and a cubic {bent[3]:.2f} mg, with a predicted sd too small for it '
        f'({100 * bent_coverage[2]:.0f} % and {100 * bent_coverage[3]:.0f} % within). That '
        "ArduPilot's few points do well there is one draw.",
    ]
    return '\n'.join([*lines, ''])


def thermal_section(tracked: Tracked, coarse: Tracked, names: dict[str, str]) -> str:
    """
    Say how thermometer and regime flag did on the real ramp.

    """
    parts = (
        ('handled', 1.5, 45.0),
        ('onset', 49.0, 120.0),
        ('ramp', 120.0, 364.0),
        ('slower', 520.0, 1200.0),
        ('plateau', 1200.0, 1940.0),
        ('reversal', 1945.0, 1975.0),
    )
    still_k_min = [tracked.slope(at - 100.0, at + 100.0) for at in (1500.0, 1800.0)]
    lines = [
        '### Thermometer and regime flag on the real ramp',
        '',
        f'![regime]({names["regime"]})',
        '',
        'The flag is dynamic from the first seconds on: '
        + '; '.join(f'{what} at {at:.0f} s' for at, what in tracked.switches())
        + '. It stays so to the end of the plateau, and says the truth: the die still cools by '
        f'{-still_k_min[0]:.2f} K/min around 1500 s and by {-still_k_min[1]:.2f} around 1800 s, '
        'and with 90 mK of noise per reading, and a filter that must follow '
        '11 K/min, a rate below the default 0.05 K/min cannot be told from it. Asked for 0.3 '
        'K/min, it finds plateau and reversal (the unit is taken out at 1942..1945 s): '
        + '; '.join(f'{what} at {at:.0f} s' for at, what in coarse.switches())
        + '.',
        '',
        f'![thermometer]({names["thermometer"]})',
        '',
        "Error of the die's temperature against parabolas through 20 s of readings, which know "
        'the future (and are themselves wrong in a bend, and while the unit is handled):',
        '',
        '| part | raw reading, mK RMS | estimate, mK RMS | claimed sd, mK | largest, mK |',
        '|---|---|---|---|---|',
    ]
    for name, low, high in parts:
        raw, estimate, sd, worst = (1000.0 * v for v in tracked.errors(low, high))
        lines.append(
            f'| {name}, {low:.0f}..{high:.0f} s | {raw:.0f} | {estimate:.0f} | {sd:.0f} '
            f'| {worst:.0f} |'
        )
    return '\n'.join([*lines, ''])


def handheld_section(units: Sequence[Handheld], names: dict[str, str]) -> str:
    """
    Say what nine parameters came out of three units turned by hand.

    """
    lines = [
        '## Units turned by hand, no temperature',
        '',
        f'![residuals and parameters]({names["handheld"]})',
        '',
        'Positions are found by themselves (rests of 2 s and more). *Direct* is a least squares '
        'of `|M (N - b) / K| - g` by scipy over the same windows of 1 s. Held out: positions in '
        f'{FOLDS} folds, fitted without, judged on them.',
        '',
        '| unit | positions | windows | in sample, mg: ours, direct | held out, mg: ours, direct '
        '| ratio (limit 1.05) | largest difference of a parameter, in its sd |',
        '|---|---|---|---|---|---|---|',
    ]
    for unit in units:
        pulls = np.abs(unit.pulls)
        lines.append(
            f'| {unit.unit} | {len(unit.intervals)} | {len(unit.ours.residual)} '
            f'| {unit.in_sample[0]:.3f}, {unit.in_sample[1]:.3f} '
            f'| {unit.held_out[0]:.3f}, {unit.held_out[1]:.3f} | {unit.ratio:.3f} '
            f'| {pulls.max():.2f} ({PARAMETERS[int(np.argmax(pulls))]}) |'
        )
    ratio = [unit.jackknife_sd / unit.ours.parameter_sd for unit in units]
    lines += [
        '',
        'The claimed sds are honest: a jackknife over positions gives '
        f'{np.sqrt(np.mean(np.square(ratio))):.2f} times as much (RMS over 27 parameters). '
        '`thermo_comp partial imu0 --gravity 9.80665` prints the nine numbers, and says that '
        'they hold at the temperature of the recording, whichever it was.',
    ]
    return '\n'.join([*lines, ''])


def faces_section(faces: Faces) -> str:
    """
    Say what six faces give.

    """
    fit = faces.fit
    sd = fit.parameter_sd
    lines = [
        '## Six faces',
        '',
        f'{faces.n_positions} rests are found beside the three rotations; the annotations of the '
        'session are not read. *By hand*: half the sum and half the difference of opposite faces, '
        'which takes each face for level; the fit does not.',
        '',
        '| axis | bias, counts | by hand | K, counts per m/s² | by hand |',
        '|---|---|---|---|---|',
    ]
    for i, axis in enumerate('xyz'):
        lines.append(
            f'| {axis} | {fit.bias[i]:+.2f} ± {sd[i]:.2f} | {faces.by_hand_bias[i]:+.2f} '
            f'| {fit.scale[i]:.3f} ± {sd[3 + i]:.3f} | {faces.by_hand_scale[i]:.3f} |'
        )
    lines += ['', 'M is refused, with advice:', '', f'> {faces.refusal}', '']
    return '\n'.join(lines)


def null_section(
    spans: Sequence[tuple[str, str]], crossed: Sequence[Crossed], freezer: Crossed
) -> str:
    """
    Say that nothing is found where there is nothing, and a wrong unit is noticed.

    """
    lines = [
        '## Null tests',
        '',
        'Parts of the freezer run whose temperature hardly changes, e.g. `thermo_comp partial '
        'freezer --from 1200 --to 1900` (seconds from the first sample; exit code 1, no file is '
        'written):',
        '',
        '| part | said |',
        '|---|---|',
        *(f'| {part} | {said.split(":")[0]} |' for part, said in spans),
        '',
        'A wrong unit: the handheld recordings, each under the constants of each unit (serials '
        'made to match, a thermometer that stands still lent to them), judged by `evaluate`:',
        '',
        '| data of | calibration of | |f| - g, mg RMS | verdict |',
        '|---|---|---|---|',
    ]
    lines += [
        *(
            f'| unit {one.data} | unit {one.calibration} | {one.rms_mg:.2f} | {one.verdict} |'
            for one in crossed
        ),
        f'| freezer | unit {freezer.calibration} | {freezer.rms_mg:.2f} | {freezer.verdict} |',
        '',
    ]
    return '\n'.join(lines).replace('| |f| - g, mg RMS |', '| \\|f\\| - g, mg RMS |')


def said_steps(freezer: Freezer) -> list[str]:
    """
    Say every event in words, for the terminal.

    """
    return [describe(event, freezer.per_mg) for event in freezer.pose.events]
