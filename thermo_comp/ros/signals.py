# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the end by a signal: SIGINT and SIGTERM wake a thread that asks the loop to stop.

The middleware's own handlers shut the context down from a thread of theirs, under whatever is
using it: seldom, and on a busy machine, that ends in a segmentation fault instead of exit code 0.
Here the interpreter only notes the signal, whichever thread the system interrupts with it, and
the loop's thread takes everything down in order.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class SignalWatch:
    """
    Turn the first signal into a call; the second ends the process at once.

    To be entered in the main thread. The call comes from another one, so that it also comes while
    the main thread waits in the middleware, where the interpreter runs no handlers.
    """

    def __init__(self) -> None:
        self._is_over = False
        self._stop: Callable[[], None] | None = None
        self._changed = threading.Lock()
        self._thread = threading.Thread(target=self._watch, name='signals', daemon=True)

    def __enter__(self) -> SignalWatch:
        """Take the signals over."""
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._handlers = {number: signal.signal(number, _noted) for number in SIGNALS}
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
        """Say what the watching thread is to call; called at once after a signal."""
        with self._changed:
            self._stop = stop
            is_over = self._is_over
        if is_over:
            stop()

    def _watch(self) -> None:
        if not os.read(self._reader, 1):
            return
        with self._changed:
            self._is_over = True
            stop = self._stop
        if stop is not None:
            stop()
        number = os.read(self._reader, 1)
        if number:
            # Whoever asks twice does not want to wait for the order.
            os._exit(128 + number[0])


def _noted(_number: int, _frame: FrameType | None) -> None:
    """Stand in for the handler: the interpreter has written the signal's number already."""
