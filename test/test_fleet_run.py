# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A fleet run ends and keeps all results despite bad bags, refusals and killed workers."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from fleet_helpers import OPTIONS, damage, write_unit
from triads import sibling

from thermo_comp.cli.app import run as run_command
from thermo_comp.errors import ThermoCompError
from thermo_comp.fitting import FitOptions
from thermo_comp.fleet.run import Results, fit_fleet, lacks_data
from thermo_comp.fleet.table import COLUMNS, read_parquet, row_of
from thermo_comp.fleet.units import Storage, find_units
from thermo_comp.fleet.work import FleetOptions, connected, outcome_of
from thermo_comp.recording.topics import Topics
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.unit.calibration_file import load_calibration

distributed = pytest.importorskip('distributed', reason='distributed is not installed (`fleet`)')
pytest.importorskip('pyarrow', reason='pyarrow of the extra `fleet` is not installed')


@pytest.fixture(scope='module')
def client():
    with connected(None, 2) as client:
        yield client


@pytest.fixture(scope='module')
def scheduler(client):
    return client.cluster.scheduler_address


def contents(folder):
    files = [path for path in sorted(folder.rglob('*')) if path.is_file()]
    return {str(p.relative_to(folder)): (p.stat().st_mtime_ns, p.read_bytes()) for p in files}


@pytest.fixture(scope='module')
def fleet(tmp_path_factory):
    """Write three units: with good bags, with a corrupt bag, with exchanged thermometers."""
    folder = tmp_path_factory.mktemp('fleet') / 'bags'
    write_unit(folder / 'A' / 'good', 1)
    torn = write_unit(folder / 'A' / 'torn', 2, 7)
    damage(torn[2])
    shutil.copy(torn[0], torn[0].with_name('copy.mcap'))
    write_unit(folder / 'B' / 'exchanged', 3, 3, is_exchanged=True)
    return folder


@pytest.mark.slow
def test_all_units_are_fitted_despite_a_killed_worker_and_only_once(client, fleet, tmp_path):
    out, scheduler = tmp_path / 'out', client.cluster.scheduler_address
    collected = []

    def report(n, total):
        if n == 1:
            os.kill(min(client.run(os.getpid).values()), signal.SIGKILL)
        collected.append((n, total))

    result = fit_fleet(str(fleet), out, OPTIONS, scheduler=scheduler, progress=report)
    assert collected == [(n, 3) for n in range(4)]
    assert result.n_done == 3
    rows = {str(row['name']): row for row in result.rows}
    verdicts = {name: str(row['verdict']).split(',')[0] for name, row in rows.items()}
    assert verdicts == {'A/good': 'valid', 'A/torn': 'valid', 'B/exchanged': 'refused'}
    assert rows['A/torn']['n_left_out'] == 2
    assert 'has the same content as' in str(rows['A/torn']['left_out'])
    assert load_calibration(out / 'units/A/torn/calibration.yaml').unit.serial == 'mems-0002'
    assert not (out / 'units/B/exchanged/calibration.yaml').exists()
    assert [row['name'] for row in read_parquet(result.parquet)] == list(rows)
    assert read_parquet(result.parquet)[0] == rows['A/good']
    with result.csv.open(newline='') as file:
        table = list(csv.DictReader(file))
    assert list(table[0]) == [column.name for column in COLUMNS]
    assert float(table[0]['bias_x_ug']) == rows['A/good']['bias_x_ug']
    before = contents(out / 'units')
    again = fit_fleet(str(fleet), out, OPTIONS, scheduler='tcp://nobody:1')
    assert (again.n_done, again.rows, contents(out / 'units')) == (0, result.rows, before)
    os.utime(fleet / 'A/good/01.mcap', ns=(0, 0))
    assert fit_fleet(str(fleet), out, OPTIONS, scheduler=scheduler).n_done == 1
    after = contents(out / 'units')
    assert {Path(name).parts[1] for name in before if before[name] != after[name]} == {'good'}
    (out / 'units/B/exchanged').rename(out / 'units/B/other')
    (out / 'units/A/torn/calibration.yaml').write_text('edited')
    results = Results(out)
    seen = {unit.name: results.look_up(unit, OPTIONS) for unit in find_units(Storage(str(fleet)))}
    assert {name for name, known in seen.items() if known} == {'A/good'}


@pytest.mark.slow
def test_unreadable_bags_leave_earlier_results_in_place(scheduler, tmp_path):
    bags = write_unit(tmp_path / 'bags' / 'unit', 1)
    options = replace(OPTIONS, certificates=True)
    first = fit_fleet(str(tmp_path / 'bags'), tmp_path / 'out', options, scheduler=scheduler)
    before = contents(tmp_path / 'out' / 'units')
    expected = {'calibration.yaml', 'certificate.html', 'result.json'}
    assert {Path(name).name for name in before} == expected
    kept = [(path, path.stat().st_mtime_ns, path.read_bytes()) for path in bags]
    for path in bags:
        path.write_bytes(b'')
    for changed in (options, replace(options, topics=Topics(input='counts'))):
        second = fit_fleet(str(tmp_path / 'bags'), tmp_path / 'out', changed, scheduler=scheduler)
        (row,) = second.rows
        assert row['verdict'] == 'failed'
        assert 'calibration.yaml of an earlier run stays' in str(row['problem'])
        assert not second.is_whole
        assert contents(tmp_path / 'out' / 'units') == before
    for path, stamp_ns, content in kept:
        path.write_bytes(content)
        os.utime(path, ns=(stamp_ns, stamp_ns))
    third = fit_fleet(str(tmp_path / 'bags'), tmp_path / 'out', options, scheduler=scheduler)
    assert (third.n_done, third.rows) == (0, first.rows)


def test_an_interrupted_fleet_run_continues(scheduler, tmp_path):
    fleet, out = tmp_path / 'bags', tmp_path / 'out'
    for seed in range(2):
        write_unit(fleet / 'A' / f'u{seed}', seed, 1)

    def stop(n, _total):
        if n:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_fleet(str(fleet), out, OPTIONS, scheduler=scheduler, progress=stop)
    assert not (out / 'fleet.csv').exists()
    assert len(list(out.rglob('result.json'))) == 1
    (out / 'units/A/u0').mkdir(parents=True, exist_ok=True)
    (out / 'units/A/u0/result.json').write_text('{"format": 1,')
    result = fit_fleet(str(fleet), out, OPTIONS, scheduler=scheduler)
    assert len(result.rows) == 2
    assert result.n_done in (1, 2)
    assert json.loads((out / 'units/A/u0/result.json').read_text())['is_final']


def children_of(pid):
    return [int(word) for word in Path(f'/proc/{pid}/task/{pid}/children').read_text().split()]


@pytest.mark.slow
def test_ctrl_c_while_workers_start_prints_no_traceback(tmp_path):
    write_unit(tmp_path / 'bags' / 'u', 1, 1)
    words = ['fleet', 'fit', 'bags', '-o', 'out', '--gravity', '9.81', '--workers', '1']
    process = subprocess.Popen(
        [sys.executable, '-m', 'thermo_comp', *words], cwd=tmp_path,
        env={**os.environ, 'PYTHONPATH': str(ROOT)}, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    pause = threading.Event()
    # The first worker is a child of the fork server, and the fork server a child of the command.
    while not any(map(children_of, children_of(process.pid))):
        assert process.poll() is None
        pause.wait(0.01)
    # Ctrl-C in a terminal sends SIGINT to all processes of the group.
    os.killpg(process.pid, signal.SIGINT)
    printed, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    printed = printed.splitlines()
    # SIGINT may arrive before or after the fit of the first unit has begun.
    assert printed in (
        [f'thermo_comp: interrupted: {state}; the same command continues the run in out']
        for state in ('no test has begun', '0 of 1 test done')
    )


class TestScheduler:
    def test_a_scheduler_that_does_not_answer_or_has_no_worker_is_refused(
        self, fleet, tmp_path, monkeypatch
    ):
        monkeypatch.setattr('thermo_comp.fleet.work._WAIT_S', 0.2)
        with pytest.raises(ThermoCompError, match=r'127\.0\.0\.1:9: no Dask scheduler answers'):
            fit_fleet(str(fleet), tmp_path / 'out', OPTIONS, scheduler='tcp://127.0.0.1:9')
        options = {'processes': False, 'protocol': 'tcp', 'dashboard_address': '127.0.0.1:0'}
        with (
            distributed.LocalCluster(n_workers=0, **options) as cluster,
            pytest.raises(ThermoCompError, match='has no worker'),
            connected(cluster.scheduler_address),
        ):
            pass

    def test_workers_with_another_version_are_refused(self, client, fleet, tmp_path, monkeypatch):
        address = client.cluster.scheduler_address
        refused = str(fleet / 'B')
        result = fit_fleet(refused, tmp_path / 'out', OPTIONS, scheduler=address)
        assert [row['verdict'] for row in result.rows] == ['refused']
        monkeypatch.setattr('thermo_comp.fleet.work.__version__', '9.9')
        with pytest.raises(ThermoCompError, match=r'runs thermo_comp \d+\.\d+\.\d+, not 9\.9'):
            fit_fleet(refused, tmp_path / 'other', OPTIONS, scheduler=address)


def future_of(status, error=None):
    return SimpleNamespace(status=status, exception=lambda: error)


@pytest.mark.parametrize(
    ('future', 'problem'),
    [
        (future_of('error', distributed.KilledWorker('task', None, 3)),
         'the worker of its task died 4 times: too little memory?'),
        (future_of('error', MemoryError('no\n room')), 'MemoryError: no room'),
        (future_of('lost'), 'the connection to the Dask scheduler was lost'),
    ],
)  # fmt: skip
def test_the_next_run_repeats_a_failed_task(future, problem, fleet, tmp_path):
    unit = find_units(Storage(str(fleet)))[0]
    outcome = outcome_of(future, unit)
    assert outcome is not None
    results = Results(tmp_path)
    row = results.store(unit, OPTIONS, outcome)
    assert (row['name'], row['verdict'], row['problem']) == ('A/good', 'failed', problem)
    assert results.look_up(unit, OPTIONS) is None


def command(folder, out, *options):
    return run_command(['fleet', 'fit', str(folder), '-o', str(out), *options])


def test_without_dask_or_with_wrong_arguments_fleet_fit_gives_a_message(
    tmp_path, capsys, monkeypatch
):
    assert command(tmp_path, tmp_path / 'out') == 2
    assert 'give --gravity, or --latitude and --height' in capsys.readouterr().err
    assert command(tmp_path, tmp_path / 'out', '--gravity', '-1') == 1
    assert 'local gravity -1 m/s^2 is not found on Earth' in capsys.readouterr().err
    assert command(tmp_path, tmp_path / 'out', '--gravity', '9.81') == 1
    printed = capsys.readouterr().err
    assert 'no bag in it' in printed
    assert len(printed.splitlines()) == 1
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert command(tmp_path, tmp_path / 'out', '--gravity', '9.81') == 1
    text = "thermo_comp: error: a fleet needs Dask: pip install 'thermo_comp[fleet]' (distributed "
    assert capsys.readouterr().err == f'{text}is not installed)\n'


def test_a_unit_without_a_calibration_gives_exit_code_1(scheduler, tmp_path, capsys):
    write_unit(tmp_path / 'bags' / 'u', 1, 3, is_exchanged=True)
    same = FleetOptions(FitOptions(gravity=9.81), Topics())
    fit_fleet(str(tmp_path / 'bags'), tmp_path / 'out', same, scheduler=scheduler)
    arguments = (tmp_path / 'bags', tmp_path / 'out', '--gravity', '9.81')
    assert command(*arguments) == 1
    text = capsys.readouterr()
    assert '- u: the board temperature leads the case' in text.out
    assert '0 of 1 test calibrated; 0 tests done in this run, 1 in an earlier run' in text.out
    assert text.err == ''
    assert command(*arguments, '--with-prior') == 1
    text = '- fitted without a prior: 0 units with a valid calibration from complete data, 3 are '
    assert text in capsys.readouterr().out
    assert command(*arguments, '--json') == 1
    data = json.loads(capsys.readouterr().out)
    assert data['prior'] is None
    assert (data['n_fitted'], data['n_done'], data['verdicts']) == (0, 0, {'refused': 1})


def test_a_unit_is_fitted_again_with_other_options(scheduler, fleet, tmp_path):
    refused = fleet / 'B'
    fit_fleet(str(refused), tmp_path / 'out', OPTIONS, scheduler=scheduler)
    other = replace(OPTIONS, fit=replace(OPTIONS.fit, min_rest_s=4.0))
    assert fit_fleet(str(refused), tmp_path / 'out', other, scheduler=scheduler).n_done == 1


@pytest.mark.slow
def test_the_prior_of_siblings_reduces_the_scale_error_of_a_unit_with_one_bag(scheduler, tmp_path):
    # Unit 0 has one position, which does not separate bias and scale; units 1 to 3 have nine.
    siblings = [sibling(unit_preset('mems', 1), number) for number in range(4)]
    for number, unit in enumerate(siblings):
        folder, n_bags = tmp_path / 'bags' / f'u{number}', 9 if number else 1
        write_unit(folder, number, n_bags, unit=unit, serial=f's{number}')
    arguments = (str(tmp_path / 'bags'), tmp_path / 'out', OPTIONS)
    alone = fit_fleet(*arguments, scheduler=scheduler)
    assert [row['is_whole'] for row in alone.rows] == [0, 1, 1, 1]
    assert alone.prior == tmp_path / 'out' / 'prior.yaml'
    of_type = load_calibration(alone.prior).provenance
    assert [source.name for source in of_type.sources] == ['s1', 's2', 's3']
    before = contents(tmp_path / 'out' / 'units')
    helped = fit_fleet(*arguments, scheduler=scheduler, with_prior=True)
    assert (helped.n_done, contents(tmp_path / 'out' / 'units')) == (1, before)
    assert [bool(row['prior']) for row in helped.rows] == [True, False, False, False]
    (before_row, *_), (row, *_) = alone.rows, helped.rows
    # One error may be small by chance, so compare the norms over three axes.
    scale = np.array(siblings[0].scale_factor)

    def cells(row, name):
        return np.array([float(row[name.format(axis)]) for axis in 'xyz'])

    error, error_before = (cells(each, 'scale_{}') / scale - 1.0 for each in (row, before_row))
    sd, sd_before = (cells(each, 'scale_sd_{}_ppm') for each in (row, before_row))
    assert np.linalg.norm(error) < np.linalg.norm(error_before)
    assert (np.abs(error) < 3e-6 * sd).all()
    assert (sd < 0.5 * sd_before).all()
    assert fit_fleet(*arguments, scheduler=scheduler, with_prior=True).n_done == 0


@pytest.mark.parametrize(
    ('verdict', 'is_whole', 'is_lacking'),
    [
        *(('valid', 1, False), ('valid', 0, True), ('valid, but it only claims 5 mg', 0, True)),
        *(('recalibrate', 1, False), ('recalibrate', 0, False), ('no better than raw', 0, False)),
        *(('thermometers exchanged or loose: not judged', whole, False) for whole in (1, 0)),
        # `is_whole` of a refused unit is None if data are contradictory, 0 if data are missing.
        *(('refused', None, False), ('refused', 0, True), ('failed', None, False)),
    ],
)
def test_only_units_that_lack_data_are_fitted_with_the_prior(verdict, is_whole, is_lacking):
    assert lacks_data(row_of(name='u', verdict=verdict, is_whole=is_whole)) is is_lacking
