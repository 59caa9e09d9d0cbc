# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The profile for Fast DDS: it does what it is there for, and one of the user's wins.

"""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')

from builders import calibration
from ros_helpers import Driver, Peer, stamp_of, standing
from sensor_msgs.msg import Imu

from thermo_comp.calibration_file import save_calibration
from thermo_comp.ros.middleware import LOCAL_PROFILE, PROFILE, VARIABLE, use_profile
from thermo_comp.ros.round_trip import NodeProcess, lossless

CYCLE_NS = 10_000_000
N_SAMPLES = 500
OTHER = """\
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <data_reader profile_name="other"/>
</profiles></dds>
"""


def event_wakes(pid: int) -> int:
    """Count how often the thread that holds the middleware's timed events was woken so far."""
    (thread,) = (
        task
        for task in Path(f'/proc/{pid}/task').iterdir()
        if (task / 'comm').read_text().startswith('dds.ev')
    )
    lines = (thread / 'status').read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('voluntary'))


def wakes_per_sample(folder: Path) -> float:
    """Run the node before a reliable subscriber; count the wake-ups of its event thread."""
    unit = folder / 'unit.yaml'
    save_calibration(calibration(), unit)
    peer = Peer()
    try:
        with NodeProcess(*lossless(), '-p', f'calibration_file:={unit}') as node:
            heard = peer.listen(Imu, 'imu/data_raw')
            driver = Driver(peer)
            pause = threading.Event()

            def send(first: int, last: int) -> None:
                for k in range(first, last):
                    stamp_ns = k * CYCLE_NS
                    if k % 100 == 0:
                        driver.temperatures(stamp_ns, 20.0, 20.0)
                    driver.counts(stamp_ns, *standing(k))
                    pause.wait(0.002)
                peer.wait_for(
                    lambda: heard and stamp_of(heard[-1]) == (last - 1) * CYCLE_NS, 'the last one'
                )

            # The first ones may come before the node and the peer know each other.
            send(0, 200)
            before = event_wakes(node.process.pid)
            send(200, 200 + N_SAMPLES)
            return (event_wakes(node.process.pid) - before) / N_SAMPLES
    finally:
        peer.close()


def test_samples_do_not_wake_the_event_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # By default each sample wakes it once at the least, on this platform some four times; with
    # the profile only what is due 50 times a second does, some four times each.
    monkeypatch.delenv(VARIABLE, raising=False)
    assert wakes_per_sample(tmp_path) < 1.0


def test_the_profile_of_the_user_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # WHY: it is the same measurement, so it also shows that the test above can fail.
    other = tmp_path / 'other.xml'
    other.write_text(OTHER)
    monkeypatch.setenv(VARIABLE, str(other))
    assert wakes_per_sample(tmp_path) > 1.0


def test_where_the_profile_comes_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(VARIABLE, raising=False)
    (tmp_path / LOCAL_PROFILE).write_text(OTHER)
    use_profile()
    assert VARIABLE not in os.environ
    (tmp_path / LOCAL_PROFILE).unlink()
    use_profile()
    assert os.environ[VARIABLE] == str(PROFILE)
    monkeypatch.setenv(VARIABLE, '')
    use_profile()
    assert os.environ[VARIABLE] == ''
