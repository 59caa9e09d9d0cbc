# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The node does not use samples of two publishers at a time, and accepts a restarted driver."""

import contextlib
import os
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

import ros_helpers as ros
from builders import calibration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from node_process import OVER_UDP
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, Temperature

from thermo_comp.ros.waitloop import Sources
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import save_calibration


def contested(peer, heard, topic, send):
    """Send by two publishers until the node reports two publishers; return the node's status."""
    text = f'2 publishers on {topic}, the topic is not used until only one of them sends'
    status = ros.status_with(peer, heard, text, send)
    assert status.level == DiagnosticStatus.ERROR
    return status


def test_samples_of_a_second_publisher_are_never_published(peer, unit):
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        samples = ros.Samples(peer, node)
        other = peer.node.create_publisher(Vector3Stamped, 'accel/counts', ros.DEEP)
        peer.poll(other.get_subscription_count, 'the second publisher')

        def both():
            samples.send(1)
            stamp_ns = ros.START_NS + samples.n_sent * ros.CYCLE_NS - 5
            strange = ros.stamped(Vector3Stamped(), stamp_ns)
            strange.vector.x, strange.vector.y = 2000.0 + samples.n_sent % 3, -2000.0
            other.publish(strange)

        status = contested(peer, samples.reports, '/accel/counts', both)
        assert {value.key: value.value for value in status.values}['sample publishers'] == '2'
        peer.node.destroy_publisher(other)
        peer.poll(lambda: node._relay.running.samples.count_publishers() == 1, 'one left')
        # Samples of the driver that has ended may still arrive after its end.
        samples.send(20)
        before = len(samples.heard)
        peer.poll(lambda: (samples.send(1), len(samples.heard) > before)[1], 'samples again')
        assert all(abs(imu.linear_acceleration.x) < 1.0 for imu in samples.heard)
        assert all(ros.stamp_of(imu) % ros.CYCLE_NS == 0 for imu in samples.heard)


#: A driver process sends samples at 100 Hz once it has a subscriber; frame_id is its name.
DRIVER = """
from thermo_comp.text import keep_standard_output
keep_standard_output()
import sys, time, rclpy
from geometry_msgs.msg import Vector3Stamped
from itertools import count
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Temperature
rclpy.init()
node = rclpy.create_node('driver_' + sys.argv[1])
samples = node.create_publisher(Vector3Stamped, 'accel/counts', QoSProfile(depth=5000))
kinds = {n: node.create_publisher(Temperature, 'temperature/' + n, 10) for n in ('board', 'case')}
numbers = count()
def send():
    if not samples.get_subscription_count():
        return
    now, k = time.time_ns(), next(numbers)
    message = Vector3Stamped()
    message.header.frame_id = sys.argv[1]
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
    message.vector.x, message.vector.y, message.vector.z = 30.0 + k % 3, -20.0 + k % 2, 2941.0
    for one in kinds.values() if k % 10 == 0 else ():
        reading = Temperature(header=message.header, temperature=20.0 + 1e-3 * (k % 7))
        one.publish(reading)
    samples.publish(message)
    if not k:
        print(now, flush=True)
node.create_timer(0.01, send)
rclpy.spin(node)
"""


@contextlib.contextmanager
def driver_process(name):
    """Run a driver until the context ends; yield its process and the first sample's stamp [ns]."""
    command, environment = [sys.executable, '-c', DRIVER, name], {**os.environ, **OVER_UDP}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        yield process, int(process.stdout.readline())
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_after_a_driver_was_killed_output_continues_within_two_seconds(peer, unit):
    # WHY: after a driver was killed, the node published nothing for 20 s, until DDS removed it.
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        diagnostics = peer.listen(DiagnosticArray, '/diagnostics')
        heard = peer.listen(Imu, 'imu/data_raw')

        def of(name):
            return [imu for imu in list(heard) if imu.header.frame_id == name]

        with driver_process('first'):
            peer.wait_for(lambda: len(of('first')) > 100, 'samples of the first driver')
        killed = time.monotonic()
        peer.poll(lambda: time.monotonic() - killed > 1.0, 'a second')
        with driver_process('second') as (_, began_ns):
            peer.wait_for(lambda: of('second'), 'samples of the second driver')
            assert node._relay.running.samples.count_publishers() == 2
            assert (ros.stamp_of(of('second')[0]) - began_ns) * 1e-9 < 2.0
            text = '2 publishers on /accel/counts, of which one sends'
            warned = DiagnosticStatus.WARN
            peer.wait_for(
                lambda: any(text in status.message and status.level == warned
                            for array in diagnostics[-5:] for status in array.status[:1]),
                'the warning alone',
            )  # fmt: skip
            peer.wait_for(lambda: len(of('second')) > 100, 'more of the second driver')
        names = [imu.header.frame_id for imu in heard]
        assert names == sorted(names)


def numbered(begin, period_s, until_s, start_s=0.0):
    n = int((until_s - start_s) / period_s)
    return [(start_s + k * period_s, begin + k) for k in range(n)]


@pytest.mark.parametrize('offset', [-7, -1, 0, 1, 2, 1000])
@pytest.mark.parametrize('period_s', [0.01, 0.0101, 0.02, 0.05, 0.9])
def test_two_publishers_that_send_are_never_mixed(offset, period_s):
    first = [(*message, 'own') for message in numbered(500, 0.01, 12.0)]
    begins = 500 + 200 + offset  # first sample number of driver 2; driver 1 is at 700
    other = [(*message, 'other') for message in numbered(begins, period_s, 8.0, start_s=2.003)]
    sources, used = Sources(), []
    for at_s, number, name in sorted(first + other):
        n_known = 2 if at_s > 2.0 else 1
        if not sources.first_of_single_source(n_known, [number], [round(at_s * 1e9)]):
            used.append((at_s, name))
    assert {name for _, name in used} == {'own'}
    # Driver 2 ends at 8 s, and from 10 s on all samples of driver 1 are used.
    assert sum(at_s < 2.0 for at_s, _ in used) >= 199
    assert sum(at_s > 10.0 for at_s, _ in used) >= 199


def test_without_sequence_numbers_samples_of_two_publishers_are_never_used():
    sources = Sources()
    assert sources.first_of_single_source(1, [None] * 3, [0, 1, 2]) == 0
    for k in range(5):
        assert sources.first_of_single_source(2, [None] * 3, [k * ros.SECOND_NS] * 3) == 3
    assert sources.first_of_single_source(1, [None] * 3, [9 * ros.SECOND_NS] * 3) == 3
    assert sources.first_of_single_source(1, [None] * 3, [9 * ros.SECOND_NS] * 3) == 0


def test_readings_of_a_second_publisher_are_not_used(peer, unit):
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        samples = ros.Samples(peer, node)
        other = peer.node.create_publisher(Temperature, 'temperature/board', ros.DEEP)
        peer.poll(other.get_subscription_count, 'the second publisher')

        def both():
            reading = Temperature(temperature=20.5)
            other.publish(ros.stamped(reading, ros.START_NS + samples.n_sent * ros.CYCLE_NS))
            samples.send(10)

        contested(peer, samples.reports, '/temperature/board', both)
        board = node._relay.running.compensator.thermal.tracker.board
        assert board.temperature == pytest.approx(20.0, abs=1e-6)
        assert board.stamp_ns < ros.START_NS + 20 * ros.CYCLE_NS


def test_another_publisher_of_the_output_is_reported(peer, unit):
    # WHY: a filter got the samples of two nodes, or raw samples of a driver, without a warning.
    with ros.node_in_thread(*ros.node_arguments(unit)):
        heard = peer.listen(DiagnosticArray, '/diagnostics')
        other = peer.node.create_publisher(Imu, 'imu/data_raw', ros.DEEP)
        text = '2 publishers on /imu/data_raw, the output of this node: its subscribers'
        ros.status_with(peer, heard, text)
        peer.node.destroy_publisher(other)
        peer.poll(lambda: text not in heard[-1].status[0].message, 'a report without the warning')


def test_a_driver_with_incompatible_qos_or_type_is_named(peer, unit):
    reliable = 'qos_overrides./accel/counts.subscription.reliability:=reliable'
    with ros.node_in_thread(*ros.node_arguments(unit, reliable)):
        heard = peer.listen(DiagnosticArray, '/diagnostics')
        unheard = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        peer.node.create_publisher(Vector3Stamped, 'accel/counts', unheard)
        peer.node.create_publisher(Imu, 'temperature/case', ros.DEEP)
        status = ros.status_with(peer, heard, 'of a publisher on /accel/counts are not received: ')
        assert status.level == DiagnosticStatus.ERROR
        assert 'est effort publisher and reliable subscription' in status.message
        text = 'on /temperature/case are not received: its type is sensor_msgs/msg/Imu'
        ros.status_with(peer, heard, text)


def test_reports_more_frequent_than_samples_report_no_missing_samples(peer, tmp_path):
    slow = tmp_path / 'slow.yaml'
    # An error requires 5 cycles (1.5 s) without a sample; no busy machine pauses for 1.5 s.
    save_calibration(calibration(unit=Unit('T-1', 'counts', 32767.0, 0.3)), slow)
    with ros.node_in_thread(*ros.node_arguments(slow, 'diagnostics_period:=0.01')) as node:
        heard = peer.listen(DiagnosticArray, '/diagnostics')
        driver = ros.drive(peer, node)
        imu = peer.listen(Imu, 'imu/data_raw')
        peer.poll(node._relay.running.samples.count_publishers, 'the driver')
        for k in range(5):
            stamp_ns = ros.START_NS + k * ros.SECOND_NS
            driver.temperatures(stamp_ns, 20.0, 20.0)
            driver.counts(stamp_ns, *ros.standing(k))
            n = len(imu)
            peer.wait_for(lambda n=n: len(imu) > n, 'the sample')
            del heard[:]
            peer.wait_for(lambda: len(heard) > 10, 'reports')
            messages = [array.status[0].message for array in heard[1:10]]
            assert not any('no samples' in text for text in messages), messages
        ros.status_with(peer, heard, 'no samples are coming in')


def test_the_warning_of_a_reading_a_day_ahead_ends(peer, unit):
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        samples = ros.Samples(peer, node)
        samples.driver.temperatures(ros.START_NS + 86_400 * ros.SECOND_NS, 25.0)
        samples.n_sent += 1  # samples alone, without temperature readings
        samples.send(5)
        ros.status_with(peer, samples.reports, 's ahead of the samples')
        samples.go_on()
        reports = samples.reports
        peer.wait_for(lambda: 'ahead' not in reports[-1].status[0].message, 'the warning to end')
