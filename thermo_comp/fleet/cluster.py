# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the way onto Dask: a cluster of this machine or of others, and what its accidents mean."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from .. import __version__
from ..errors import FleetError
from .table import FAILED
from .unit import FleetOptions, UnitOutcome, process_unit, started_row
from .units import FoundUnit

_WAIT_S = 30.0


def dask_setup(_worker: object) -> None:
    """Leave Ctrl-C, which a terminal sends to all, to the first process: a preload of Dask."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger('distributed').setLevel(logging.CRITICAL)


def require_libraries() -> None:
    """Raise FleetError at once if a library of the extra `fleet` is not installed."""
    for name in ('distributed', 'fsspec', 'pyarrow'):
        if find_spec(name) is None:
            raise FleetError(
                f"a fleet needs Dask: pip install 'thermo_comp[fleet]' ({name} is not installed)"
            )


@contextmanager
def connected(
    scheduler: str | None = None, n_workers: int | None = None, most: int = 1 << 30
) -> Iterator[Any]:
    """
    Give a client of a cluster with at least one worker: of one that runs, or of one of its own.

    Raises FleetError if nobody answers, there is no worker, or they run another version.
    """
    import dask
    from distributed import Client, LocalCluster

    # What a worker does on its way down is in the fleet table, in words that its reader knows.
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    quiet = {'logging.distributed': 'critical', 'distributed.scheduler.http.routes': []}
    with dask.config.set(quiet):
        if scheduler is None:
            with (
                LocalCluster(
                    n_workers=min(n_workers or os.cpu_count() or 1, most),
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address='127.0.0.1:0',
                    host='127.0.0.1',
                    preload=[__name__],
                ) as cluster,
                Client(cluster) as client,
            ):
                yield client
            return
        try:
            client = Client(scheduler, timeout=_WAIT_S)
        except (OSError, ValueError, TypeError) as error:
            raise FleetError(f'{scheduler}: no Dask scheduler answers there') from error
        with client:
            try:
                client.wait_for_workers(1, timeout=_WAIT_S)
                versions = client.run(version)
            except TimeoutError as error:
                raise FleetError(f'{scheduler}: has no worker') from error
            except Exception as error:  # whatever an import fails with over there
                said = f'{scheduler}: a worker lacks thermo_comp {__version__}'
                raise FleetError(said) from error
            for worker, found in versions.items():
                if found != __version__:
                    said = f'worker {worker} runs thermo_comp {found}, not {__version__}'
                    raise FleetError(f'{scheduler}: {said}')
            yield client


def version() -> str:
    """Return the version of whoever is asked."""
    return __version__


def run(
    client: Any, url: str, units: Sequence[FoundUnit], options: FleetOptions
) -> Iterator[tuple[FoundUnit, UnitOutcome]]:
    """Do units, and yield each as it is done; one whose task failed comes with the reason."""
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
    """Take a task's result, or the words for what became of it: a failure to be done again."""
    from distributed import KilledWorker

    if future.status == 'finished':
        result: UnitOutcome = future.result()
        return result
    error = future.exception() if future.status == 'error' else None
    if error is None:
        problem = 'the scheduler was lost'
    elif isinstance(error, KilledWorker):
        n_died = error.allowed_failures + 1
        problem = f'its worker died {n_died} times at it: too little memory?'
    else:
        problem = f'{type(error).__name__}: {" ".join(str(error).split())}'
    row = started_row(unit, verdict=FAILED, problem=problem)
    return UnitOutcome(row, {}, is_final=False)
