# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Contains the cases with recordings of the benchmark `strangers.py`: the sample bags, with and
without the case thermometer, and a recording of a real unit, published with another package.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from strangers_cases import Study
from strangers_units import GRAVITY, Bag

import thermo_comp
from thermo_comp.recording.reader import read_recording

ROOT = Path(__file__).resolve().parent.parent
#: Length of the blocks into which the recording of the real unit is cut, and of the means whose
#: steps separate rests [s].
BLOCK_S, MINUTE_S = 10800.0, 60
#: Largest change of the mean from one minute to the next at rest [m/s^2]. When the real unit was
#: carried from one room to another its bias changed by 0.1 m/s^2 in a minute.
STEP = 0.15
#: Length of the shortest rest [min]; a shorter stay in one attitude counts as handling.
LEAST_MINUTES = 4


def sample_bag(path: Path) -> Bag:
    """Read a sample bag; its metadata hold the true attitude."""
    columns = thermo_comp.read(path)
    truth = json.loads(read_recording(path, None, require=['accel']).info.metadata['truth'])
    force = GRAVITY * np.array(truth['up'])
    return Bag(path.stem, columns.time_s, columns.counts, columns.temperatures, force)


def samples(which: str) -> Iterator[Study]:
    """Yield the sample bags with both thermometers, the board's alone, or the board's twice."""
    bags = [sample_bag(path) for path in sorted((ROOT / 'bags/fit').glob('*.mcap'))]
    bags.append(sample_bag(ROOT / 'bags/held_out.mcap'))
    if which != 'sample-bags':
        boards = [bag.temperatures['board'] for bag in bags]
        kept = ['board'] if which == 'no-case' else ['board', 'case']
        bags = [
            replace(bag, temperatures=dict.fromkeys(kept, board))
            for bag, board in zip(bags, boards, strict=True)
        ]
    yield Study('', tuple(bags[:-1]), {'': tuple(bags[-1:])})


def real_unit(path: Path) -> Bag:
    """Read the recording of the real unit: 74 h at 1 Hz, m/s^2, one thermometer."""
    import h5py

    with h5py.File(path) as file:
        force = file['acceleration'][:]
        celsius = file['temperature'][:]
    # The times in the file are rounded to whole seconds: use the sample's number as time.
    time_s = np.arange(1.0, len(force) + 1.0)
    return Bag('cats', time_s, force, {'board': (time_s, celsius)})


def rests_of(bag: Bag) -> list[slice]:
    """Return the rows of each rest: a long stay in one attitude, in whole minutes."""
    n = len(bag.time_s) // MINUTE_S
    mean = bag.samples[: n * MINUTE_S].reshape(n, MINUTE_S, 3).mean(axis=1)
    is_step = np.abs(np.diff(mean, axis=0)).max(axis=1) > STEP
    edges = np.concatenate(([0], np.flatnonzero(is_step) + 1, [n]))
    # Leave out the first and the last minute, in which the unit is carried.
    return [
        slice((first + 1) * MINUTE_S, (last - 1) * MINUTE_S)
        for first, last in pairwise(edges)
        if last - first >= LEAST_MINUTES + 2
    ]


def part(bag: Bag, rows: slice, name: str) -> Bag:
    """Cut rows out of a recording in which each sample has readings of the thermometers."""
    temperatures = {key: (t[rows], v[rows]) for key, (t, v) in bag.temperatures.items()}
    return Bag(name, bag.time_s[rows], bag.samples[rows], temperatures)


def blocks_of(bag: Bag, name: str) -> dict[int, Bag]:
    """Cut a recording, or a rest of it, at multiples of `BLOCK_S`; leave out short blocks."""
    number = (bag.time_s // BLOCK_S).astype(int)
    edges = np.flatnonzero(np.diff(number, prepend=-1, append=-1)).tolist()
    return {
        int(number[first]): part(bag, slice(first, last), f'{name}-{number[first]}')
        for first, last in pairwise(edges)
        if last - first >= LEAST_MINUTES * MINUTE_S
    }


def cats(path: Path) -> Iterator[Study]:
    """Hold out the real unit's rests: all in odd blocks, all in even blocks, then each alone."""
    whole = real_unit(path)
    rests = [part(whole, rows, f'rest{k}') for k, rows in enumerate(rests_of(whole))]
    still: tuple[list[Bag], list[Bag]] = ([], [])
    for rest in rests:
        for number, bag in blocks_of(rest, rest.name).items():
            still[number % 2].append(bag)
    blocks = blocks_of(whole, 'block')
    options = {'input': 'm/s^2'}
    for parity, name in enumerate(('even to odd', 'odd to even')):
        tests = {'': tuple(still[1 - parity])}
        bags = tuple(bag for number, bag in blocks.items() if number % 2 == parity)
        yield Study(name, bags, tests, options, baseline_bags=tuple(still[parity]))
    for k, rest in enumerate(rests):
        others = tuple(rests[:k] + rests[k + 1 :])
        yield Study('rests left out', others, {'': (rest,)}, options)
