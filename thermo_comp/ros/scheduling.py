# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns how the system schedules the thread that waits for samples.

Fast DDS wakes that thread while it holds a lock that the thread needs next. Where both are on one
core, a woken thread takes it over at once, runs into the lock and has to be woken again, up to
five times a sample, and the system is the readier to move it to another core, into cold caches.
Under Linux' policy SCHED_BATCH (sched(7)) a woken thread takes the core from nobody, but runs when
the one that woke it is done. Where others keep the cores busy that could be long, so a thread that
comes late gets the usual policy back.

"""

from __future__ import annotations

import os
from contextlib import suppress
from types import TracebackType

#: A thread that gets a sample so long after the middleware had it is late [ns].
LATE_NS = 500_000

#: So many late wake-ups in a row are too many, and so is any more than a quarter in the long run.
LIMIT = 8

#: For so long; then it tries again [ns].
RETRY_NS = 60_000_000_000


class Courtesy:
    """
    Within it, the calling thread takes the core from nobody while that does not make it late.

    A thread that somebody gave another policy than the usual one is left alone, before and
    meanwhile, and so is one where the system knows no policies or refuses.

    """

    def __init__(self) -> None:
        self._is_possible = hasattr(os, 'SCHED_BATCH')  # Linux
        self._is_entered = self._is_on = False
        self._lateness = 0
        self._retry_ns = 0

    def __enter__(self) -> Courtesy:
        self._is_entered = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._is_entered = False
        if self._is_on:
            self._switch(is_on=False)

    def note(self, delay_ns: int, now_ns: int) -> None:
        """
        Go by how late a wake-up was; nothing happens before the first one.

        Parameters
        ----------
        delay_ns : int
            From the arrival of the sample in the middleware until the thread had it [ns].
        now_ns : int
            Time of the monotonic clock [ns].

        """
        if self._is_on:
            if delay_ns > LATE_NS:
                self._lateness += 3
                if self._lateness >= 3 * LIMIT:
                    self._switch(is_on=False)
                    self._retry_ns = now_ns + RETRY_NS
            elif self._lateness:
                self._lateness -= 1
        elif self._is_entered and self._is_possible and now_ns >= self._retry_ns:
            self._switch(is_on=True)

    def _switch(self, *, is_on: bool) -> None:
        """
        Change the policy, unless somebody else has.

        """
        before, after = os.SCHED_OTHER, os.SCHED_BATCH
        if not is_on:
            before, after = after, before
        self._is_possible = False
        with suppress(OSError):
            if os.sched_getscheduler(0) == before:
                os.sched_setscheduler(0, after, os.sched_param(0))
                self._is_possible = True
        self._is_on = is_on and self._is_possible
        self._lateness = 0
