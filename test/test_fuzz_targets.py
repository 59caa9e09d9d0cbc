# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The functions for fuzz tests accept their seeds, also cut off or changed, without a crash."""

import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')


import targets

from thermo_comp.recording.reader import open_recording
from thermo_comp.unit.calibration_file import parse_calibration

TARGETS = targets.targets()


@pytest.mark.parametrize('name', TARGETS)
def test_seeds_cut_off_or_changed_do_not_crash_the_targets(name, rng):
    target = TARGETS[name]
    for seed in target.seeds:
        assert len(seed) <= target.max_length
        target.check(seed)
        for cut in range(0, len(seed), max(1, len(seed) // 10)):
            target.check(seed[:cut])
        for _ in range(10):
            changed = bytearray(seed)
            changed[int(rng.integers(len(seed)))] = int(rng.integers(256))
            target.check(bytes(changed))


def test_fuzz_run_lists_every_target_and_seeds_are_valid_inputs():
    import run

    assert set(run.NAMES) == set(TARGETS)
    assert parse_calibration(TARGETS['calibration'].seeds[0]).unit.serial == 'T'
    for seed in TARGETS['mcap'].seeds:
        targets.BAG.write_bytes(seed)
        with open_recording(targets.BAG, require=()) as reader:
            assert reader.info.truncated is None
            (block,) = reader.blocks()
        assert (len(block), len(block.log_ns['board'])) == (3, 3)
    before = targets.COMPENSATOR.counters.n_out
    TARGETS['cdr'].check(TARGETS['cdr'].seeds[0])
    assert targets.COMPENSATOR.counters.n_out == before + 1
