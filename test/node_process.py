# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the node as a separate process, for tests and benchmarks."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

_STOPPING_S = 10.0  # time for which `stop` waits for the node to end [s]

#: Makes a node use UDP: the shared memory of a killed process remains and may crash other nodes.
OVER_UDP = {'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4'}


def without_middleware(text):
    """Drop the lines by which Fast DDS warns that another process has locked its shared memory."""
    return ''.join(
        line for line in text.splitlines(keepends=True) if 'RTPS_TRANSPORT_SHM' not in line
    )


class NodeProcess:
    """A node process, ended by the `with` block; `environment`: added environment variables."""

    def __init__(self, *ros_args, **environment):
        self._ros_args = ros_args
        self._environment = environment

    def __enter__(self):
        self._log = tempfile.TemporaryFile()
        command = [sys.executable, '-m', 'thermo_comp.ros.node', '--ros-args', *self._ros_args]
        # Run this source tree, not an installed package.
        paths = [str(Path(__file__).resolve().parents[1]), os.environ.get('PYTHONPATH', '')]
        path = os.pathsep.join(filter(None, paths))
        given = {**os.environ, **self._environment, 'PYTHONPATH': path}
        self.process = subprocess.Popen(command, stdout=self._log, stderr=self._log, env=given)
        return self

    def __exit__(self, *_):
        self.stop()
        self._log.close()

    @property
    def is_alive(self):
        return self.process.poll() is None

    @property
    def said(self):
        # `pread` does not change the position at which the node process writes to the file.
        text = os.pread(self._log.fileno(), 1 << 20, 0).decode(errors='replace')
        return without_middleware(text).strip()

    def stop(self, number=signal.SIGTERM):
        # `send_signal` sends no signal to a process that has already ended.
        self.process.send_signal(number)
        try:
            return self.process.wait(timeout=_STOPPING_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()
