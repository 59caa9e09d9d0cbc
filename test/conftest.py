# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns settings and fixtures of all tests: DDS domain, hypothesis, functions that run commands."""

import fcntl
import gc
import hashlib
import json
import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
import zlib
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent

# One BLAS thread per process, as several wait for each other; numpy reads this when imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

# Each worker of a test run uses its own DDS domain, limited to this machine. The id of the run and
# the number of the worker give the domain. Users have domain 0, benchmarks 81 and above.
_RUN = os.environ.get('PYTEST_XDIST_TESTRUNUID', str(os.getpid()))
_WORKER = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
os.environ['ROS_DOMAIN_ID'] = str(1 + (zlib.crc32(_RUN.encode()) % 20) * 4 + _WORKER % 4)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.pop('ROS_STATIC_PEERS', None)

# A process that a shell starts in the background ignores SIGINT, so set the default handler.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Hypothesis sets no time limit for a test, because the test's duration depends on the machine.
settings.register_profile('usual', max_examples=50, deadline=None)
settings.load_profile('usual')
# `make nightly` runs this number of examples of each test, unless the test sets a number.
settings.register_profile('nightly', max_examples=10_000, deadline=None)


#: Test files with the longest duration, longest first: `make test` begins with these files.
_LONG = (
    *('fleet_run', 'faults', 'part_lags', 'priors', 'regime', 'fitting', 'few_positions'),
    *('cli_help', 'record', 'fault_process', 'drivers', 'degenerate', 'unseen_axes', 'gyroscope'),
    *('report', 'node_defence', 'fitting_selection', 'fleet_storage', 'docs', 'fault_files'),
    *('real_data', 'field', 'node_parity', 'attacks', 'fitting_regression', 'fit_api', 'replay'),
    *('fitting_windows', 'properties', 'judging', 'report_figures', 'correction', 'waitloop'),
    *('judging_history', 'player', 'node_sources', 'fitting_closing', 'api', 'allow'),
    *('acquisition', 'node_startup', 'third_thermometer'),
)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    rank = {f'test_{name}': place for place, name in enumerate(_LONG)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(_LONG)))


def pytest_collection_finish():
    """Exclude all imported objects from garbage collection, which saves time."""
    gc.freeze()


def ran(*command, check=False, **keys):
    """Run a program in the project's folder; return the finished process with its output."""
    words = [*map(str, command)]
    return subprocess.run(words, cwd=ROOT, check=check, capture_output=True, text=True, **keys)


def parsed(text):
    """Parse the JSON object that a command printed; NaN is refused, because it is not JSON."""

    def no_nan(text):
        raise AssertionError(f'{text} is not JSON')

    data = json.loads(text, parse_constant=no_nan)
    assert isinstance(data, dict)
    return data


@pytest.fixture
def rng():
    import numpy as np

    return np.random.default_rng(20161)


@pytest.fixture(scope='session')
def real_data():
    """Return the folder of real recordings, which are not part of this project."""
    folder = Path(os.environ.get('THERMO_COMP_DATA', ROOT.parent / 'shared' / 'data'))
    if not folder.is_dir():
        pytest.skip(f'the real recordings are not in {folder} (set THERMO_COMP_DATA)')
    return folder


def _checked(finished, code):
    assert 'Traceback' not in finished.stderr, finished.stderr
    if code is not None:
        assert finished.returncode == code, finished.stderr + finished.stdout
    return finished


@pytest.fixture(scope='session')
def program():
    def run(*args, code=0, cwd=None, **env):
        finished = subprocess.run(
            [sys.executable, '-m', 'thermo_comp', *map(str, args)], cwd=cwd,
            env={**os.environ, 'PYTHONPATH': str(ROOT), 'COLUMNS': '80', **env},
            capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        return _checked(finished, code)

    return run


@contextmanager
def _caught(name, descriptor):
    """Redirect a standard stream to a file, also for output of C libraries."""
    before = getattr(sys, name)
    before.flush()
    kept = os.dup(descriptor)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), descriptor)
        stream = open(descriptor, 'w', encoding='utf-8', closefd=False)  # noqa: SIM115
        setattr(sys, name, stream)

        def text():
            stream.flush()
            file.seek(0)
            return file.read().decode()

        try:
            yield text
        finally:
            setattr(sys, name, before)
            stream.close()
            os.dup2(kept, descriptor)
            os.close(kept)


@contextmanager
def _as_a_process(cwd):
    """Reset logging, signals and folder as in a new process; restore them afterwards."""
    folder, environment = Path.cwd(), dict(os.environ)
    log = logging.getLogger()
    handlers, log.handlers = log.handlers, []  # pytest's handlers keep log messages from stderr
    os.chdir(cwd or folder)
    os.environ['COLUMNS'] = '80'
    try:
        with warnings.catch_warnings():
            for hidden in (DeprecationWarning, PendingDeprecationWarning, ImportWarning):
                warnings.simplefilter('ignore', hidden)
            warnings.simplefilter('ignore', ResourceWarning)
            warnings.showwarning = lambda *words, **_: print(
                warnings.formatwarning(*words[:4]), file=sys.stderr
            )
            yield
    finally:
        log.handlers = handlers
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)


@pytest.fixture(scope='session')
def cli(program):
    """Return a function that runs a command in this process or, with `env`, in a new process."""
    from thermo_comp.cli.app import run as run_command
    from thermo_comp.text import keep_standard_output

    def run(*args, code=0, cwd=None, **env):
        if env:
            return program(*args, code=code, cwd=cwd, **env)
        arguments = [str(argument) for argument in args]
        with _as_a_process(cwd), _caught('stdout', 1) as output, _caught('stderr', 2) as errors:
            keep_standard_output()
            returned = run_command(arguments)
            sys.stdout.close()  # closing the stream flushes its buffer
            finished = subprocess.CompletedProcess(arguments, returned, output(), errors())
        return _checked(finished, code)

    return run


@pytest.fixture
def small_disk(tmp_path, request):
    disk = tmp_path / 'disk'
    disk.mkdir()
    size = f'size={getattr(request, "param", 4)}k'
    command = ['mount', '-t', 'tmpfs', '-o', size, 'none', str(disk)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip('a small file system can only be mounted by root')
    yield disk
    subprocess.run(['umount', str(disk)], check=True)


@pytest.fixture
def peer():
    pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')
    from ros_helpers import Peer

    peer = Peer()
    yield peer
    peer.close()


@pytest.fixture
def unit(tmp_path):
    from builders import calibration

    from thermo_comp.unit.calibration_file import save_calibration

    save_calibration(calibration(), tmp_path / 'unit.yaml')
    return tmp_path / 'unit.yaml'


@pytest.fixture
def no_figures(monkeypatch):
    """Write report pages without figures, which saves time; test_report.py tests the figures."""
    monkeypatch.setattr('thermo_comp.report.page.figures_of', lambda _: [])


@pytest.fixture(scope='session')
def once(tmp_path_factory):
    """Return a function that fills a folder once per test run and shares it between workers."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if 'PYTEST_XDIST_WORKER' in os.environ else base) / 'once'
    shared.mkdir(exist_ok=True)

    def get(name, make):
        folder, partial = shared / name, shared / f'.{name}'
        with (shared / f'.{name}.lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.exists():
                # An earlier call of `make` that failed may have left files: remove them.
                shutil.rmtree(partial, ignore_errors=True)
                partial.mkdir()
                make(partial)
                partial.rename(folder)
        return folder

    return get


@pytest.fixture(scope='module')
def desk(tmp_path_factory, cli, once):
    from desk_helpers import Desk

    return Desk(tmp_path_factory.mktemp('desk'), cli, once)


class _Pickler(pickle.Pickler):
    """Pickles a fit without its functions that read bags: no test needs them after the fit."""

    def persistent_id(self, value):
        is_local = isinstance(value, FunctionType) and '<' in value.__qualname__
        return 'nothing' if is_local else None


class _Unpickler(pickle.Unpickler):
    def persistent_load(self, _):
        return lambda: None


@pytest.fixture(scope='session')
def equal_fits_once(once):
    """Compute fits of equal bags with equal options once, because many tests need equal fits."""
    from thermo_comp import fitting

    fit = fitting.fit

    def remembered(sources, options, *progress):
        hashes = [source.sha256 for source in sources]
        key = repr((hashes, [source.name for source in sources], options))
        if None in hashes or options.prior is not None:
            return fit(sources, options, *progress)

        def make(folder):
            with (folder / 'fit').open('wb') as file:
                _Pickler(file).dump(fit(sources, options, *progress))

        made = once(f'fit-{hashlib.sha256(key.encode()).hexdigest()[:16]}', make)
        with (made / 'fit').open('rb') as file:
            return _Unpickler(file).load()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, 'fit', remembered)
        yield


@pytest.fixture(scope='session', autouse=True)
def equal_tracks_once():
    """Compute thermal states of equal readings once, because many tests fit the same bags."""
    from thermo_comp.fitting import windows

    track, known = windows._track, {}

    def remembered(bag, model, spec):
        settings = model.detector, model.reference_temperature, spec.sensors, spec.rates
        key = hashlib.sha256(repr((settings, bag.start_ns, bag.end_ns)).encode())
        for name, readings in bag.temperatures.items():
            key.update(name.encode())
            key.update(b''.join(map(bytes, readings)))
        key.update(b''.join(bytes(interval.time) for interval in bag.intervals))
        place = key.digest()
        if place not in known:
            known[place] = track(bag, model, spec)
            # Tests share the arrays of thermal states, so no fit may change them.
            known[place].states.flags.writeable = known[place].is_known.flags.writeable = False
            if len(known) > 60:
                del known[next(iter(known))]
        return known[place]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(windows, '_track', remembered)
        yield
