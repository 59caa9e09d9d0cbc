# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way onto Dask: a cluster of this machine or of others, and what its accidents mean.

A fleet is cut into units: reduction and fit of one are one task, and no statistics leave the
worker. Where there are fewer units than threads, and large ones, it is cut into bags, whose
statistics go to where the unit is fitted. Both ways end in the same numbers.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from .. import __version__
from ..errors import FleetError
from .bag import reduce_found
from .discovery import FoundUnit
from .row import FAILED, empty_row
from .unit import FleetOptions, UnitOutcome, conclude, process_unit

# A unit with less to read is done by one worker before a second one has started.
_LARGE_UNIT_BYTES = 1 << 28
_HINT = "a fleet needs Dask: pip install 'thermo_comp[fleet]'"
_WAIT_S = 30.0


@dataclass(frozen=True)
class Job:
    """
    One unit to be done.

    Parameters
    ----------
    unit : FoundUnit
        The unit.
    known : str
        Key of the result that is there, if its bags were touched since; else empty.

    """

    unit: FoundUnit
    known: str = ''


def require_libraries() -> None:
    """
    Say at once what is missing.

    Raises
    ------
    FleetError
        If a library of the extra `fleet` is not installed.

    """
    try:
        import distributed
        import fsspec
        import pyarrow as pa
    except ImportError as error:
        raise FleetError(f'{_HINT} ({error.name} is not installed)') from error
    del distributed, fsspec, pa


@contextmanager
def connected(
    scheduler: str | None = None, n_workers: int | None = None, most: int = 1 << 30
) -> Iterator[Any]:
    """
    Give a client of a cluster.

    Parameters
    ----------
    scheduler : str or None, optional
        Address of a running one, e.g. ``tcp://host:8786``; None makes one on this machine, and
        ends it at the end.
    n_workers : int or None, optional
        Processes of the own cluster; None takes one per processor.
    most : int, optional
        What there is to do at a time: more processes than that are not started.

    Yields
    ------
    distributed.Client
        Connected, with at least one worker.

    Raises
    ------
    FleetError
        If Dask is missing, nobody answers, there is no worker, or they run another version.

    """
    require_libraries()
    import dask
    from distributed import Client, LocalCluster

    # What a worker does on its way down is in the fleet table, in words that its reader knows.
    settings = {'logging.distributed': 'critical', 'distributed.scheduler.http.routes': []}
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    with dask.config.set(settings):
        if scheduler is None:
            with (
                LocalCluster(
                    n_workers=min(n_workers or os.cpu_count() or 1, most),
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address='127.0.0.1:0',
                    host='127.0.0.1',
                    preload=['thermo_comp.fleet.worker'],
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
            _check_workers(client, scheduler)
            yield client


def _check_workers(client: Any, scheduler: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_WAIT_S)
    except TimeoutError as error:
        raise FleetError(f'{scheduler}: has no worker') from error
    try:
        versions = client.run(version)
    except Exception as error:  # whatever an import fails with over there
        raise FleetError(f'{scheduler}: a worker lacks thermo_comp {__version__}') from error
    for worker, found in versions.items():
        if found != __version__:
            raise FleetError(
                f'{scheduler}: worker {worker} runs thermo_comp {found}, not {__version__}'
            )


def version() -> str:
    """Return the version of whoever is asked."""
    return __version__


def n_tasks(jobs: Sequence[Job]) -> int:
    """
    Count what can be done at a time: units, or bags where a unit is large.

    Returns
    -------
    int
        At least the number of units.

    """
    large = [job for job in jobs if sum(b.n_bytes for b in job.unit.bags) >= _LARGE_UNIT_BYTES]
    return max(len(jobs), *(len(job.unit.bags) for job in large), 0)


def run(
    client: Any,
    url: str,
    jobs: Sequence[Job],
    options: FleetOptions,
    *,
    by_bag: bool | None = None,
) -> Iterator[tuple[FoundUnit, UnitOutcome | None]]:
    """
    Do units, and yield each as it is done.

    Parameters
    ----------
    client : distributed.Client
        A cluster.
    url : str
        The fleet's folder, as the workers see it.
    jobs : sequence of Job
        The units.
    options : FleetOptions
        The options.
    by_bag : bool or None, optional
        Whether each bag is a task of its own; None decides by number and size of the units.

    Yields
    ------
    unit : FoundUnit
        The unit.
    outcome : UnitOutcome or None
        What came of it; None where the result that is there holds. A unit whose task failed
        comes with the reason.

    """
    from distributed import as_completed

    if by_bag is None:
        by_bag = n_tasks(jobs) > len(jobs) and len(jobs) < sum(client.nthreads().values())
    submit = _submit_bags if by_bag else _submit_units
    waiting = dict(zip(submit(client, url, jobs, options), jobs, strict=True))
    units = {future.key: job.unit for future, job in waiting.items()}
    done = as_completed(list(waiting))
    waiting.clear()
    for future in done:
        unit = units.pop(future.key)
        yield unit, outcome_of(future, unit)
        future.release()


def _submit_units(client: Any, url: str, jobs: Sequence[Job], options: FleetOptions) -> list[Any]:
    return list(
        client.map(
            process_unit,
            [url] * len(jobs),
            [job.unit for job in jobs],
            [options] * len(jobs),
            [job.known for job in jobs],
            pure=False,
            batch_size=256,
        )
    )


def _submit_bags(client: Any, url: str, jobs: Sequence[Job], options: FleetOptions) -> list[Any]:
    futures: list[Any] = []
    for job in jobs:
        parts = [
            client.submit(
                _one_bag, url, bag, options, pure=False, key=f'bag-{len(futures)}-{bag.name}'
            )
            for bag in job.unit.bags
        ]
        futures.append(client.submit(conclude, job.unit, options, parts, job.known, pure=False))
    return futures


def _one_bag(url: str, bag: Any, options: FleetOptions) -> Any:
    return (reduce_found(url, bag, options.fit, options.topics, options.input),)


def outcome_of(future: Any, unit: FoundUnit) -> UnitOutcome | None:
    """
    Take a task's result, or the words for what became of it.

    Parameters
    ----------
    future : distributed.Future
        The task, ended somehow.
    unit : FoundUnit
        What it was about.

    Returns
    -------
    UnitOutcome or None
        As `process_unit` gives it; a failure to be done again where it gave none.

    """
    from distributed import KilledWorker

    if future.status == 'finished':
        result: UnitOutcome | None = future.result()
        return result
    if future.status != 'error':
        return _failed(unit, 'the scheduler was lost')
    error = future.exception()
    if isinstance(error, KilledWorker):
        n_died = error.allowed_failures + 1
        return _failed(unit, f'its worker died {n_died} times at it: too little memory?')
    text = ' '.join(str(error).split())
    return _failed(unit, f'{type(error).__name__}: {text}')


def _failed(unit: FoundUnit, problem: str) -> UnitOutcome:
    row = empty_row(
        name=unit.name,
        serial=unit.name.rpartition('/')[2],
        lot=unit.lot,
        verdict=FAILED,
        problem=problem,
        n_bags=len(unit.bags),
        n_bytes=sum(bag.n_bytes for bag in unit.bags),
        tool_version=__version__,
    )
    return UnitOutcome(row)
