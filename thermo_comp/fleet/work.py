# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the work on a unit (reading and fitting its bags), and the distribution of work by Dask."""

import hashlib
import json
import logging
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing import forkserver
from typing import Any, Literal

from .. import __version__
from ..errors import FitError, RecordingError, ThermoCompError, UndeterminedError
from ..fitting import FitOptions, ReducedBag, fit_bags, reduce_bag
from ..fitting.sources import digest, recording_source
from ..recording.topics import Topics
from ..text import one_line
from ..unit.calibration_file import dump_calibration
from .table import FAILED, REFUSED, Cell, fitted_cells, row_of
from .units import FoundUnit, Storage, words

_WAIT_S = 30.0  # time to wait for a Dask scheduler, and for its first worker [s]
_UNIT_OF: dict[str | None, Literal['counts', 'm/s^2']] = {'counts': 'counts', 'imu': 'm/s^2'}


def sha256(content: str | bytes) -> str:
    """Return the SHA-256 of a text or of the bytes of a file."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()


@dataclass(frozen=True)
class FleetOptions:
    """Options of the fits of all units; the bags determine `serial` and `input` of `fit`."""

    fit: FitOptions
    topics: Topics | None = None
    certificates: bool = True

    @property
    def prior_sha256(self) -> str:
        """SHA-256 of the prior of the fits, '' without a prior."""
        return '' if self.fit.prior is None else sha256(dump_calibration(self.fit.prior))

    def digest(self) -> str:
        """Return the SHA-256 of version, prior and options; a unit's result depends on these."""
        plain = replace(self, fit=replace(self.fit, prior=None))
        content = {'version': __version__, 'prior': self.prior_sha256, **asdict(plain)}
        return sha256(json.dumps(content, sort_keys=True, default=repr))


@dataclass(frozen=True)
class UnitOutcome:
    """The result of reading and fitting a unit, small enough for messages of Dask."""

    row: dict[str, Cell]
    hashes: dict[str, str]  # SHA-256 of each bag
    is_final: bool  # False if a file system or worker failed: a later run may succeed
    calibration: str = ''
    certificate: str = ''


def _started_row(unit: FoundUnit, **known: Any) -> dict[str, Cell]:
    """Build the row of a unit from its list of files and the given cells."""
    started = {
        'name': unit.name,
        'serial': unit.name.rpartition('/')[2],
        'lot': unit.lot,
        'n_bags': len(unit.bags),
        'n_bytes': sum(file.size for files in unit.bags.values() for file in files),
        'tool_version': __version__,
    }
    return row_of(**(started | known))


def process_unit(unit: FoundUnit, url: str, options: FleetOptions) -> UnitOutcome:
    """Read and fit a unit; unusable bags are left out, and a failure is stated in the row."""
    began = time.process_time()
    storage = Storage(url)
    hashes = dict.fromkeys(unit.bags, '')
    # Only the statistics of each bag are kept in memory, some kilobytes per hour of the bag.
    bags: dict[str, ReducedBag] = {}
    problems = []
    is_final = True
    for name, files in unit.bags.items():
        try:
            with storage.here(name, files) as path:
                hashes[name] = digest(path)
                twin = next((each for each in bags if hashes[each] == hashes[name]), None)
                if twin:
                    raise FitError(f'{name}: has the same content as {twin}')
                source, info = recording_source(path, options.topics, require=('accel', 'board'))
                how = replace(options.fit, input=_UNIT_OF[info.input])
                bags[name] = reduce_bag(replace(source, sha256=hashes[name]), how)
        except RecordingError as error:  # noqa: PERF203 - the other bags are still read
            # Name the bag by its path in the fleet: the file read may be a temporary copy.
            problems.append(': '.join(part for part in (name, error.key, error.message) if part))
            is_final = is_final and not isinstance(error.__cause__, OSError)
        except OSError as error:
            problems.append(f'{name}: {error.strerror or error}')
            is_final = False
        except FitError as error:
            problems.append(str(error))
    infos = [bag.info for bag in bags.values()]
    serials = sorted({serial for info in infos if (serial := info.metadata.get('serial'))})
    serial = serials[0] if serials else unit.name.rpartition('/')[2]
    row = _started_row(
        unit,
        serial=serial,
        lot=next((lot for info in infos if (lot := info.metadata.get('lot'))), unit.lot),
        n_left_out=len(problems),
        n_torn=sum(bool(info.truncated) for info in infos),
        left_out='; '.join(problems),
        chosen='; '.join(dict.fromkeys(info.chosen for info in infos if info.chosen)),
        prior=options.prior_sha256,
    )
    calibration = page = ''
    try:
        if len(serials) > 1:
            raise FitError(f'the bags are of different units: {", ".join(serials)}')
        if not bags:
            raise ThermoCompError('none of the bags of this test can be used')
        kinds = {_UNIT_OF[bag.info.input]: name for name, bag in bags.items()}
        if len(kinds) > 1:
            contents = ', '.join(f'{name} holds {kind}' for kind, name in sorted(kinds.items()))
            raise FitError(f'{contents}: choose one input with --input')
        how = replace(options.fit, input=next(iter(kinds)), serial=serial)
        row, calibration, page = _fitted(row, list(bags.values()), how, options.certificates)
    except FitError as refusal:
        # If `is_whole` is 0, a fit with a prior may follow, which would hide contradictory data.
        is_whole = 0 if isinstance(refusal, UndeterminedError) else None
        row.update(verdict=REFUSED, problem=one_line(str(refusal)), is_whole=is_whole)
    except ThermoCompError as failure:
        row.update(verdict=FAILED, problem=one_line(str(failure)))
    row['cpu_s'] = time.process_time() - began
    return UnitOutcome(row, hashes, is_final, calibration, page)


def _fitted(
    row: dict[str, Cell], bags: Sequence[ReducedBag], how: FitOptions, has_page: bool
) -> tuple[dict[str, Cell], str, str]:
    """Fit bags; return the table row, the text of the calibration file, the certificate or ''."""
    from ..report.evidence import evidence_of_fit
    from ..report.page import render_report

    result = fit_bags(bags, how)
    calibration = dump_calibration(result.calibration)
    lost = [f'{bag.source.name}: {bag.info.truncated}' for bag in bags if bag.info.truncated]
    if row['n_left_out']:
        lost.append(f'{row["n_left_out"]} of {row["n_bags"]} bags are left out: {row["left_out"]}')
    evidence = evidence_of_fit(result)
    evidence = replace(evidence, findings=(*evidence.findings, *lost))
    known = {
        **fitted_cells(result, evidence.judgement, has_prior=how.prior is not None),
        'reservations': '; '.join(evidence.findings),
        'calibration_sha256': sha256(calibration),
    }
    page = render_report(evidence) if has_page else ''
    return row_of(**(row | known)), calibration, page


def dask_setup(_worker: object) -> None:
    """Silence the log of a worker; Dask calls this function when it starts the worker."""
    logging.getLogger('distributed').setLevel(logging.CRITICAL)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Let workers started in the `with` block ignore Ctrl-C; delay a Ctrl-C to the block's end."""
    received: list[int] = []
    # Workers inherit the ignored SIGINT (Ctrl-C) from the fork server.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    forkserver.ensure_running()
    signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if received:
        raise KeyboardInterrupt


@contextmanager
def connected(scheduler: str | None = None, n_workers: int | None = None) -> Iterator[Any]:
    """Yield a client of the cluster at the address `scheduler`, or of a new local cluster."""
    import dask
    from distributed import Client
    from distributed.utils import get_mp_context

    # Silence the log of Dask: the fleet table states the failures of workers.
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    quiet = {
        'logging.distributed': 'critical',
        'distributed.scheduler.http.routes': [],
        'distributed.worker.multiprocessing-method': 'forkserver',
    }
    local = {'host': '127.0.0.1', 'dashboard_address': '127.0.0.1:0', 'preload': [__name__]}
    how = {'n_workers': n_workers, 'threads_per_worker': 1, 'processes': True, **local}
    with dask.config.set(quiet), ExitStack() as stack:
        if scheduler is None:
            get_mp_context().set_forkserver_preload(['distributed', __name__])
            with _uninterrupted():
                client = stack.enter_context(Client(**how))
            yield client
            return
        versions = {}
        try:
            problem = 'no Dask scheduler answers at this address'
            client = stack.enter_context(Client(scheduler, timeout=_WAIT_S))
            problem = 'the cluster has no worker'
            client.wait_for_workers(1, timeout=_WAIT_S)
            problem = f'a worker lacks thermo_comp {__version__}'
            versions = client.run(version)
        except Exception as error:  # an import on a worker may raise any type of exception
            raise ThermoCompError(f'{scheduler}: {problem}') from error
        for worker, answer in versions.items():
            if answer != __version__:
                problem = f'worker {worker} runs thermo_comp {answer}, not {__version__}'
                raise ThermoCompError(f'{scheduler}: {problem}')
        yield client


def version() -> str:
    """Return the version of thermo_comp in the process that runs this function."""
    return __version__


def run(
    client: Any, url: str, units: Sequence[FoundUnit], options: FleetOptions
) -> Iterator[tuple[FoundUnit, UnitOutcome]]:
    """Process units on a cluster; yield each unit with its outcome, in the order of completion."""
    from distributed import as_completed

    futures = client.map(process_unit, units, url=url, options=options, pure=False, batch_size=256)
    unit_of = {future.key: unit for future, unit in zip(futures, units, strict=True)}
    done = as_completed(futures)
    del futures
    for future in done:
        unit = unit_of.pop(future.key)
        yield unit, outcome_of(future, unit)
        future.release()


def outcome_of(future: Any, unit: FoundUnit) -> UnitOutcome:
    """Return the outcome of a task; if the task failed, an outcome that is not final."""
    from distributed import KilledWorker

    if future.status == 'finished':
        result: UnitOutcome = future.result()
        return result
    error = future.exception() if future.status == 'error' else None
    if error is None:
        problem = 'the connection to the Dask scheduler was lost'
    elif isinstance(error, KilledWorker):
        n_died = error.allowed_failures + 1
        problem = f'the worker of its task died {n_died} times: too little memory?'
    else:
        problem = f'{type(error).__name__}: {words(error)}'
    return UnitOutcome(_started_row(unit, verdict=FAILED, problem=problem), {}, is_final=False)
