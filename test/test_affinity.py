# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The core that the node keeps to: all its threads, while it runs, and only one that is there.

"""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')
if not hasattr(os, 'sched_setaffinity'):
    pytest.skip('this system knows no affinities', allow_module_level=True)

from builders import calibration
from ros_helpers import Peer

from thermo_comp.ros.affinity import ANY, Affinity, AffinityError
from thermo_comp.ros.round_trip import NodeProcess
from thermo_comp.unit.calibration_file import save_calibration

ALLOWED = os.sched_getaffinity(0)
CORE = max(ALLOWED)


def cores(pid: int) -> list[set[int]]:
    """List what cores each thread of a process may use."""
    return [os.sched_getaffinity(int(task.name)) for task in Path(f'/proc/{pid}/task').iterdir()]


def test_the_node_keeps_to_a_core_and_comes_back(tmp_path: Path) -> None:
    unit = tmp_path / 'unit.yaml'
    save_calibration(calibration(), unit)
    peer = Peer()
    with NodeProcess('-p', f'calibration_file:={unit}', '-p', f'cpu_affinity:={CORE}') as node:
        # Whoever answers is up.
        (told,) = peer.describe('cpu_affinity')
        assert (told.integer_range[0].from_value, told.integer_range[0].to_value) == (-1, 4095)
        found = cores(node.process.pid)
        assert len(found) > 3  # the middleware's, too
        assert all(one == {CORE} for one in found)
        (refused,) = peer.set_parameters(cpu_affinity=4000)
        assert not refused.successful
        assert 'core 4000 is not among those that this process may use: ' in refused.reason
        assert all(one == {CORE} for one in cores(node.process.pid))
        (done,) = peer.set_parameters(cpu_affinity=ANY)
        assert done.successful
        assert all(one == ALLOWED for one in cores(node.process.pid))
    peer.close()


def test_a_thread_of_later_has_the_core_too() -> None:
    affinity = Affinity()
    try:
        affinity.keep_to(CORE)
        found: list[set[int]] = []
        thread = threading.Thread(target=lambda: found.append(os.sched_getaffinity(0)))
        thread.start()
        thread.join()
        assert found == [{CORE}]
    finally:
        affinity.keep_to(ANY)
    assert os.sched_getaffinity(0) == ALLOWED


def test_what_the_system_refuses_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_thread: int, _cores: set[int]) -> None:
        raise OSError(errno.EINVAL, 'Invalid argument')

    affinity = Affinity()
    monkeypatch.setattr(os, 'sched_setaffinity', refuse)
    with pytest.raises(AffinityError, match=rf'`cpu_affinity`: core {CORE}: .*Invalid argument'):
        affinity.keep_to(CORE)


def test_a_system_without_affinities_has_no_core_to_keep_to(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(os, 'sched_getaffinity')
    affinity = Affinity()
    affinity.keep_to(ANY)
    with pytest.raises(AffinityError, match=r'core 0 is not among those that .*none that'):
        affinity.check(0)
