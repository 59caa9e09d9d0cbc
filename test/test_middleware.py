# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The node's Fast DDS profile saves wake-ups of a thread; a profile of the user replaces it."""

import json
import os
import select
import signal
import subprocess
import sys
import threading
from pathlib import Path
from subprocess import PIPE

import pytest

pytest.importorskip('rclpy', reason='rclpy is absent: install the extra `ros`')

from builders import calibration
from live_node import lossless
from node_process import NodeProcess
from ros_helpers import Driver, stamp_of, standing
from sensor_msgs.msg import Imu

from thermo_comp.ros.process import LOCAL_PROFILE, PROFILE, VARIABLE, use_profile
from thermo_comp.unit.calibration_file import save_calibration

CYCLE_NS = 10_000_000
N_SAMPLES = 300
#: Number of samples to send before the test fails because the node has not found its peers.
N_TRIED = 5000
OTHER = """\
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <data_reader profile_name="other"/>
</profiles></dds>
"""

#: A program with a reliable and a best-effort subscription, which prints the stamps of each.
RECEIVER = """
import json, select, sys, time
import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

rclpy.init()
node = rclpy.create_node('receiver')
heard = {}


def stamp(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


for reliability in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT):
    stamps = heard[reliability] = []
    qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=reliability)
    hear = lambda message, stamps=stamps: stamps.append(stamp(message))
    node.create_subscription(Imu, 'imu/data_raw', hear, qos)
reliable = heard[ReliabilityPolicy.RELIABLE]
while not all(heard.values()):
    rclpy.spin_once(node)
print('ready', flush=True)
while not select.select([sys.stdin], [], [], 0)[0]:
    rclpy.spin_once(node, timeout_sec=0.01)
last, end = int(sys.stdin.readline()), time.monotonic() + 30.0
while reliable[-1] != last and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps(list(heard.values())), flush=True)
"""


def event_wakes(pid):
    """Return how often the middleware's thread for timed events has been woken so far."""
    tasks = Path(f'/proc/{pid}/task').iterdir()
    (thread,) = (task for task in tasks if (task / 'comm').read_text().startswith('dds.ev'))
    lines = (thread / 'status').read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('voluntary'))


def send(driver, first, last, pause_s):
    pause = threading.Event()
    for k in range(first, last):
        if k % 100 == 0:
            driver.temperatures(k * CYCLE_NS, 20.0, 20.0)
        driver.counts(k * CYCLE_NS, *standing(k))
        pause.wait(pause_s)


@pytest.fixture
def node_arguments(tmp_path):
    unit = tmp_path / 'unit.yaml'
    save_calibration(calibration(), unit)
    return [*lossless(), '-p', f'calibration_file:={unit}']


def wakes_per_sample(peer, drivers, node_arguments):
    """Run the node with a reliable subscriber; return wake-ups of its event thread per sample."""
    with NodeProcess(*node_arguments) as node:
        heard = peer.listen(Imu, 'imu/data_raw')
        # All nodes get the same driver, because a node ignores a topic with two publishers.
        drivers[:] = drivers or [Driver(peer)]
        first = 0
        while not heard:
            assert first < N_TRIED, node.said
            send(drivers[0], first, first + 100, 0.001)
            first += 100
        before, last = event_wakes(node.process.pid), first + N_SAMPLES
        send(drivers[0], first, last, 0.001)
        newest_ns = (last - 1) * CYCLE_NS
        peer.wait_for(lambda: stamp_of(heard[-1]) == newest_ns, 'the last sample')
        return (event_wakes(node.process.pid) - before) / N_SAMPLES


def test_samples_do_not_wake_the_event_thread(peer, node_arguments, tmp_path, monkeypatch):
    # With another Fast DDS profile each sample, or group of them, wakes the node's event thread.
    other = tmp_path / 'other.xml'
    other.write_text(OTHER)
    monkeypatch.setenv(VARIABLE, str(other))
    drivers = []
    by_default = wakes_per_sample(peer, drivers, node_arguments)
    # With the node's profile 700 samples per second wake its event thread 50 times per second.
    monkeypatch.delenv(VARIABLE)
    assert wakes_per_sample(peer, drivers, node_arguments) < 0.5 * by_default


def test_samples_lost_by_dds_are_repeated(peer, node_arguments, monkeypatch):
    # The receiver stops while twice as many samples are sent as its shared memory holds (512).
    monkeypatch.delenv(VARIABLE, raising=False)
    command = [sys.executable, '-c', RECEIVER]
    with (
        NodeProcess(*node_arguments) as node,
        subprocess.Popen(command, stdin=PIPE, stdout=PIPE, text=True) as receiver,
    ):
        driver = Driver(peer)
        first = 0
        while not select.select([receiver.stdout], [], [], 0.0)[0]:
            assert first < N_TRIED, node.said
            send(driver, first, first + 1, 0.01)
            first += 1
        receiver.send_signal(signal.SIGSTOP)
        last = first + 1000
        send(driver, first, last, 0.001)
        receiver.send_signal(signal.SIGCONT)
        print((last - 1) * CYCLE_NS, file=receiver.stdin, flush=True)
        assert receiver.stdout.readline() == 'ready\n'
        reliable, best_effort = json.loads(receiver.stdout.readline())
    # The reliable subscription received all samples in order, the best-effort subscription not.
    assert reliable[-1000:] == [k * CYCLE_NS for k in range(first, last)]
    assert len(set(best_effort) & set(reliable[-1000:])) < 1000


def test_a_dds_profile_set_by_the_user_replaces_that_of_the_node(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, 'mine.xml')
    use_profile()
    assert os.environ[VARIABLE] == 'mine.xml'
    monkeypatch.delenv(VARIABLE)
    (tmp_path / LOCAL_PROFILE).write_text(OTHER)
    use_profile()
    assert VARIABLE not in os.environ
    (tmp_path / LOCAL_PROFILE).unlink()
    use_profile()
    assert os.environ[VARIABLE] == str(PROFILE)
