# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the faults of docs/faults.md, each with the required output and the required diagnostics. In
the bag of `fault_rig` the unit turns until 40 s, and the ramp is from 60 to 120 s.
"""

import math
from dataclasses import dataclass, field

import fault_rig as rig
import numpy as np

OK, WARN, ERROR = 0, 1, 2
#: Number of samples in the bag without a fault.
N_SAMPLES = round(rig.RATE_HZ * rig.DURATION_S)


@dataclass(frozen=True)
class Row:
    fault: str
    inject: rig.Inject
    #: Required diagnostics: pairs of a level and a part of the message.
    says: tuple[tuple[int, str], ...]
    #: Smallest allowed number of published samples.
    n_least: int
    #: Spans [s] in which nothing may be published.
    silent: tuple[tuple[float, float], ...] = ()
    #: Span [s] from the fault to its detection, in which the published force may be wrong.
    blind: tuple[float, float] = (0.0, 0.0)
    #: Time [s] from which the output is within 1 ug of the output without the fault; inf if never.
    recovered: float = 0.0
    #: Time [s] from which stamps are ahead of the true times, and by how many seconds.
    shift: tuple[float, float] = (math.inf, 0.0)
    #: Messages into which the fault is inserted; None: the bag of `fault_rig`.
    source: list[rig.Event] | None = field(default=None, repr=False)


def swap_topics(events):
    other = {'board': 'case', 'case': 'board'}
    return [(other.get(topic, topic), stamp, v) for topic, stamp, v in events]


def lose(share):
    rng = np.random.default_rng(3)
    return rig.changed('counts', 0.0, 999.0, lambda e: [e] if rng.random() >= share else [])


def faster(begin_s, end_s, factor):
    """Replace each sample by `factor` samples, each with 1/`factor` of its counts."""
    step_ns = round(1e9 / rig.RATE_HZ / factor)

    def split(event):
        topic, stamp_ns, sample = event
        part = tuple(float(round(count / factor)) for count in sample)
        parts = ((k, (part[0] + k % 2, *part[1:])) for k in reversed(range(factor)))
        return [(topic, stamp_ns - k * step_ns, counts) for k, counts in parts]

    return rig.changed('counts', begin_s, end_s, split)


def play_again(begin_s):
    """Play the messages before `begin_s` and then the whole bag, so that stamps jump back."""
    return lambda events: [e for e in events if rig.seconds_of(e[1]) < begin_s] + events


def sensor_rows(name):
    """Return the faults of a thermometer; only faults of the board thermometer stop the output."""
    is_board = name == 'board'
    lost = 'nothing is published' if is_board else 'the board sensor decides the regime'
    level = ERROR if is_board else WARN
    held = (WARN, 'board temperature') if is_board else (WARN, 'case temperature lost')
    return [
        Row(f'{name} stops', rig.stop(name, 80.0, 130.0), ((level, lost),), 3600,
            silent=((100.5, 129.5),) if is_board else (), recovered=165.0),
        Row(f'{name} freezes in the ramp', rig.frozen(name, 80.0, 130.0),
            ((WARN, f'{name} temperature frozen'), (level, lost)), 3650,
            silent=((107.8, 129.5),) if is_board else (), recovered=165.0),
        Row(f'{name} freezes in the soak', rig.frozen(name, 45.0, 130.0),
            ((WARN, f'{name} temperature stands still'), (WARN, f'{name} temperature frozen')),
            3450, recovered=200.0),
        Row(f'{name} jumps by 40 K', rig.value(name, 80.0, 95.0, lambda v: v + 40.0),
            ((WARN, f'{name} temperature jumped by +'),), N_SAMPLES, recovered=125.0),
        Row(f'{name} jumps by 40 K and stays', rig.value(name, 80.0, 130.0, lambda v: v + 40.0),
            ((WARN, f'{name} temperature jumped by +'), (WARN, 'outside the calibrated range')),
            3950, recovered=230.0),
        Row(f'{name} jumps by 2 K', rig.value(name, 80.0, 130.0, lambda v: v + 2.0), (), N_SAMPLES,
            recovered=220.0),
        *(
            Row(f'{name} is {word}', rig.value(name, 80.0, 95.0, lambda _, bad=bad: bad), (held,),
                N_SAMPLES, recovered=125.0)
            for word, bad in (('NaN', math.nan), ('infinite', -math.inf))
        ),
        Row(f'{name} in whole degrees', rig.value(name, 45.0, 160.0, lambda v: float(round(v))),
            ((WARN, f'{name} temperature'),), 3850, recovered=220.0),
        Row(f'{name} twice', rig.changed(name, 45.0, 160.0, lambda e: [e, e]), (), N_SAMPLES),
        Row(f'{name} out of order', rig.shuffled(name, 45.0, 160.0), (), N_SAMPLES,
            recovered=170.0),
        Row(f'{name} late by 5 s', rig.late(name, 5.0, 45.0, 160.0),
            ((WARN, 'board temperature 5'),) if is_board else (), N_SAMPLES, recovered=200.0),
    ]  # fmt: skip


BOTH_ROWS = [
    Row('both temperatures freeze',
        rig.chain(rig.frozen('board', 80.0, 130.0), rig.frozen('case', 80.0, 130.0)),
        ((WARN, 'board temperature stands still'), (WARN, 'case temperature stands still')),
        N_SAMPLES, recovered=230.0),
    Row('board thermometer loose',
        rig.value('board', 45.0, 999.0, lambda v: 20.0 + 0.01 * math.sin(1e5 * v)),
        ((WARN, 'thermometer loose'),), N_SAMPLES, blind=(60.0, 85.0), recovered=math.inf),
    Row('both temperatures stop',
        rig.chain(rig.stop('board', 80.0, 130.0), rig.stop('case', 80.0, 130.0)),
        ((ERROR, 'nothing is published'), (WARN, 'case temperature lost')), 3600,
        silent=((100.5, 129.5),), recovered=170.0),
    Row('topics swapped', swap_topics, ((ERROR, 'swapped'),), N_SAMPLES, recovered=math.inf),
]  # fmt: skip

SAMPLE_ROWS = [
    Row('counts are NaN', rig.value('counts', 80.0, 95.0, lambda v: (math.nan, v[1], v[2])),
        ((WARN, 'samples not finite, dropped'),), 3800, silent=((80.0, 95.0),)),
    Row('counts saturated',
        rig.value('counts', 80.0, 95.0, lambda v: (v[0], -rig.FULL_SCALE, v[2])),
        ((ERROR, 'samples saturated'),), 3800, silent=((80.0, 95.0),)),
    Row('counts stuck', rig.frozen('counts', 80.0, 130.0),
        ((ERROR, 'samples stuck or all zero, dropped'),), 3375, silent=((84.1, 130.0),),
        recovered=130.0),
    Row('counts stuck in motion', rig.frozen('counts', 10.0, 20.0),
        ((ERROR, 'samples stuck or all zero, dropped'),), 3850, silent=((14.1, 20.0),),
        blind=(10.0, 14.1), recovered=20.0),
    Row('one axis stuck in motion', rig.value('counts', 10.0, 20.0, lambda v: (v[0], v[1], 77.0)),
        ((ERROR, 'samples stuck or all zero, dropped'),), 3850, silent=((14.1, 20.0),),
        blind=(10.0, 14.1), recovered=20.0),
    Row('counts all zero', rig.value('counts', 80.0, 95.0, lambda _: (0.0, 0.0, 0.0)),
        ((ERROR, 'samples stuck or all zero, dropped'),), 3800, silent=((80.0, 95.0),)),
    Row('an axis reversed', rig.value('counts', 130.0, 220.0, lambda v: (v[0], v[1], -v[2])),
        ((ERROR, 'or an axis reversed? Nothing is published'),), 2800,
        silent=((138.1, 220.0),), blind=(130.0, 138.1), recovered=220.0),
    Row('an axis reversed from the start',
        rig.value('counts', 0.0, 999.0, lambda v: (v[0], v[1], -v[2])),
        ((ERROR, 'or an axis reversed? Nothing is published'),), 500, silent=((48.1, 320.0),),
        blind=(0.0, 48.1), recovered=math.inf),
    *(
        Row(f'{share:.0%} of the counts lost', lose(share), (),
            round(0.95 * N_SAMPLES * (1.0 - share)))
        for share in (0.01, 0.1, 0.5)
    ),
    Row('counts lost in bursts',
        rig.changed('counts', 0.0, 999.0, lambda e: [e] if rig.seconds_of(e[1]) // 7 % 2 else []),
        ((WARN, 'samples/s, calibrated for'),), 1950, recovered=300.0),
    Row('counts twice', rig.changed('counts', 0.0, 999.0, lambda e: [e, e]),
        ((WARN, 'samples out of order, dropped'),), N_SAMPLES),
    Row('counts out of order', rig.shuffled('counts', 0.0, 999.0),
        ((WARN, 'samples out of order, dropped'),), N_SAMPLES // 2, recovered=300.0),
    Row('counts 20 times as fast', faster(150.0, 160.0, 20),
        ((ERROR, 'samples too fast for their conversion cycle, dropped'),), 3800,
        silent=((151.0, 160.0),), blind=(149.9, 151.0), recovered=165.0),
]  # fmt: skip

TIME_ROWS = [
    Row('a gap of 10 min',
        rig.chain(*(rig.stop(topic, 130, 730) for topic in ('counts', 'board', 'case'))), (), 2300,
        recovered=820.0, source=rig.bag(duration_s=850.0)),
    Row('counts alone pause for 2 min', rig.stop('counts', 80.0, 200.0), (), 2500),
    Row('time jumps back', play_again(100.0),
        ((WARN, 'jumps of time backwards, estimators reset'),), 5000),
    *(
        Row(f'time jumps forward by {word}{where}', rig.shifted(at, by), (), 3995, shift=(at, by),
            recovered=at + 80.0)
        for word, by in (('10 min', 600.0), ('a day', 86400.0))
        for where, at in ((' in the ramp', 90.0), (' in the soak', 220.0))
    ),
    Row('temperatures of another clock',
        lambda events: [(topic, stamp + (topic != 'counts') * 3_600_000_000_000, v)
                        for topic, stamp, v in events],
        ((ERROR, 'no board temperature yet, nothing is published'),
         (WARN, 'temperatures are stamped 36')),
        0, silent=((0.0, 320.0),), recovered=math.inf),
]  # fmt: skip

ROWS = [*sensor_rows('board'), *sensor_rows('case'), *BOTH_ROWS, *SAMPLE_ROWS, *TIME_ROWS]


def true_seconds(row, stamps):
    seconds = (stamps - rig.START_NS) * 1e-9
    at, by = row.shift
    return np.where(seconds >= at + by, seconds - by, seconds)
