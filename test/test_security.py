# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Data from outside cannot fill the memory or open files; the security policy fits the node."""

import xml.etree.ElementTree as ET

import pytest
from builders import calibration
from conftest import ROOT

from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import inspect_recording
from thermo_comp.recording.writer import BagWriter
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import save_calibration

NODE = 'thermo_comp'


def allowed():
    root = ET.parse(ROOT / 'config' / 'policy.xml').getroot()  # noqa: S314 - our own file
    (profile,) = root.iter('profile')
    assert (profile.get('ns'), profile.get('node')) == ('/', NODE)
    collected = {}
    for group in profile:
        ((what, verdict),) = group.attrib.items()
        assert verdict == 'ALLOW'
        names = [(entry.text or '').replace('~', f'/{NODE}') for entry in group]
        collected[what] = {name if name.startswith('/') else f'/{name}' for name in names}
    return collected


def test_the_policy_permits_exactly_the_topics_and_services_of_the_node(tmp_path):
    pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')
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
    assert opened == allowed()


BOMB = '\n'.join(
    ['a0: &a0 {k: v}']
    + [f'a{k}: &a{k} {{<<: [{", ".join([f"*a{k - 1}"] * 9)}]}}' for k in range(1, 30)]
)


def one_reading(path):
    with BagWriter(path) as writer:
        writer.write_temperature('temperature/board', [1], [20.0])
    return path


def test_metadata_with_nested_aliases_is_refused(tmp_path):
    # WHY: each line refers to the line before nine times: 30 lines of YAML give 10^28 entries.
    bag = one_reading(tmp_path / 'bag')
    metadata = bag / 'metadata.yaml'
    metadata.write_text(f'{metadata.read_text()}\n{BOMB}\n')
    with pytest.raises(RecordingError, match='not valid YAML'):
        inspect_recording(bag)


def test_metadata_of_a_bag_opens_no_file_outside_the_folder_of_the_bag(tmp_path):
    secret, bag = one_reading(tmp_path / 'secret.mcap'), one_reading(tmp_path / 'bag')
    metadata = bag / 'metadata.yaml'
    (name,) = (file.name for file in bag.glob('*.mcap'))
    for elsewhere in (str(secret), '../secret.mcap'):
        changed = metadata.read_text().replace(f'- {name}', f'- {elsewhere}', 1)
        assert elsewhere in changed
        metadata.write_text(changed)
        with pytest.raises(RecordingError, match=r'secret\.mcap of the bag is missing'):
            inspect_recording(bag)
        metadata.write_text(metadata.read_text().replace(f'- {elsewhere}', f'- {name}', 1))
