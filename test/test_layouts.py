# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Every curve in the layouts for Foxglove and PlotJuggler names a number in a replayed bag."""

import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from builders import GRAVITY, SECOND_NS, calibration, equal_axes
from conftest import ROOT
from rosbags.typesys import Stores, get_typestore

from thermo_comp.recording.reader import inspect_recording
from thermo_comp.recording.writer import BagWriter
from thermo_comp.replay import replay
from thermo_comp.unit.calibration import Unit

FOXGLOVE = ROOT / 'config' / 'thermo_comp.foxglove.json'
PLOTJUGGLER = ROOT / 'config' / 'plotjuggler_layout.xml'
TYPES = get_typestore(Stores.ROS2_JAZZY)


def replayed(folder, kind):
    stamps = 10**18 + np.arange(600) * (SECOND_NS // 10)
    slow = 10**18 + np.arange(-1, 60) * SECOND_NS
    source = folder / f'{kind}.mcap'
    with BagWriter(source) as writer:
        writer.write_temperature('temperature/board', slow, 20.0 + np.arange(61) * 0.01)
        writer.write_temperature('temperature/case', slow, 20.0 + np.arange(61) * 0.02)
        if kind == 'counts':
            writer.write_counts('accel/counts', stamps, np.tile((10.0, 20.0, 2900.0), (600, 1)))
        else:
            force = np.tile((0.1, 0.2, GRAVITY), (600, 1))
            writer.write_imu('imu/uncompensated', stamps, force, np.zeros(9))
    name, scale = ('counts', 300.0) if kind == 'counts' else ('m/s^2', 1.0)
    known = calibration(unit=Unit('T-1', name, 32767.0, 0.1), axes=equal_axes(scale))
    output = folder / f'{kind}_corrected.mcap'
    replay(source, known, output, keep_inputs=True)
    return {name: topic[0] for name, topic in inspect_recording(output).topics.items()}


@pytest.fixture(scope='module')
def topics(tmp_path_factory):
    folder = tmp_path_factory.mktemp('layouts')
    return {**replayed(folder, 'counts'), **replayed(folder, 'imu')}


def field_kind(message, fields):
    """Look up nested fields in the message definitions; return the type of the last field."""
    name = message
    for part in fields:
        field, _, index = part.partition('[')
        known = dict(TYPES.fielddefs[name][1])
        assert field in known, f'{name} has no {field}'
        kind, description = known[field]
        if kind.name in ('ARRAY', 'SEQUENCE'):
            assert index, f'{name}.{field} is an array'
            (kind, description), length = description
            assert int(index.rstrip(']')) < length
        name = description[0] if kind.name == 'BASE' else description
    return name


def panels():
    return json.loads(FOXGLOVE.read_text())['configById']


def script():
    (only,) = json.loads(FOXGLOVE.read_text())['userNodes'].values()
    return only['sourceCode']


def test_foxglove_paths_name_numbers_of_messages_and_each_panel_is_shown_once(topics):
    used = set()
    (output,) = re.findall(r'export const output = "(.*)"', script())
    fields_of_script = re.findall(r'(\w+): number', re.search(r'type Output = .*', script())[0])
    for path in (path['value'] for panel in panels().values() for path in panel.get('paths', [])):
        topic = max((t for t in [*topics, output] if path.startswith(f'{t}.')), key=len)
        fields = path[len(topic) + 1 :].removesuffix('.@sqrt').split('.')
        if topic == output:
            assert fields[0] in fields_of_script
        else:
            assert field_kind(topics[topic], fields) in ('float64', 'bool')
        used.add(topic)
    # The layout shows `regime/dynamic`, so it does not need `regime/stamped` with equal flags.
    assert used == {output, *topics} - {'/regime/stamped'}
    (inputs,) = re.findall(r'export const inputs = (\[.*\])', script())
    assert set(json.loads(inputs)) <= set(topics)
    rendered = {p['topicToRender'] for p in panels().values() if 'topicToRender' in p}
    assert rendered == {'/diagnostics'}  # only the node publishes /diagnostics
    layout = json.dumps(json.loads(FOXGLOVE.read_text())['layout'])
    shown = re.findall(r'"(?:first|second)": "([^"]*)"', layout)
    assert sorted(shown) == sorted(panels())
    kinds = {name.split('!')[0] for name in shown}
    assert {'Plot', 'StateTransitions', 'DiagnosticSummary'} <= kinds


def plotjuggler():
    return ET.fromstring(PLOTJUGGLER.read_text())  # noqa: S314 - our own file


def test_plotjuggler_curves_name_numbers_and_splitters_count_their_panels(topics):
    root = plotjuggler()
    snippets = {snippet.get('name'): snippet for snippet in root.iter('snippet')}
    curves = {curve.get('name') for curve in root.iter('curve')}
    patterns = ('.//linked_source', './/additional_sources/*')
    sources = {element.text for pattern in patterns for element in root.findall(pattern)}
    assert set(snippets) <= curves
    for series in (curves - set(snippets)) | sources:
        topic = max((name for name in topics if series.startswith(f'{name}/')), key=len)
        fields = series[len(topic) + 1 :].split('/')
        # PlotJuggler names entries of a covariance [row;column], a message numbers them 0 to 8.
        if match := re.fullmatch(r'\[([012]);([012])\]', fields[-1]):
            place = 3 * int(match[1]) + int(match[2])
            fields = [*fields[:-2], f'{fields[-2]}[{place}]']
        assert field_kind(topics[topic], fields) in ('float64', 'bool')
    for splitter in root.iter('DockSplitter'):
        assert int(splitter.get('count')) == len(splitter)
        assert len(splitter.get('sizes').split(';')) == len(splitter)


@pytest.mark.parametrize(
    ('name', 'expected'),
    [
        # At 60 min T = 20 + 0.5 m + 0.01 m^2 (m: minutes) has a rate of 1.7 K/min, or 1.68 K/min
        # after two low-passes of 30 s, and a second derivative of 0.02 K/min^2.
        ('/thermo_comp/board_k_min', 1.68),
        ('/thermo_comp/case_k_min', 1.68),
        ('/thermo_comp/case_k_min2', 0.02),
    ],
)
def test_plotjuggler_functions_give_the_derivatives(name, expected):
    lua = shutil.which('lua5.4') or shutil.which('lua5.3') or shutil.which('lua')
    if lua is None:
        pytest.skip('no Lua interpreter here (Debian: lua5.4)')
    (snippet,) = (s for s in plotjuggler().iter('snippet') if s.get('name') == name)
    code = f"""
        {snippet.findtext('global')}
        function calc(time, value)
          {snippet.findtext('function')}
        end
        for t = 0, 3600 do result = calc(t, 20 + 0.5 * t / 60 + 0.01 * (t / 60) ^ 2) end
        print(result)
    """
    shown = subprocess.run([lua, '-e', code], capture_output=True, text=True, check=True)
    assert float(shown.stdout) == pytest.approx(expected, abs=1e-3)
