# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns a node that only listens: its subscriptions are emptied in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import rclpy
from rclpy.context import Context

from .waitloop import WaitLoop


class Listener:
    """A node with a loop around it; `start` runs it until `close`, calling back for new data."""

    def __init__(self, name: str, ros_args: Sequence[str]) -> None:
        self._context = Context()
        rclpy.init(args=['--ros-args', *ros_args], context=self._context)
        self.node = rclpy.create_node(name, context=self._context)
        self.loop = WaitLoop(self.node)
        self._thread: threading.Thread | None = None

    def start(self, on_data: Callable[[], None]) -> None:
        """Run the loop; once more at its end for what came last."""

        def run() -> None:
            self.loop.run(on_data)
            on_data()

        self._thread = threading.Thread(target=run, name=self.node.get_name())
        self._thread.start()

    def close(self) -> None:
        """Stop, take what came last, destroy the node; do nothing the second time."""
        if not self._context.ok():
            return
        self.loop.stop()
        if self._thread is not None:
            self._thread.join()
        self.loop.close()
        self.node.destroy_node()
        self._context.try_shutdown()
