# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a process sets up before its first node: its end by a signal, its Fast DDS profile.

The middleware's own handlers shut the context down under whatever is using it, which seldom ends
in a segmentation fault. Here a thread asks the loop to stop, which takes everything down in order.
"""

from __future__ import annotations

import os
import select
import signal
import threading
from collections.abc import Callable
from pathlib import Path

SIGNALS = (signal.SIGINT, signal.SIGTERM)

#: Where Fast DDS 2 is told of a profile, and the file of the working directory that it takes else.
VARIABLE, LOCAL_PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE', 'DEFAULT_FASTRTPS_PROFILES.xml'
PROFILE = Path(__file__).with_name('fastdds_profile.xml')


def use_profile() -> None:
    """Make the node's profile that of this process, before its first context, if none is set."""
    # It saves a quarter of the CPU time with reliable subscribers (docs/benchmarks.md).
    if VARIABLE not in os.environ and not Path(LOCAL_PROFILE).is_file():
        os.environ[VARIABLE] = str(PROFILE)


class SignalWatch:
    """
    Turn the first signal into a call, entered in the main thread; the second ends at once.

    Where that call has not led to the end within `ending_s` [s], the process ends all the same.
    """

    # The call comes from another thread, so that it also comes while the main one waits in the
    # middleware, where the interpreter runs no handlers.

    def __init__(self, ending_s: float | None = None) -> None:
        self._ending_s = ending_s
        self._is_over = False
        self._stop: Callable[[], None] = lambda: None
        self._thread = threading.Thread(target=self._watch, name='signals', daemon=True)

    def __enter__(self) -> SignalWatch:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        # The interpreter has written the signal's number already.
        self._handlers = {number: signal.signal(number, lambda *_: None) for number in SIGNALS}
        self._wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Give the signals back to whom they belonged before."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        os.close(self._writer)
        self._thread.join()
        os.close(self._reader)

    def on_signal(self, stop: Callable[[], None]) -> None:
        """Say what is to be called, once or twice; called at once after a signal."""
        self._stop = stop
        if self._is_over:
            stop()

    def _watch(self) -> None:
        if os.read(self._reader, 1):
            self._is_over = True
            self._stop()
            if not select.select([self._reader], [], [], self._ending_s)[0]:
                # Nothing is left to be kept: who asked for the end has it.
                os._exit(0)
            number = os.read(self._reader, 1)
            if number:
                # Whoever asks twice does not want to wait for the order.
                os._exit(128 + number[0])
