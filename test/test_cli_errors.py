# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Wrong input gives one line on stderr, no output, exit code 1 (data) or 2 (command line)."""

import re

import numpy as np
import pytest
from builders import START_NS, axis_set, calibration, equal_axes, regime_set, rich_calibration
from conftest import ROOT, parsed

from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter
from thermo_comp.unit.calibration_file import save_calibration

TOPICS = Topics()


def bag(path, *, counts=True, board=True, case=True, serial='', n=600, up=(0.6, 0.0, 0.8)):
    stamps = START_NS + np.arange(n) * 100_000_000
    with BagWriter(path, metadata={'serial': serial} if serial else None) as writer:
        for topic, wanted in ((TOPICS.board, board), (TOPICS.case, case)):
            if wanted:
                writer.write_temperature(topic, stamps[::10], np.full(len(stamps[::10]), 20.0))
        if counts:
            noise = np.random.default_rng(2).integers(-1, 2, (n, 3))
            writer.write_counts(TOPICS.counts, stamps, 3000.0 * np.array(up) + noise)
    return path


@pytest.fixture
def unit(tmp_path):
    save_calibration(rich_calibration(), tmp_path / 'unit.yaml')
    return tmp_path / 'unit.yaml'


def refused(cli, code, message, *arguments):
    finished = cli(*arguments, code=code)
    lines = finished.stderr.splitlines()
    assert len(lines) == 1, finished.stderr
    assert lines[0].startswith('thermo_comp: error: ')
    assert re.search(message, lines[0]), lines[0]
    assert finished.stdout == ''


class TestUsage:
    @pytest.mark.parametrize(
        ('arguments', 'message'),
        [
            (('fitt',), r"No such command 'fitt'.*Did you mean 'fit'"),
            (('replay',), r"Missing argument 'BAG'.*thermo_comp replay --help"),
            (('replay', 'a', '-o', 'b'), r"Missing option '--calibration'"),
            (('replay', 'a', '-o', 'b', '-c', 'c', '--spin'), r'No such option.*--spin'),
            (('replay', 'a', '-o', 'b', '-c', 'c', '--input', 'gps'), r"'gps' is not one of"),
            (('replay', 'a', '-o', 'b', '-c', 'c', '--temperature-timeout', '0'),
             r'--temperature-timeout must be greater than 0'),
            (('fit', 'a', '-o', 'b'), r'give --gravity, or --latitude and --height'),
            (('fit', 'a', '-o', 'b', '--gravity', '9.81', '--latitude', '48'),
             r'give --gravity, or --latitude and --height, not both'),
            (('fit', 'a', '-o', 'b', '--gravity', '9.81', '--reference-temperature', 'nan'),
             r'--reference-temperature: must be at least -273.15 degC, got nan'),
            (('play', 'a', '--rate', 'inf'),
             r'--rate must be finite; 0 plays as fast as'),
            (('fit', 'a', '-o', 'b', '--latitude', '60'), r'--latitude and --height'),
            (('evaluate', 'a', '-c', 'b', '--window', '0'), r"'--window': .*(greater|range)"),
            (('evaluate', 'a', '-c', 'b', '--tolerance', '9'), r'--tolerance: expected .*, got'),
            (('report', '-c', 'b', '-o', 'c', '--tolerance', '9ft'), r'like 100ug .*9ft'),
            (('evaluate', 'a', '-c', 'b', '--height', '3'), r'--latitude and --height'),
            (('simulate', '-o', 'a', '--unit', 'gold'), r'must be one of thermostatted'),
            (('simulate', '-o', 'a', '--plan', 'oven'), r'must be one of chamber-18'),
            (('simulate', '-o', 'a', '--profile', '20, up'), r"step 2 'up'"),
            (('simulate', '-o', 'a', '--profile', '20, 90'),
             r'air of 20\.\.90 degC needs -.* W'),
            (('simulate', '-o', 'a', '--temperature-rate-hz', '1e6'),
             r"'--temperature-rate-hz': .*(or equal to 100|<=100)"),
            (('simulate', '-o', 'a', '--plan', 'held-out', '--positions', '3'),
             r'--plan is a whole test: leave out --profile and --positions'),
            (('simulate', '-o', 'a', '--positions', '0'), r"Invalid value for '--positions'"),
            (('simulate', '-o', 'a', '--positions=2.5'),
             r"--positions.*(expected a whole number, got '2\.5'|'2\.5' is not a valid int)"),
            (('fit', 'a', '-o', 'b', '--gravity', '9.8,1'),
             r"--gravity: expected a number with a point, like 9\.8154, got '9\.8,1'"),
            (('fit', 'a', '-o', 'b', '--gravity', '9.81', '--reference-temperature', '1e4'),
             r'--reference-temperature: must be less than 1000 degC, got 10000'),
            (('export', 'a', '--to', 'ardupilot', '--device-id', '7', '-o', 'b'), '--to px4'),
            (('export', 'a', '--to', 'imu_tk', '--up', '0', '0', '1', '-o', 'b'),
             r'--up needs'),
            (('export', 'a', '--to', 'imu_tk', '--number', '1', '-o', 'b'), r'--number needs'),
            (('export', 'a', '--to', 'betaflight', '-o', 'b'), r'betaflight'),
            (('report', '-o', 'b'), r'give bags, a calibration, or both'),
            (('fit', 'a.mcap', '-o', 'b', '--gravity', '9.8', '--rate-hz', '9'), r'for tables'),
        ],
        ids=lambda value: ' '.join(value) if isinstance(value, tuple) else '',
    )  # fmt: skip
    def test_wrong_command_lines_are_refused_in_one_line(self, cli, tmp_path, arguments, message):
        finished = cli(*arguments, code=2, cwd=tmp_path)
        lines = finished.stderr.splitlines()
        assert len(lines) == 1, finished.stderr
        assert re.search(message, lines[0]), lines[0]
        assert list(tmp_path.iterdir()) == []

    def test_thermo_comp_without_a_command_prints_the_help(self, cli):
        finished = cli(code=2)
        assert 'Usage: thermo_comp' in finished.stdout + finished.stderr


def test_a_prior_with_curves_that_differ_by_axis_is_refused(cli, tmp_path):
    prior = ROOT / 'config' / 'calibration.example.yaml'
    words = ('fit', bag(tmp_path / 'bag'), '-o', tmp_path / 'o.yaml', '--gravity', '9.81')
    refused(cli, 1, r'the curves of the prior have different forms', *words, '--prior', prior)


class TestBags:
    def replayed(self, cli, unit, path, message, *more, code=1):
        out = unit.parent / 'out'
        refused(cli, code, message, 'replay', path, '-c', unit, '-o', out, *more)
        assert not out.exists()
        assert not list(unit.parent.glob('.out*')), 'a partial output was left'

    def test_a_bag_without_board_temperature_or_of_another_unit_is_refused(
        self, cli, unit, tmp_path
    ):
        path = bag(tmp_path / 'bag', board=False)
        self.replayed(cli, unit, path, r'temperature/board.*no such topic.*--topic board=')
        refused(cli, 1, r'temperature/board', 'evaluate', path, '-c', unit)
        arguments = ('-o', tmp_path / 'new.yaml', '--gravity', '9.8')
        text = cli('fit', path, *arguments).stdout
        assert 'the bags have no thermometer of the board: the calibration holds' in text
        path = bag(tmp_path / 'other', serial='T-2')
        self.replayed(cli, unit, path, r'serial: this calibration is of unit T-1.*of unit T-2')
        refused(cli, 1, r'is of unit T-1', 'evaluate', path, '-c', unit)


def test_unknown_groups_and_models_and_bags_of_two_units_are_refused(cli, tmp_path):
    paths = [bag(tmp_path / f'{i}.mcap', serial=f'T-{i}') for i in range(2)]
    given = 'fit', *paths, '-o', tmp_path / 'new.yaml', '--gravity', '9.8'
    refused(cli, 2, r'--groups must be one of curve, .*memory', *given, '--groups', 'memory')
    refused(cli, 2, r'quadratic', *given, '--model', 'quadratic')
    refused(cli, 1, r'of different units: .*0.mcap of T-0, .*1.mcap of T-1', *given)
    assert not (tmp_path / 'new.yaml').exists()


def test_a_calibration_that_is_not_valid_gives_exit_code_1(cli, tmp_path):
    wrong = axis_set((0.0, 1.0), (1.0,), delta=150.0)
    sets = regime_set(wrong, wrong, wrong)
    save_calibration(calibration(static=sets, dynamic=sets), tmp_path / 'wrong.yaml')
    path = bag(tmp_path / 'bag', case=False, n=3000, up=(0.0, 0.0, 0.980665))
    finished = cli('evaluate', path, '-c', tmp_path / 'wrong.yaml', code=1)
    assert 'no better than raw: 48 mg RMS of |f| - g, ' in finished.stdout
    # The second calibration is right: its bias curves of +10 mg cancel its biases of -10 mg.
    right = axis_set(delta=30.0)
    sets = regime_set(right, right, right)
    valid = calibration(axes=equal_axes(300.0, -30.0), static=sets, dynamic=sets)
    save_calibration(valid, tmp_path / 'right.yaml')
    arguments = ('evaluate', path, '-c', tmp_path / 'right.yaml')
    assert 'no claim: ' in cli(*arguments, code=1).stdout
    assert 'valid: ' in cli(*arguments, '--tolerance', '1mg').stdout
    assert 'recalibrate: ' in cli(*arguments, '--tolerance', '1e-5ug', code=1).stdout


@pytest.mark.usefixtures('no_figures')
def test_a_cut_bag_is_processed_and_gives_exit_code_1(cli, unit, tmp_path):
    whole = bag(tmp_path / 'whole.mcap').read_bytes()
    torn = tmp_path / 'torn.mcap'
    torn.write_bytes(whole[:-100])
    output = tmp_path / 'out.mcap'
    for arguments in (
        ('info', torn),
        ('replay', torn, '-c', unit, '-o', output),
        ('evaluate', torn, '-c', unit),
        ('fit', torn, '-o', tmp_path / 'new.yaml', '--gravity', '9.80665'),
        ('report', torn, '-c', unit, '-o', tmp_path / 'page.html', '--json'),
    ):
        finished = cli(*arguments, code=1)
        text = finished.stdout + finished.stderr
        assert 'the file is cut off at byte ' in text, text
        assert 'error' not in finished.stderr
    assert output.is_file()
    data = parsed(finished.stdout)
    assert data['headline'] == f'{data["verdict"]}: {data["reason"]}'
    assert (tmp_path / 'page.html').read_text().startswith('<!DOCTYPE html>')
    assert 'exists already' in cli(*arguments, code=1).stderr
