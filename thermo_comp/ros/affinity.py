# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the processor core that the node's process keeps to, where the user names one.

A message wakes a thread of the middleware, and that one the node's. The system looks for an idle
core for each of them, and so the node runs on one core, then on another, mostly with cold caches.

"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from ..errors import ThermoCompError

#: The number that names no core.
ANY = -1

_TASKS = Path('/proc/self/task')


class AffinityError(ThermoCompError):
    """
    A core that this process can't keep to.

    """


class Affinity:
    """
    Keep all threads of this process to one core, and give them back what they had before.

    """

    def __init__(self) -> None:
        # Not every system knows of affinities.
        ask = getattr(os, 'sched_getaffinity', None)
        self._before: set[int] = ask(0) if ask else set()
        self._core = ANY

    def check(self, core: int) -> None:
        """
        Refuse a core that is not there.

        Parameters
        ----------
        core : int
            Its number, or `ANY`.

        Raises
        ------
        AffinityError
            If this process was not started with this core among others.

        """
        if core != ANY and core not in self._before:
            allowed = ', '.join(map(str, sorted(self._before))) or 'none that the system tells'
            raise AffinityError(
                f'parameter `cpu_affinity`: core {core} is not among those that this process '
                f'may use: {allowed}'
            )

    def keep_to(self, core: int) -> None:
        """
        Move all threads to a core that `check` lets pass, or back to all that they had.

        Raises
        ------
        AffinityError
            If the system refuses.

        """
        if core == self._core:
            return
        cores = self._before if core == ANY else {core}
        done: set[int] = set()
        try:
            # A thread that starts meanwhile has the cores of the one that starts it.
            while new := {int(task.name) for task in _TASKS.iterdir()} - done:
                for thread in new:
                    with suppress(ProcessLookupError):
                        os.sched_setaffinity(thread, cores)
                done |= new
        except OSError as error:
            raise AffinityError(f'parameter `cpu_affinity`: core {core}: {error}') from error
        self._core = core
