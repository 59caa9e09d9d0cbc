# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Wrong clocks, many clients or hostile data give no wrong output; the SROS 2 policy is right."""

import itertools
import random
import signal
import sys
import threading
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from builders import START_NS, calibration
from conftest import ROOT, ran

from thermo_comp.errors import CalibrationError, RecordingError
from thermo_comp.recording.reader import inspect_recording
from thermo_comp.recording.writer import BagWriter
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import load_calibration, save_calibration


def saved(path, serial='T-1'):
    save_calibration(calibration(unit=Unit(serial, 'counts', 32767.0, 0.01)), path)
    return path


def test_a_clock_topic_that_goes_back_or_pauses_does_not_change_samples(peer, tmp_path):
    from ros_helpers import Samples, node_arguments, node_in_thread, stamp_of
    from rosgraph_msgs.msg import Clock

    with node_in_thread(*node_arguments(saved(tmp_path / 'unit.yaml'))) as node:
        samples = Samples(peer, node)
        assert peer.set_parameters(use_sim_time=True)[0].successful
        clock = peer.publisher(Clock, '/clock')
        hour = 3600 * 10**9
        times = [START_NS, START_NS + hour, START_NS, *[START_NS] * 5, START_NS + 8760 * hour]
        for now_ns in times:
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
            clock.publish(message)
            samples.go_on()
            peer.wait_for(
                lambda now_ns=now_ns: samples.reports and stamp_of(samples.reports[-1]) == now_ns,
                'its time in reports',
            )
        assert peer.set_parameters(use_sim_time=False)[0].successful
        peer.wait_for(lambda: stamp_of(samples.reports[-1]) not in times, 'the time of day')
        stamps = [stamp_of(imu) for imu in samples.heard]
        assert stamps == [START_NS + k * 10**7 for k in range(20 + 20 * len(times))]
        assert node._loop.n_failures == 0


def test_twenty_clients_that_set_parameters_at_once_are_all_answered(peer, tmp_path):
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    from ros_helpers import node_in_thread

    paths = [saved(tmp_path / f'{k}.yaml') for k in range(3)]
    with node_in_thread('-p', f'calibration_file:={paths[0]}') as node:
        name = 'thermo_comp/set_parameters'
        clients = [peer.node.create_client(SetParameters, name) for _ in range(20)]
        for client in clients:
            assert client.wait_for_service(30.0)
        rng = random.Random(7)
        values = {
            'calibration_file': [str(path) for path in (*paths, tmp_path / 'none')],
            'frame_id': ['a', 'b', 'x' * 300], 'transition_time': [0.0, 5.0, -1.0],
            'diagnostics_period': [0.05, 1.0], 'input': ['imu', 'counts'],
        }  # fmt: skip
        choices = [(name, value) for name, some in values.items() for value in some]
        asked = []
        for _ in range(6):
            for client in clients:
                given = dict(rng.choices(choices, k=3))
                messages = [Parameter(k, value=v).to_parameter_msg() for k, v in given.items()]
                request = SetParameters.Request(parameters=messages)
                asked.append((given, client.call_async(request)))
            peer.poll(lambda: all(future.done() for _, future in asked), 'all answers')
        for given, future in asked:
            results = future.result().results
            assert len(results) == len(given)
            for (key, value), result in zip(given.items(), results, strict=True):
                is_good = value not in (str(tmp_path / 'none'), 'x' * 300, -1.0, 'imu')
                assert result.successful == is_good or 'too many' in result.reason, (key, value)
        config = node._relay.running.config
        for key in ('calibration_file', 'frame_id', 'transition_time', 'diagnostics_period'):
            assert node.node.get_parameter(key).value == getattr(config, key)
        assert node._relay.running.loaded.path == config.calibration_file
        assert node._loop.n_failures == 0


def test_a_link_that_replaces_a_folder_gives_no_calibration_from_another_folder(tmp_path):
    pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')
    from thermo_comp.ros.reader import read

    folder, outside = tmp_path / 'units', tmp_path / 'outside'
    for place, serial in ((folder / 'real', 'inside'), (outside, 'outside')):
        place.mkdir(parents=True)
        saved(place / 'unit.yaml', serial)
    door, link = folder / 'door', folder / 'link'
    (folder / 'real').rename(door)
    link.symlink_to(outside)
    is_over = threading.Event()

    def swap():
        while not is_over.is_set():
            for source, target in ((door, folder / 'real'), (link, door)):
                source.rename(target)
            for source, target in ((door, link), (folder / 'real', door)):
                source.rename(target)

    thread = threading.Thread(target=swap)
    thread.start()
    serials, refusals = set(), set()
    try:
        for _ in range(400):
            try:
                serials.add(read(f'{door}/unit.yaml', str(folder)).calibration.unit.serial)
            except CalibrationError as error:  # noqa: PERF203
                refusals.add(str(error).partition(': ')[2])
    finally:
        is_over.set()
        thread.join()
    assert serials <= {'inside'}
    known = ('calibration_directory', 'No such file', 'Not a directory', 'Invalid argument')
    assert [refusal for refusal in refusals if not any(text in refusal for text in known)] == []


SAVING = """
import os, signal, sys
from thermo_comp.unit.calibration_file import load_calibration, save_calibration
new, target = load_calibration(sys.argv[1]), sys.argv[2]
n = 0
def trace(frame, event, _):
    global n
    if not frame.f_code.co_filename.endswith('thermo_comp/files.py'):
        return None if event == 'call' and 'thermo_comp' not in frame.f_code.co_filename else trace
    n += event == 'line'
    if n == at:
        os.kill(os.getpid(), signal.SIGKILL)
    return trace
for at in range(1, 1000):
    n, child = 0, os.fork()
    if not child:
        sys.settrace(trace)
        save_calibration(new, target)
        os._exit(0)
    ended = os.waitpid(child, 0)[1]
    found = load_calibration(target).unit.serial
    print(ended, found, flush=True)
    if not ended:
        break
    save_calibration(load_calibration(sys.argv[3]), target)
"""


@pytest.mark.slow
def test_a_write_killed_at_any_line_leaves_the_old_or_the_new_calibration(tmp_path):
    old, new, target = (tmp_path / f'{name}.yaml' for name in ('old', 'new', 'unit'))
    for path, serial in ((old, 'old'), (new, 'new'), (target, 'old')):
        saved(path, serial)
    done = ran(sys.executable, '-c', SAVING, new, target, old, check=True)
    *killed, last = [line.split() for line in done.stdout.splitlines()]
    assert last == ['0', 'new']
    assert len(killed) > 30
    assert {code for code, _ in killed} == {str(signal.SIGKILL.value)}
    assert [name for name, _ in itertools.groupby(name for _, name in killed)] == ['old', 'new']
    assert load_calibration(target).unit.serial == 'new'


@pytest.mark.parametrize('kind', ['ulog', 'dataflash'])
def test_damaged_autopilot_logs_are_read_or_refused_with_one_line(kind, tmp_path):
    pytest.importorskip('pyulog' if kind == 'ulog' else 'pymavlink')
    from thermo_comp.convert.autopilot import read_autopilot
    from thermo_comp.convert.log import write_log

    rng = np.random.default_rng(11)
    path = tmp_path / f'log.{"ulg" if kind == "ulog" else "bin"}'
    if kind == 'ulog':
        from test_convert_ulog import write_two_imus as write
    else:
        from test_convert_dataflash import write_new as write
    write(path, rng)
    good = path.read_bytes()
    n_read, lines = 0, []
    for number in range(150):
        data = bytearray(good[:6000])
        for _ in range(rng.integers(1, 9)):
            at = int(rng.integers(0, 900 if number % 2 else len(data)))
            cut = int(rng.integers(0, 9))
            data[at : at + cut] = rng.bytes(int(rng.integers(0, 9)))
        path.write_bytes(bytes(data))
        try:
            write_log(read_autopilot(path), tmp_path / f'{number}.mcap')
            n_read += 1
        except RecordingError as error:
            lines.append(str(error))
    assert n_read < 150
    assert not any('\n' in text for text in lines)


NODE = 'thermo_comp'


def test_the_policy_permits_exactly_the_topics_and_services_of_the_node(tmp_path):
    pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')
    from ros_helpers import node_in_thread

    opened = {'publish': set(), 'subscribe': set(), 'reply': set()}
    for word in ('counts', 'imu'):
        path = tmp_path / f'{word}.yaml'
        unit = Unit('T-1', 'm/s^2', 160.0, 0.01)
        save_calibration(calibration(unit=unit) if word == 'imu' else calibration(), path)
        arguments = ['-p', f'calibration_file:={path}', '-p', f'input:={word}']
        with node_in_thread(*arguments) as node:
            ros = node.node
            for what, names in (
                ('publish', ros.get_publisher_names_and_types_by_node(NODE, '/')),
                ('subscribe', ros.get_subscriber_names_and_types_by_node(NODE, '/')),
                ('reply', ros.get_service_names_and_types_by_node(NODE, '/')),
            ):
                opened[what] |= {name for name, _ in names}
            assert ros.get_client_names_and_types_by_node(NODE, '/') == []
    root = ET.parse(ROOT / 'config' / 'policy.xml').getroot()  # noqa: S314 - our own file
    (profile,) = root.iter('profile')
    assert (profile.get('ns'), profile.get('node')) == ('/', NODE)
    allowed = {}
    for group in profile:
        ((what, verdict),) = group.attrib.items()
        assert verdict == 'ALLOW'
        names = [(entry.text or '').replace('~', f'/{NODE}') for entry in group]
        allowed[what] = {name if name.startswith('/') else f'/{name}' for name in names}
    assert opened == allowed


BOMB = '\n'.join(
    ['a0: &a0 {k: v}']
    + [f'a{k}: &a{k} {{<<: [{", ".join([f"*a{k - 1}"] * 9)}]}}' for k in range(1, 30)]
)


def one_reading(path):
    with BagWriter(path) as writer:
        writer.write_temperature('temperature/board', [1], [20.0])
    return path


def test_metadata_of_a_bag_expand_to_nothing_and_open_no_file_outside_its_folder(tmp_path):
    # WHY: each line refers to the line before nine times: 30 lines of YAML give 10^28 entries.
    secret, bag = one_reading(tmp_path / 'secret.mcap'), one_reading(tmp_path / 'bag')
    metadata = bag / 'metadata.yaml'
    right = metadata.read_text()
    metadata.write_text(f'{right}\n{BOMB}\n')
    with pytest.raises(RecordingError, match='not valid YAML'):
        inspect_recording(bag)
    (name,) = (file.name for file in bag.glob('*.mcap'))
    for elsewhere in (str(secret), '../secret.mcap'):
        changed = right.replace(f'- {name}', f'- {elsewhere}', 1)
        assert elsewhere in changed
        metadata.write_text(changed)
        with pytest.raises(RecordingError, match=r'secret\.mcap of the bag is missing'):
            inspect_recording(bag)
