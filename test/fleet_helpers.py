# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns small fleets of units that are quick to simulate (10 ms) and to fit (0.5 s)."""

from thermo_comp.fitting import FitOptions
from thermo_comp.fleet.work import FleetOptions
from thermo_comp.recording.writer import BagWriter
from thermo_comp.simulation.campaign import parse_cyclogram, positions
from thermo_comp.simulation.presets import unit_preset as preset
from thermo_comp.simulation.run import simulate
from thermo_comp.unit.gravity import STANDARD_GRAVITY

#: Program of 33 min with ramps of 5 K/min; the board temperature covers 36 K.
PROGRAM = parse_cyclogram('20 2min, 45@5 8min, 5@5 10min')
#: Fit options of tests that do not depend on the model: the model `golovach` is the fastest.
OPTIONS = FleetOptions(FitOptions(gravity=STANDARD_GRAVITY, model='golovach'), certificates=False)


def write_unit(folder, seed, n_bags=6, *, unit=None, names=None, is_exchanged=False, **options):
    """
    Simulate a test with a bag per position; `is_exchanged` exchanges the thermometers. `options`:
    `serial` and further `metadata` of the bags, and `counts`, the topic of the samples.
    """
    unit = unit or preset('mems', seed)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, up in enumerate(positions(n_bags, 1)):
        run = simulate(
            unit, PROGRAM, up, rate_hz=1.0, temperature_rate_hz=0.5, seed=1000 * seed + number,
            start_ns=1_767_225_600_000_000_000,
        )  # fmt: skip
        path = folder / (names[number] if names else f'{number + 1:02d}.mcap')
        facts = {'serial': options.get('serial', unit.serial), **options.get('metadata', {})}
        with BagWriter(path, metadata={k: v for k, v in facts.items() if v}) as bag:
            board, case = ('case', 'board') if is_exchanged else ('board', 'case')
            bag.write_temperature(f'temperature/{board}', run.board_stamp_ns, run.board)
            bag.write_temperature(f'temperature/{case}', run.case_stamp_ns, run.case)
            topic = options.get('counts', 'accel/counts')
            bag.write_counts(topic, run.accel_stamp_ns, run.counts.astype(float), 'imu_link')
        paths.append(path)
    return paths


def damage(path):
    """Overwrite 64 bytes at a third of the length of a bag, to simulate a damaged disk."""
    content = bytearray(path.read_bytes())
    middle = len(content) // 3
    content[middle : middle + 64] = bytes(64)
    path.write_bytes(content)
