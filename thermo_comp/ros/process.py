# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the set-up of a process before its first node: handling of signals, Fast DDS profile.

The middleware's signal handlers shut down a context that is in use, which sometimes ends in a
segmentation fault. With `SignalWatch` a thread asks the main loop to stop, and the main thread
shuts everything down in order.
"""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

SIGNALS = (signal.SIGINT, signal.SIGTERM)

#: Environment variable of a Fast DDS 2 profile, and the default file in the working directory.
VARIABLE, LOCAL_PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE', 'DEFAULT_FASTRTPS_PROFILES.xml'
PROFILE = Path(__file__).with_name('fastdds_profile.xml')


def use_profile() -> None:
    """Set the node's Fast DDS profile, unless a profile is set; to be called before ROS starts."""
    # With reliable subscribers the profile saves 25 % of the CPU time (docs/ros_interface.md).
    if VARIABLE not in os.environ and not Path(LOCAL_PROFILE).is_file():
        os.environ[VARIABLE] = str(PROFILE)


class SignalWatch:
    """
    Calls a stop function at the first signal. A `SignalWatch` must be used in the main thread.
    A process that still runs `ending_s` [s] after the stop function has returned is ended by
    `os._exit`; without `ending_s`, a second signal ends the process.
    """

    # A separate thread calls the stop function, because the interpreter runs no signal handlers
    # while the main thread waits in the middleware.

    def __init__(self, ending_s: float | None = None) -> None:
        self._ending_s = ending_s
        self._is_over = False
        self._stop: Callable[[], None] = lambda: None
        self._thread = threading.Thread(target=self._watch, name='signals', daemon=True)

    def __enter__(self) -> SignalWatch:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        # The handlers are empty: the interpreter itself writes the signal's number to the pipe.
        self._handlers = {number: signal.signal(number, lambda *_: None) for number in SIGNALS}
        self._wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous signal handlers."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        os.close(self._writer)
        self._thread.join()
        os.close(self._reader)

    def on_signal(self, stop: Callable[[], None]) -> None:
        """Set the function that a signal calls; call it at once if a signal came before."""
        self._stop = stop
        if self._is_over:
            stop()

    def _watch(self) -> None:
        if os.read(self._reader, 1):
            self._is_over = True
            self._stop()
            end = None if self._ending_s is None else time.monotonic() + self._ending_s
            # Ignore signals until `end`: `ros2 launch` without a terminal repeats a signal.
            while select.select(
                [self._reader], [], [], None if end is None else max(end - time.monotonic(), 0.0)
            )[0]:
                number = os.read(self._reader, 1)
                if not number:
                    return
                if self._ending_s is None:
                    os._exit(128 + number[0])
            # The process has not ended by itself within `ending_s`.
            os._exit(0)
