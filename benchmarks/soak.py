# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Runs the node for hours with reloads and regime changes, and checks that no sample is lost.

    python benchmarks/soak.py [--minutes 60] [--rate 2000] [--json FILE]

The node runs in a separate process, with settings under which no message is lost. Every three
minutes the temperatures rise, stay, fall and stay, so the regime changes; `calibration_file` is
set every two seconds. The resident memory of the node is read every second, the latency of the
samples (from before the publish call to after the take) every ten seconds. The slopes of memory
and latency over time are fitted to means over a minute, without the first tenth of the run. The
exit code is 1 if a sample is missing or out of order.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import struct
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

CALIBRATION = ROOT / 'config' / 'calibration.example.yaml'
COUNTS = struct.Struct('<4siII7s5x3d')
READING = struct.Struct('<4siII7s5x2d')
HEAD = (b'\0\1\0\0', 7, b'sensor\0')
STAMP = struct.Struct('<iI')
SECOND_NS = 1_000_000_000
READINGS_HZ = 10
RELOAD_S, LATENCY_S, REPORT_S = 2.0, 10.0, 0.25
#: Lengths of ramps and soaks [s], which alternate, rate of a ramp [K/s], and lags of case and
#: board [s], which are so short that the regime becomes static in each soak.
RAMP_S, REST_S, RAMP_K_S, CASE_LAG_S, BOARD_LAG_S = 30.0, 60.0, 0.1, 5.0, 10.0
TIMEOUT_S = 30.0


class Temperatures:
    """Simulates case and board temperature step by step."""

    def __init__(self) -> None:
        self.case = self.board = 20.0

    def step(self, seconds: float) -> tuple[float, float]:
        """Advance by one reading interval; return the temperatures of board and case [degC]."""
        phase = seconds % (2.0 * (RAMP_S + REST_S))
        up = min(phase, RAMP_S) - min(max(phase - RAMP_S - REST_S, 0.0), RAMP_S)
        dt = 1.0 / READINGS_HZ
        self.case += dt / CASE_LAG_S * (20.0 + RAMP_K_S * up - self.case)
        self.board += dt / BOARD_LAG_S * (self.case - self.board)
        # The readings vary by 3 mK, because the node rejects readings that stay constant.
        ripple = 0.003 * ((int(seconds * READINGS_HZ) * 7) % 11 - 5) / 5.0
        return self.board + ripple, self.case - ripple


class Soak:
    """Acts as driver, INS and operator of the node, and counts messages."""

    def __init__(self, node: Any, context: Any, rate: int) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import Vector3Stamped
        from rcl_interfaces.srv import SetParameters
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import Imu, Temperature
        from std_msgs.msg import Bool

        from thermo_comp.ros.waitloop import WaitLoop

        qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
        self.process = node
        self.rate = rate
        self.node = rclpy.create_node('soak', context=context)
        # The client has a separate ROS node: the loop that takes samples does not serve clients.
        self._operator = rclpy.create_node('operator', context=context)
        self.client = self._operator.create_client(SetParameters, 'thermo_comp/set_parameters')
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._operator)
        threading.Thread(target=self._executor.spin, daemon=True).start()
        self._loop = WaitLoop(self.node)
        self._imu = self._loop.subscribe(Imu, 'imu/data_raw', qos)
        self._diagnostics = self._loop.subscribe(DiagnosticArray, '/diagnostics', qos)
        self._flags = self._loop.subscribe(Bool, 'regime/dynamic', qos)
        self._counts, self._board, self._case = (
            self.node.create_publisher(kind, topic, qos).handle.publish_raw
            for kind, topic in (
                (Vector3Stamped, 'accel/counts'),
                (Temperature, 'temperature/board'),
                (Temperature, 'temperature/case'),
            )
        )
        self.temperatures = Temperatures()
        self.start_ns = time.time_ns()
        self.n_sent = self.n_heard = self.n_disorder = self.n_changes = self.n_reloads = 0
        self.account: dict[str, str] = {}
        self.latencies: list[int] = []
        self._sent_at = [0] * (64 * rate)
        self._last_ns, self._flag = 0, b''
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._loop.run, args=(self._hear,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close node, client and subscriptions."""
        self._loop.stop()
        self._thread.join(TIMEOUT_S)
        self._executor.shutdown()
        self._operator.destroy_node()
        self.node.destroy_node()

    def _hear(self) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.serialization import deserialize_message

        frames, *_ = self._imu.drain()
        now = time.monotonic_ns()
        for data in frames:
            sec, nanosec = STAMP.unpack_from(data, 4)
            stamp_ns = sec * SECOND_NS + nanosec
            self.n_disorder += stamp_ns <= self._last_ns
            self._last_ns = stamp_ns
            index = round((stamp_ns - self.start_ns) * self.rate / SECOND_NS)
            self.latencies.append(now - self._sent_at[index % len(self._sent_at)])
        for data in self._flags.drain()[0]:
            self.n_changes += data != self._flag
            self._flag = data
        reports, *_ = self._diagnostics.drain()
        with self._news:
            self.n_heard += len(frames)
            for data in reports:
                (status,) = deserialize_message(data, DiagnosticArray).status
                self.account = {value.key: value.value for value in status.values}
            self._news.notify_all()

    def send(self, n: int) -> None:
        """Publish n samples, each temperature reading before the sample of the same stamp."""
        head, frame_length, frame = HEAD
        for index in range(self.n_sent, self.n_sent + n):
            sec, nanosec = divmod(self.start_ns + index * SECOND_NS // self.rate, SECOND_NS)
            if index % (self.rate // READINGS_HZ) == 0:
                board, case = self.temperatures.step(index / self.rate)
                for publish, value in ((self._board, board), (self._case, case)):
                    publish(READING.pack(head, sec, nanosec, frame_length, frame, value, 0.0))
            x, y, z = 5.0 + index % 3, -3.0 + index % 2, 2950.0 + index % 5
            self._sent_at[index % len(self._sent_at)] = time.monotonic_ns()
            self._counts(COUNTS.pack(head, sec, nanosec, frame_length, frame, x, y, z))
        self.n_sent += n

    def wait_for(self, condition: Any, what: str, timeout: float = TIMEOUT_S) -> None:
        """Wait for a condition; after `timeout` [s], end the program with the node's output."""
        with self._news:
            if not self._news.wait_for(condition, timeout) or not self.process.is_alive:
                raise SystemExit(f'{what} did not come; {self.account}; {self.process.said}')

    def meet(self) -> None:
        """Publish samples until the node returns a sample; count the samples from then on."""
        deadline = time.monotonic() + TIMEOUT_S
        while not self.n_heard and time.monotonic() < deadline:
            self.send(self.rate // READINGS_HZ)
            time.sleep(1.0 / READINGS_HZ)
        # Samples sent before discovery are lost. Wait until two diagnostics reports, at least a
        # report period apart, state the same number of samples: then no sample is under way.
        self.wait_for(lambda: int(self.account.get('samples in', 0)) > 0, 'a report')
        n_in = -1
        while n_in != int(self.account['samples in']):
            n_in = int(self.account['samples in'])
            time.sleep(2.0 * REPORT_S)
        self.n_sent_before, self.n_in_before = self.n_sent, n_in
        self.n_out_before, self.n_heard_before = int(self.account['samples out']), self.n_heard
        # Delete the latencies of samples sent before discovery.
        self.latencies.clear()

    def reload(self, path: str) -> None:
        """Set `calibration_file`, without waiting for the answer."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        def count(future: Any) -> None:
            self.n_reloads += future.result().results[0].successful

        message = Parameter('calibration_file', value=path).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        self.client.call_async(request).add_done_callback(count)

    def run(self, seconds: float, paths: list[str]) -> dict[str, Any]:
        """Publish samples for `seconds`; return message counts, memory and latencies."""
        memory: list[tuple[float, float]] = []
        latency: list[tuple[float, float, float]] = []
        n_reloads = n_sent = 0
        n_all = round(seconds * self.rate)
        begin = time.monotonic()
        while n_sent < n_all:
            now = time.monotonic() - begin
            self.send(min(int(now * self.rate) + 1, n_all) - n_sent)
            n_sent = self.n_sent - self.n_sent_before
            if now >= len(memory):
                memory.append((now, _resident_kib(self.process.process.pid)))
            if now >= (n_reloads + 1) * RELOAD_S:
                self.reload(paths[n_reloads % len(paths)])
                n_reloads += 1
            if now >= (len(latency) + 1) * LATENCY_S:
                latency.append(self._take_latency(now))
            time.sleep(max(0.0, begin + n_sent / self.rate - time.monotonic()))
        latency.append(self._take_latency(seconds))

        def is_settled() -> bool:
            return self.n_heard - self.n_heard_before >= n_sent

        try:
            self.wait_for(is_settled, f'{n_sent} samples', 10.0)
        except SystemExit as error:
            print(error, file=sys.stderr)
        time.sleep(2.0 * REPORT_S)
        return {
            'seconds': seconds,
            'rate': self.rate,
            'n_sent': n_sent,
            'n_in': int(self.account['samples in']) - self.n_in_before,
            'n_out': int(self.account['samples out']) - self.n_out_before,
            'n_heard': self.n_heard - self.n_heard_before,
            'n_out_of_order': self.n_disorder,
            'n_reloads': self.n_reloads,
            'n_regime_changes': self.n_changes,
            'memory_kib': [kib for _, kib in memory[:: max(1, len(memory) // 30)]],
            'memory_slope_kib_per_hour': slope(memory, 60.0),
            'latency_p50_ms': [latency[0][1], latency[-1][1]],
            'latency_p99_ms': float(np.median([row[2] for row in latency])),
            'latency_slope_ms_per_hour': slope([row[:2] for row in latency], 60.0),
        }

    def _take_latency(self, now: float) -> tuple[float, float, float]:
        taken, self.latencies = self.latencies, []
        p50, p99 = np.percentile(taken, (50, 99)) * 1e-6
        return now, float(p50), float(p99)


def _resident_kib(pid: int) -> float:
    pages = int(Path(f'/proc/{pid}/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGESIZE') / 1024.0


def slope(rows: list[tuple[float, float]], window_s: float) -> tuple[float, float] | None:
    """
    Fit a line to means over windows; return its slope per hour and the slope's standard error, or
    None for fewer than four windows.
    """
    table = np.array(rows)
    table = table[table[:, 0] >= 0.1 * table[-1, 0]]
    window = ((table[:, 0] - table[0, 0]) // window_s).astype(int)
    means = np.array([table[window == k].mean(axis=0) for k in np.unique(window)])
    if len(means) < 4:
        return None
    hours = means[:, 0] / 3600.0
    hours -= hours.mean()
    spread = float(hours @ hours)
    rate = float(hours @ means[:, 1]) / spread
    left = means[:, 1] - means[:, 1].mean() - rate * hours
    return rate, float(np.sqrt(left @ left / (len(means) - 2) / spread))


def calibrations(rate: int, folder: Path) -> list[str]:
    """
    Write two calibrations between which the running node switches: the example calibration with
    the sample rate of the run and short lags.
    """
    from thermo_comp.thermal.settings import DetectorSettings, ThermometerSettings
    from thermo_comp.unit.calibration_file import load_calibration, save_calibration

    example = load_calibration(CALIBRATION)
    case, board = (
        ThermometerSettings(0.003, 0.0, 12.0, lag_s) for lag_s in (CASE_LAG_S, BOARD_LAG_S)
    )
    detector = DetectorSettings(
        smallest_ramp_k_min=1.0, relaxed_rate_k_min=0.4, dwell_s=5.0, case=case, board=board
    )
    paths = []
    for gravity in (example.gravity_m_s2, example.gravity_m_s2 + 1e-5):
        unit = replace(example.unit, cycle_time_s=1.0 / rate)
        path = folder / f'unit_{len(paths)}.yaml'
        changed = replace(example, unit=unit, detector=detector, gravity_m_s2=gravity)
        save_calibration(changed, path)
        paths.append(str(path))
    return paths


def main() -> int:
    """Run a soak and print its results."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--minutes', type=float, default=60.0, help='length of the run [min]')
    parser.add_argument('--rate', type=int, default=2000, help='samples per second')
    parser.add_argument('--json', help='file for the figures')
    arguments = parser.parse_args()
    os.environ.setdefault('ROS_DOMAIN_ID', str(81 + os.getpid() % 21))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'

    import rclpy
    from live_node import lossless
    from node_process import NodeProcess
    from rclpy.context import Context

    context = Context()
    rclpy.init(args=[], context=context)
    with tempfile.TemporaryDirectory() as folder:
        paths = calibrations(arguments.rate, Path(folder))
        overrides = f'calibration_file:={paths[0]}', f'diagnostics_period:={REPORT_S}'
        ros_args = [word for override in overrides for word in ('-p', override)]
        with NodeProcess(*lossless(), '--log-level', 'FATAL', *ros_args) as node:
            soak = Soak(node, context, arguments.rate)
            try:
                soak.meet()
                result = soak.run(60.0 * arguments.minutes, paths)
            finally:
                soak.close()
    context.try_shutdown()
    result['machine'] = f'{os.cpu_count()} cores, Python {platform.python_version()}'
    for key, value in result.items():
        print(f'{key:28s} {value}')
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(result, indent=1), encoding='utf-8')
    counts = {result[key] for key in ('n_sent', 'n_in', 'n_out', 'n_heard')}
    return 0 if len(counts) == 1 and not result['n_out_of_order'] else 1


if __name__ == '__main__':
    sys.exit(main())
