# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Types, ranges, checks and documentation of the node's parameters come from one table."""

from dataclasses import fields

import pytest
import yaml

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

from conftest import ROOT
from make_reference import parameters_table
from rclpy.parameter import Parameter
from ros_helpers import bare_node, node_in_thread

from thermo_comp.online.status import CompensatorConfig
from thermo_comp.ros import parameters
from thermo_comp.ros.parameters import NodeConfig, ParameterError
from thermo_comp.topics import OUTPUTS


def test_parameters_are_described_and_overrides_are_applied():
    with bare_node() as node:
        config = parameters.declare(node)
        for entry in fields(NodeConfig):
            shown = node.describe_parameter(entry.name)
            assert shown.description == entry.metadata['description']
            assert shown.read_only == entry.metadata['is_fixed']
            assert shown.type == Parameter.Type.from_parameter_value(entry.default).value
            assert bool(shown.floating_point_range) == isinstance(entry.default, float)
            assert bool(shown.integer_range) == isinstance(entry.default, int)
    assert parameters.descriptor('input').additional_constraints == 'one of: counts, imu'
    assert (config, config.compensator_config()) == (NodeConfig(), CompensatorConfig())
    table, text = parameters_table(), parameters.parameters_help()
    for entry in fields(NodeConfig):
        assert f'| `{entry.name}` |' in table
        assert f'  {entry.name}:=' in text
    assert table.count('\n') == 2 + len(fields(NodeConfig))
    # WHY: rclpy refuses `-p transition_time:=5` for a float parameter, with a traceback.
    with bare_node('transition_time:=5', 'serial:=unit42', 'case_timeout:=2.5') as node:
        config = parameters.declare(node)
        assert node.get_parameter('transition_time').value == 5.0
    assert config == NodeConfig(transition_time=5.0, serial='unit42', case_timeout=2.5)
    assert isinstance(config.transition_time, float)


@pytest.mark.parametrize(
    ('override', 'text'),
    [
        ('transition_time:=fast', "parameter `transition_time` must be a number, got 'fast'"),
        ('transition_time:=true', 'parameter `transition_time` must be a number, got True'),
        ('transition_time:=.nan', 'parameter `transition_time` must be between 0 and 3600'),
        ('transition_time:=-1', '`transition_time` must be between 0 and 3600, got -1'),
        ('temperature_timeout:=0', 'parameter `temperature_timeout` must be between 0.1'),
        # ROS takes 0042 for the number 42, so the message asks for quotation marks.
        ('serial:=0042', 'parameter `serial` must be a string, got .*quote it'),
    ],
)
def test_a_bad_override_is_refused_with_its_name_rule_and_value(override, text):
    with bare_node(override) as node, pytest.raises(ParameterError, match=text):
        parameters.declare(node)


@pytest.mark.parametrize(
    ('name', 'value', 'text'),
    [
        ('diagnostics_period', 0.0, 'must be between 0.01 and 60, got 0'),
        ('frame_id', 3, 'must be a string, got 3'),
        ('input', 'gyro', 'must be one of counts, imu'),
        ('frame_id', 'x' * 256, 'must be one printable line of at most 255 characters'),
        ('serial', 'a\nb', "line of at most 64 characters, got 3 characters: 'a"),
    ],
)
def test_an_update_ignores_other_nodes_and_one_wrong_parameter_changes_none(name, value, text):
    changes = [Parameter('serial', value='other'), Parameter(name, value=value)]
    with pytest.raises(ParameterError, match=text):
        parameters.updated(NodeConfig(), changes)
    changes = [Parameter('use_sim_time', value=True), Parameter('frame_id', value='imu_link')]
    assert parameters.updated(NodeConfig(), changes) == NodeConfig(frame_id='imu_link')


def test_the_parameter_file_states_the_defaults():
    text = (ROOT / 'config' / 'thermo_comp.params.yaml').read_text(encoding='utf-8')
    # QoS settings do not apply to remapped topics, so the file has them only as a comment.
    before, overrides_text = text.split('    # The defaults of the QoS overrides:\n    #\n')
    stated = yaml.safe_load(before)['/**']['ros__parameters']
    expected = {entry.name: entry.default for entry in fields(NodeConfig)}
    del expected['calibration_file'], stated['calibration_file']
    assert stated == expected
    overrides = yaml.safe_load(overrides_text.replace('    # ', ''))['qos_overrides']
    assert {f'/{topic.name}' for topic in OUTPUTS} <= overrides.keys()
    calibration = ROOT / 'config' / 'calibration.example.yaml'
    with node_in_thread('-p', f'calibration_file:={calibration}') as node:
        for topic, sides in overrides.items():
            for side, policies in sides.items():
                for policy, value in policies.items():
                    name = f'qos_overrides.{topic}.{side}.{policy}'
                    assert node.node.get_parameter(name).value == value, name
