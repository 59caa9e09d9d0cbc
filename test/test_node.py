# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The node corrects samples, publishes the regime and reports faults over DDS."""

import math
import time
from dataclasses import replace

import pytest
import yaml
from conftest import ROOT

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

import ros_helpers as ros
from builders import calibration, rich_calibration, thermal_calibration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from live_node import lossless
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool

from thermo_comp.thermal.settings import DetectorSettings, ThermometerSettings
from thermo_comp.unit.calibration import Unit, parameter_layout
from thermo_comp.unit.calibration_file import save_calibration
from thermo_comp.unit.nonlinearity import Nonlinearity

BEST_EFFORT = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def saved(tmp_path):
    def save(of, *overrides):
        save_calibration(of, tmp_path / 'unit.yaml')
        return ros.node_arguments(tmp_path / 'unit.yaml', *overrides)

    return save


def diagnosis(peer):
    """Return a function that waits for diagnostics whose status and values meet a condition."""
    heard = peer.listen(DiagnosticArray, '/diagnostics')

    def wait(condition):
        collected = []

        def look():
            for array in heard:
                values = {value.key: value.value for value in array.status[0].values}
                if condition(array.status[0], values):
                    collected.append((array, array.status[0], values))
            return bool(collected)

        peer.wait_for(look, f'the diagnosis among {[a.status[0].message for a in heard][-3:]}')
        heard.clear()
        return collected[0]

    return wait


def test_the_node_takes_imu_input_and_can_switch_to_counts(peer, saved):
    unit = replace(calibration(), unit=Unit('T-1', 'm/s^2', 160.0, 0.01))
    with ros.node_in_thread(*saved(unit, 'input:=imu', 'frame_id:=body')) as node:
        heard = peer.listen(Imu, 'imu/data_raw')
        driver = ros.drive(peer, node, Imu, 'imu/uncompensated')
        driver.temperatures(ros.START_NS, 20.0, 20.0)
        sent = ros.stamped(Imu(), ros.START_NS + 1, 'sensor')
        sent.angular_velocity.y = 0.125
        sent.orientation.x = 0.5
        sent.orientation_covariance[0] = 7.0
        sent.linear_acceleration.z = 3000.0 / 300.0 * 12.0
        driver.imu(sent)
        peer.wait_for(lambda: heard, 'the sample')
        assert heard[0].header.frame_id == 'body'
        assert heard[0].angular_velocity == sent.angular_velocity
        assert heard[0].orientation == sent.orientation
        assert heard[0].orientation_covariance.tolist() == sent.orientation_covariance.tolist()
        assert heard[0].linear_acceleration.z == pytest.approx(0.4, rel=1e-12)
        assert 'unit.input: must be' in peer.set_atomically(input='counts').reason
        file = saved(calibration())[1].removeprefix('calibration_file:=')
        both = peer.set_atomically(input='counts', frame_id='', calibration_file=file)
        assert both.successful, both.reason
        vectors = peer.publisher(Vector3Stamped, 'accel/counts')
        peer.join(node)
        message = ros.stamped(Vector3Stamped(), ros.START_NS + 2, 'vector')
        message.vector.x = 150.0
        vectors.publish(message)
        peer.wait_for(lambda: len(heard) == 2, 'the vector')
        assert heard[1].header.frame_id == 'vector'
        assert heard[1].linear_acceleration.x == pytest.approx(0.5, rel=1e-12)


def test_the_regime_flag_is_latched_and_not_published_while_unknown(peer, saved):
    with ros.node_in_thread(*saved(calibration()), *lossless()) as node:
        heard = peer.listen(Imu, 'imu/data_raw')
        flags = peer.listen(Bool, 'regime/dynamic')
        stamped_flags = peer.listen(DiagnosticArray, 'regime/stamped')
        wait = diagnosis(peer)
        driver = ros.drive(peer, node)
        driver.temperatures(ros.START_NS, 20.0, 20.0)
        driver.counts(ros.START_NS + 1, 1.0, 2.0, 3.0)
        _, status, values = wait(lambda _, values: values['samples out'] == '1')
        assert (status.level, values['regime']) == (DiagnosticStatus.OK, 'unknown')
        assert not flags
        n = 0
        while not flags and n < 4000:
            for _ in range(120):
                n += 1
                driver.temperatures(ros.START_NS + n * ros.SECOND_NS, 20.0, 20.0)
                driver.counts(ros.START_NS + n * ros.SECOND_NS, *ros.standing(n))
            peer.wait_for(lambda n=n: len(heard) == n + 1, 'the samples')
        peer.wait_for(lambda: flags, 'the flag')
        assert not flags[-1].data
        late = peer.listen(Bool, 'regime/dynamic', LATCHED)
        peer.wait_for(lambda: late, 'the latched flag')
        assert not late[0].data
        # `regime/stamped` has the stamp of the deciding reading, and is latched, too.
        latched = peer.listen(DiagnosticArray, 'regime/stamped', LATCHED)
        peer.wait_for(lambda: latched and len(stamped_flags) == len(flags), 'the stamped flags')
        last_ns = ros.stamp_of(stamped_flags[-1])
        peer.wait_for(lambda: ros.stamp_of(latched[-1]) == last_ns, 'the last stamped flag')
        for array in (*stamped_flags, *latched):
            (status,) = array.status
            assert (status.message, status.hardware_id) == ('static', 'T-1')
            assert (ros.stamp_of(array) - ros.START_NS) % ros.SECOND_NS == 0
        stamps = [ros.stamp_of(array) for array in stamped_flags]
        assert stamps == sorted(set(stamps))
        assert stamps[-1] <= ros.START_NS + n * ros.SECOND_NS


def test_diagnostics_name_faults_of_samples(peer, saved):
    wait = diagnosis(peer)
    with ros.node_in_thread(*saved(thermal_calibration())) as node:
        heard = peer.listen(Imu, 'imu/data_raw')
        begin_ns = time.time_ns()
        array, status, values = wait(lambda s, _: 'no board temperature' in s.message)
        assert status.level == DiagnosticStatus.ERROR
        assert (status.name, status.hardware_id) == ('/thermo_comp: compensation', 'T-1')
        assert begin_ns - ros.SECOND_NS < ros.stamp_of(array) <= time.time_ns()
        assert values['sample stamp [ns]'] == 'none'
        driver = ros.drive(peer, node)
        stamp_ns = ros.START_NS
        driver.temperatures(stamp_ns, 20.0, 20.0)
        nan = float('nan')
        bad = [(nan, 0.0, 0.0), (32767.0, 0.0, 0.0), (0.0, -32768.0, 0.0), (1.0, 2.0, 3.0)]
        for x, y, z in bad:
            stamp_ns += ros.CYCLE_NS
            driver.counts(stamp_ns, x, y, z)
        _, status, values = wait(lambda _, values: values['saturated'] == '2')
        assert status.level == DiagnosticStatus.ERROR
        assert 'samples saturated (full scale 32767), dropped: 2' in status.message
        assert 'samples not finite, dropped: 1' in status.message
        assert (values['samples in'], values['samples out']) == ('4', '1')
        assert values['sample stamp [ns]'] == str(stamp_ns)
        assert [m.linear_acceleration.x for m in heard] == [1.0 / 300.0]
        wait(lambda s, _: 'no samples are coming in' in s.message and 'sat' not in s.message)
        driver.temperatures(stamp_ns, 40.0, 40.0)
        driver.counts(stamp_ns + ros.CYCLE_NS, 1.0, 2.0, 3.0)
        # A stamp that falls by up to 1 s is out of order; a fall by more is a jump of time.
        driver.counts(stamp_ns - 5, 1.0, 2.0, 3.0)
        _, status, _ = wait(lambda s, _: 'out of order' in s.message)
        driver.counts(ros.START_NS - 10 * ros.SECOND_NS, 1.0, 2.0, 3.0)
        wait(lambda s, _: 'jumps of time backwards, estimators reset: 1' in s.message)


def test_diagnostics_contain_noise_density_and_bias_sd(peer, saved):
    wait, unit = diagnosis(peer), rich_calibration()
    with ros.node_in_thread(*saved(unit)) as node:
        driver = ros.drive(peer, node)
        driver.temperatures(ros.START_NS, 20.0, 20.0)
        driver.counts(ros.START_NS + 1, *ros.standing(0))
        _, _, values = wait(lambda _, values: values['samples out'] == '1')
        for axis in 'xyz':
            density = float(values[f'noise density {axis} [m/s^2/sqrt(Hz)]'])
            whole, bias = (float(values[f'{name} {axis} [m/s^2]']) for name in ('sd', 'bias sd'))
            assert density == unit.noise_density_m_s2_sqrt_hz['xyz'.index(axis)]
            counts = getattr(unit.axes, axis).scale_factor
            noise = density**2 / unit.unit.cycle_time_s + 1.0 / 6.0 / counts**2
            assert whole**2 == pytest.approx(bias**2 + noise, rel=1e-2)
            assert bias > 0.0
            layout, covariance = parameter_layout(unit), unit.posterior.covariance()
            level = layout.scale['xyz'.index(axis)].static
            assert float(values[f'scale sd {axis}']) >= 0.99 * math.sqrt(covariance[level, level])
            of_rate = float(values[f'noise density of rate {axis} [rad/s/sqrt(Hz)]'])
            assert of_rate == unit.gyroscope.noise_density_rad_s_sqrt_hz['xyz'.index(axis)]
            # In an unknown regime the bias sd contains the regimes' bias difference, 30 urad/s.
            assert 1e-5 < float(values[f'bias sd of rate {axis} [rad/s]']) < 1e-3


@pytest.mark.parametrize('was_fitted_with_case', [False, True])
def test_a_missing_case_is_reported_only_if_the_fit_had_a_case(peer, saved, was_fitted_with_case):
    case = {'case': ThermometerSettings(noise_sd_c=0.05)} if was_fitted_with_case else {}
    unit = replace(thermal_calibration(), detector=DetectorSettings(**case))
    wait = diagnosis(peer)
    with ros.node_in_thread(*saved(unit)) as node:
        driver = ros.drive(peer, node)
        driver.temperatures(ros.START_NS, 20.0)
        driver.counts(ros.START_NS, *ros.standing(0))
        _, status, values = wait(lambda _, values: values['samples out'] == '1')
        assert ('case temperature lost' in status.message) == was_fitted_with_case
        assert values['case age [s]'] == 'inf'


def test_diagnostics_name_faults_of_temperatures(peer, saved):
    wait = diagnosis(peer)
    # The nonlinear terms of this unit were fitted to forces below 1 g.
    unit = replace(thermal_calibration(), nonlinearity=Nonlinearity((1.0, 5.0), 1e-4))
    with ros.node_in_thread(*saved(unit, 'temperature_timeout:=20', 'case_timeout:=10')) as node:
        driver = ros.drive(peer, node)
        for k in range(5):
            driver.temperatures(ros.START_NS + k * ros.SECOND_NS, 50.0, 50.0)
            driver.counts(ros.START_NS + k * ros.SECOND_NS, *ros.standing(k))
        _, status, values = wait(lambda _, values: values['samples out'] == '5')
        assert 'board temperature +15' in status.message
        assert 'above the largest |f| of the fit' in status.message
        assert float(values['force excess [m/s^2]']) == pytest.approx(4.81, abs=0.02)
        assert 'calibrated range: curves continued along their tangent' in status.message
        assert float(values['temperature excess [K]']) == pytest.approx(15.0, abs=0.1)
        assert values['board temperature [degC]'].startswith('50.0')
        assert float(values['sd x [m/s^2]']) > 0.0
        driver.temperatures(ros.START_NS + 15 * ros.SECOND_NS, 50.0)
        driver.counts(ros.START_NS + 15 * ros.SECOND_NS, *ros.standing(15))
        _, status, _ = wait(lambda s, _: 'case temperature lost' in s.message)
        driver.counts(ros.START_NS + 30 * ros.SECOND_NS, *ros.standing(30))
        wait(lambda s, _: 'board temperature 15.0 s old, but still' in s.message)
        driver.counts(ros.START_NS + 40 * ros.SECOND_NS, *ros.standing(40))
        _, status, values = wait(lambda s, _: '25.0 s old, nothing is published' in s.message)
        assert (status.level, values['stale']) == (DiagnosticStatus.ERROR, '1')


def test_a_node_with_constants_needs_no_thermometer(peer, saved):
    wait = diagnosis(peer)
    with ros.node_in_thread(*saved(calibration())) as node:
        heard = peer.listen(Imu, 'imu/data_raw')
        driver = ros.drive(peer, node)
        for k in range(20):
            driver.counts(ros.START_NS + k * ros.CYCLE_NS, *ros.standing(k))
        _, status, values = wait(lambda _, values: values['samples out'] == '20')
        peer.wait_for(lambda: len(heard) == 20)
    # The samples are sent without pauses, so the report may warn of a wrong sample rate.
    assert 'not corrected for temperature' in status.message or 'samples/s' in status.message
    assert status.level != DiagnosticStatus.ERROR
    assert (values['board age [s]'], values['board temperature sd [K]']) == ('inf', '10.0000')


def test_the_sample_rate_is_compared_with_the_calibrated_rate(peer, saved):
    wait = diagnosis(peer)
    with ros.node_in_thread(*saved(calibration())) as node:
        driver = ros.drive(peer, node)
        driver.temperatures(ros.START_NS, 20.0, 20.0)
        for k in range(100):
            driver.counts(ros.START_NS + 2 * k * ros.CYCLE_NS, *ros.standing(k))
            if k == 49:
                wait(lambda _, values: values['samples in'] == '50')
        _, _, values = wait(lambda s, _: 'calibrated for 100' in s.message)
        assert float(values['sample rate [Hz]']) == pytest.approx(50.0, rel=0.1)


def test_the_node_connects_to_best_effort_peers(peer, saved):
    with ros.node_in_thread(*saved(calibration())) as node:
        heard = peer.listen(Imu, 'imu/data_raw', BEST_EFFORT)
        driver = ros.drive(peer, node, qos=BEST_EFFORT)
        driver.temperatures(ros.START_NS, 20.0)
        driver.counts(ros.START_NS, *ros.standing(0))
        peer.wait_for(lambda: heard, 'the sample')


def test_the_node_uses_the_namespace_and_remapped_topics(peer, saved):
    args = ['-r', '__ns:=/imu0', '-r', 'accel/counts:=/adc/raw', '-r', 'imu/data_raw:=imu/clean']
    with ros.node_in_thread(*saved(calibration()), *args) as node:
        topics = dict(node.node.get_topic_names_and_types())
        named = {'/adc/raw', '/imu0/imu/clean', '/imu0/temperature/board', '/diagnostics'}
        assert named <= set(topics)
        assert '/accel/counts' not in topics
        names = {name for name, _ in node.node.get_service_names_and_types()}
        assert '/imu0/thermo_comp/set_parameters' in names
        # A group of the diagnostic aggregator has the diagnostics of all nodes, also of /imu0.
        _, status, _ = diagnosis(peer)(lambda *_: True)
        assert status.name == '/imu0/thermo_comp: compensation'
        config = ROOT / 'config' / 'diagnostic_aggregator.yaml'
        group = yaml.safe_load(config.read_text())['/**']['ros__parameters']['thermo_comp']
        assert any(word in status.name for word in group['contains'])
