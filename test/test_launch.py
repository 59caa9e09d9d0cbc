# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Arguments, executables, parameters and topics in the launch files exist."""

import configparser
import re
import xml.etree.ElementTree as ET

import pytest
from conftest import ROOT

from thermo_comp.topics import INPUTS, OUTPUTS

FILES = sorted((ROOT / 'launch').glob('*.launch.xml'))
OURS = ROOT / 'launch' / 'thermo_comp.launch.xml'
BESIDE = ROOT / 'launch' / 'beside_ins.launch.xml'

# Parameters of nodes of other packages in ROS Jazzy: ROS silently ignores misspelt parameters.
OTHERS = {
    ('tf2_ros', 'static_transform_publisher'): set(),
    ('imu_filter_madgwick', 'imu_filter_madgwick_node'): {
        *('use_mag', 'world_frame', 'publish_tf', 'remove_gravity_vector', 'orientation_stddev')
    },
    ('robot_localization', 'ekf_node'): {
        *('frequency', 'two_d_mode', 'publish_tf', 'odom_frame', 'base_link_frame'),
        *('world_frame', 'gravitational_acceleration', 'imu0', 'imu0_config'),
        *('imu0_differential', 'imu0_relative', 'imu0_queue_size'),
        'imu0_remove_gravitational_acceleration',
    },
}


def parse(path):
    return ET.parse(path).getroot()  # noqa: S314 - our own file


def declared(root):
    return {element.get('name', '') for element in root.findall('arg')}


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
class TestEveryFile:
    def test_variables_of_a_launch_file_are_its_declared_arguments(self, path):
        root = parse(path)
        text = re.sub(r'<!--.*?-->', '', path.read_text(), flags=re.DOTALL)
        assert set(re.findall(r'\$\(var ([\w]+)\)', text)) == declared(root)

    def test_files_that_a_launch_file_names_exist(self, path):
        elements = re.findall(r'\$\(find-pkg-share thermo_comp\)/([^"]+)"', path.read_text())
        assert elements
        for name in elements:
            assert (ROOT / name.replace('$(var driver)', 'xsens')).is_file(), name

    def test_the_example_in_a_launch_file_gives_declared_arguments(self, path):
        lines = re.findall(r'ros2 launch thermo_comp (\S+) (.*)', path.read_text())
        assert lines
        for name, arguments in lines:
            assert name == path.name
            assert set(re.findall(r'(\w+):=', arguments)) <= declared(parse(path))


def parameters_set(arguments):
    given = {arg.get('name', ''): arg.get('default', '') for arg in parse(OURS).findall('arg')}
    given |= arguments

    def value(text):
        text = re.sub(r'\$\(var (\w+)\)', lambda found: given[found[1]], text)
        text = text.replace('$(find-pkg-share thermo_comp)', str(ROOT))
        equal = re.fullmatch(r'\$\(if \$\(equals (.*) (\S+)\) (\S+) (\S+)\)', text)
        return text if equal is None else equal[3 if equal[1] == equal[2] else 4]

    (node,) = parse(OURS).findall('node')
    elements = [element for element in node.findall('param') if element.get('name')]
    return {value(tag.get('name', '')): value(tag.get('value', '')) for tag in elements}


def test_a_parameter_is_set_only_where_its_argument_was_given(tmp_path):
    pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')
    import rclpy
    import yaml
    from builders import calibration
    from rclpy.context import Context

    from thermo_comp.ros.node import NOT_GIVEN, CompensationNode
    from thermo_comp.ros.waitloop import overrides
    from thermo_comp.unit.calibration import Unit
    from thermo_comp.unit.calibration_file import save_calibration

    unit = tmp_path / 'unit.yaml'
    save_calibration(calibration(unit=Unit('0042', 'm/s^2', 160.0, 0.01)), unit)
    mine = {'calibration_file': str(unit), 'serial': '0042', 'input': 'imu', 'frame_id': 'mine'}
    other = tmp_path / 'counts.yaml'
    save_calibration(calibration(unit=Unit('0042', 'counts', 32767.0, 0.01)), other)
    counts = {'input': 'counts', 'calibration_file': str(other)}
    for arguments in [{}, {'frame_id': 'body'}, {'serial': '0042', **counts}]:
        files = []
        # ros2 launch passes the user's file first, then the values of the launch file.
        for name, values in (('mine', mine), ('launch', parameters_set(arguments))):
            path = tmp_path / f'{name}.yaml'
            path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
            files += ['--params-file', str(path)]
        context = Context()
        rclpy.init(args=['--ros-args', *files], context=context)
        node = CompensationNode(context)
        used = {name: node.node.get_parameter(name).value for name in mine}
        unknown = [name for name in overrides(node.node) if not node.node.has_parameter(name)]
        node.close()
        context.try_shutdown()
        assert used == mine | arguments
        assert all(name.startswith(NOT_GIVEN) for name in unknown)


def test_executables_parameters_topics_drivers_and_frames_of_launch_files_exist():
    (include,) = parse(BESIDE).findall('include')
    assert include.get('file', '').endswith(OURS.name)
    assert {element.get('name') for element in include.findall('arg')} <= declared(parse(OURS))
    nodes = {(node.get('pkg'), node.get('exec')): node for node in parse(BESIDE).findall('node')}
    assert set(nodes) == set(OTHERS)
    for key, node in nodes.items():
        assert {element.get('name') for element in node.findall('param')} <= OTHERS[key]
    by_exec = {executable: node for (_, executable), node in nodes.items()}
    madgwick, ekf = (
        {arg.get('name'): arg.get('value') for arg in by_exec[name].findall('param')}
        for name in ('imu_filter_madgwick_node', 'ekf_node')
    )
    assert (madgwick['publish_tf'], ekf['publish_tf']) == ('false', 'true')
    assert madgwick['remove_gravity_vector'] == 'false'
    assert ekf['imu0_remove_gravitational_acceleration'] == 'true'
    mounting = by_exec['static_transform_publisher'].get('args', '')
    assert f'--frame-id {ekf["base_link_frame"]}' in mounting
    pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')
    from dataclasses import fields

    from thermo_comp.ros.parameters import NodeConfig

    (node,) = parse(OURS).findall('node')
    assert (node.get('pkg'), node.get('name')) == ('thermo_comp', 'thermo_comp')
    assert node.get('exec') in re.findall(r"'(\w+) = thermo_comp", (ROOT / 'setup.py').read_text())
    config = configparser.ConfigParser()
    config.read(ROOT / 'setup.cfg')
    assert config['install']['install_scripts'].endswith('lib/thermo_comp')
    named = set(parameters_set(dict.fromkeys(declared(parse(OURS)), 'given')))
    assert named == {'calibration_file', 'serial', 'input', 'topics', 'frame_id'}
    assert named <= {field.name for field in fields(NodeConfig)}
    # Without the type `str` a serial such as 0042 would become a number.
    assert all(arg.get('type') == 'str' for arg in node.findall('param') if arg.get('name'))
    topics = {topic.name for topic in (*INPUTS.values(), *OUTPUTS)}
    defaults = {arg.get('name'): arg.get('default') for arg in parse(OURS).findall('arg')}
    for remap in node.findall('remap'):
        topic = remap.get('from')
        assert topic in topics or topic.startswith('temperature/'), topic
        argument = re.fullmatch(r'\$\(var (\w+)\)', remap.get('to', ''))
        assert defaults[argument[1]] == topic
    assert parameters_set({'driver': 'xsens'})['topics'] == str(ROOT / 'config/drivers/xsens.yaml')
    assert 'topics' not in parameters_set({})
