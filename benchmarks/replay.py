# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures `replay`: reading, compensating and writing bags, by thermo_comp and rosbags.

thermo_comp is measured by the function that the command `thermo_comp replay` calls. rosbags is
measured by a script that deserializes each message, corrects it with the compensator of
thermo_comp, serializes and writes it. thermo_comp and the script write chunks packed with zstd.
All bags hold counts at 400 Hz and two temperatures at 1 Hz.

    python benchmarks/replay.py --hours 24        # time of reading and compensating a day
    python benchmarks/replay.py --gigabytes 10    # peak memory of a replay of a large bag
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import Compensator
from thermo_comp.recording.reader import open_recording
from thermo_comp.recording.writer import BagWriter
from thermo_comp.replay import replay as replay_bag
from thermo_comp.unit.calibration import Calibration
from thermo_comp.unit.calibration_file import load_calibration

START_NS = 1_700_000_000_000_000_000
RATE_HZ = 400
CALIBRATION = Path(__file__).resolve().parent.parent / 'config' / 'calibration.example.yaml'
BLOCK = 100 * RATE_HZ


def calibration() -> Calibration:
    """Return the example calibration with the sample rate of the bags."""
    value = load_calibration(CALIBRATION)
    return replace(value, unit=replace(value.unit, cycle_time_s=1.0 / RATE_HZ))


def write_bag(path: Path, n: int, compression: str = 'zstd') -> None:
    """Write a bag with n messages of counts at 400 Hz, and two temperatures at 1 Hz."""
    rng = np.random.default_rng(1)
    noise = np.round(rng.normal(0.0, 8.0, (BLOCK, 3)))
    with BagWriter(path, compression=compression) as bag:
        for begin in range(0, n, BLOCK):
            index = np.arange(begin, min(begin + BLOCK, n))
            stamp_ns = START_NS + index * (1_000_000_000 // RATE_HZ)
            counts = np.array([20.0, -300.0, 2939.0]) + np.roll(noise, begin // 7, axis=0)
            slow = stamp_ns[index % RATE_HZ == 0]
            celsius = 20.0 + 12.0 * np.sin((slow - START_NS) * 1e-9 / 3600.0)
            celsius += rng.normal(0.0, 0.005, len(slow))
            bag.write_temperature('temperature/board', slow, celsius)
            bag.write_temperature('temperature/case', slow, celsius + 0.4)
            bag.write_counts('accel/counts', stamp_ns, counts[: len(index)], 'accel_link')
            bag.flush()


def read(path: Path) -> int:
    """Read a bag into columns, block by block; return the number of samples."""
    with open_recording(path) as reader:
        return sum(len(block) for block in reader.blocks())


def read_and_compensate(path: Path) -> int:
    """Read a bag into columns and correct the samples; return the number of samples."""
    compensator = Compensator(calibration())
    with open_recording(path) as reader:
        return sum(len(process_block(compensator, block).index) for block in reader.blocks())


def compensate(path: Path) -> tuple[int, float]:
    """Correct a bag; return the number of samples, and the CPU time of correcting alone [s]."""
    compensator = Compensator(calibration())
    spent = 0.0
    n = 0
    with open_recording(path) as reader:
        for block in reader.blocks():
            begin = time.thread_time()
            n += len(process_block(compensator, block).index)
            spent += time.thread_time() - begin
    return n, spent


def ours(path: Path, output: Path) -> int:
    """Replay a bag with the example calibration; return the number of samples."""
    return replay_bag(path, calibration(), output, overwrite=True).counters.n_out


def rosbags_pipeline(path: Path, output: Path) -> int:
    """Replay a bag message by message with rosbags."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    imu_type = store.types['sensor_msgs/msg/Imu']
    quaternion = store.types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    vector = store.types['geometry_msgs/msg/Vector3']
    zero, unknown = vector(0.0, 0.0, 0.0), np.array([-1.0, *[0.0] * 8])
    compensator = Compensator(calibration())
    n = 0
    target = Writer(output, version=9, storage_plugin=StoragePlugin.MCAP)
    target.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with Reader(path) as reader, target as writer:
        out = writer.add_connection('/imu/data_raw', imu_type.__msgtype__, typestore=store)
        for connection, log_ns, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            if connection.topic == '/temperature/board':
                compensator.push('board', stamp_ns, message.temperature)
            elif connection.topic == '/temperature/case':
                compensator.push('case', stamp_ns, message.temperature)
            else:
                v = message.vector
                row = compensator.process(stamp_ns, v.x, v.y, v.z)
                if row is None:
                    continue
                x, y, z, xx, xy, xz, yy, yz, zz = row
                imu = imu_type(
                    message.header,
                    quaternion,
                    unknown,
                    zero,
                    unknown,
                    vector(x, y, z),
                    np.array([xx, xy, xz, xy, yy, yz, xz, yz, zz]),
                )
                writer.write(out, log_ns, store.serialize_cdr(imu, imu_type.__msgtype__))
                n += 1
    return n


def seconds(run: Callable[[], object], repeats: int = 1) -> tuple[float, float]:
    """Return the smallest wall time and the smallest CPU time of `repeats` runs [s]."""
    wall = cpu = float('inf')
    for _ in range(repeats):
        begin, begin_cpu = time.perf_counter(), time.process_time()
        run()
        wall = min(wall, time.perf_counter() - begin)
        cpu = min(cpu, time.process_time() - begin_cpu)
    return wall, cpu


def pipelines(folder: Path, n: int, repeats: int) -> None:
    """Print the samples per second from bag to bag, by rosbags and by thermo_comp."""
    path, output = folder / 'in.mcap', folder / 'out'
    n_peer = n // 20
    peer = folder / 'peer.mcap'
    write_bag(path, n)
    write_bag(peer, n_peer)
    mine = [n / spent for spent in seconds(lambda: ours(path, output), repeats)]
    theirs = [
        n_peer / spent
        for spent in seconds(
            lambda: rosbags_pipeline(peer, Path(tempfile.mkdtemp(dir=folder), 'b')), repeats
        )
    ]
    print('bag to bag         samples/s  samples/CPU s')
    print(f'rosbags pipeline  {theirs[0]:10.0f} {theirs[1]:14.0f}')
    print(f'thermo_comp       {mine[0]:10.0f} {mine[1]:14.0f}')
    print(f'ratio             {mine[0] / theirs[0]:10.1f} {mine[1] / theirs[1]:14.1f}')
    path.unlink()


def day(folder: Path, hours: float, compression: str, repeats: int) -> None:
    """Print the times of reading alone, and of reading and compensating, for three bag lengths."""
    print(
        f'{compression}: wall (CPU) seconds; alone = compensation only, million samples per CPU s'
    )
    print('  hours   samples  read            read+comp       ratio          alone')
    lengths, times = [], []
    for share in (0.25, 0.5, 1.0):
        n = int(hours * share * 3600) * RATE_HZ
        path = folder / 'day.mcap'
        write_bag(path, n, compression)
        reading = seconds(lambda path=path: read(path), repeats)
        both = seconds(lambda path=path: read_and_compensate(path), repeats)
        n_out, alone = compensate(path)
        assert n_out == n
        print(
            f'{hours * share:7.2f} {n:9d}  {reading[0]:6.2f} ({reading[1]:6.2f})'
            f' {both[0]:6.2f} ({both[1]:6.2f})'
            f' {both[0] / reading[0]:5.2f} ({both[1] / reading[1]:5.2f}) {n / alone / 1e6:6.1f}'
        )
        lengths.append(n)
        times.append(both[1])
        path.unlink()
    slope = np.polyfit(np.log(lengths), np.log(times), 1)[0]
    print(f'CPU time of reading and compensating grows as (number of samples)^{slope:.2f}')


def memory(folder: Path, gigabytes: float) -> None:
    """Replay a large bag in a separate process and print its peak memory."""
    path, output = folder / 'large.mcap', folder / 'large_out.mcap'
    per_sample = 99  # size of a counts message in an uncompressed MCAP [bytes], approximately
    write_bag(path, int(gigabytes * 1e9 / per_sample), 'none')
    size = path.stat().st_size
    code = (
        'import resource, sys; sys.path.insert(0, sys.argv[3]); import replay as r;'
        'from pathlib import Path; n = r.ours(Path(sys.argv[1]), Path(sys.argv[2]));'
        'print(n, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)'
    )
    here = str(Path(__file__).resolve().parent)
    begin = time.perf_counter()
    result = subprocess.run(
        [sys.executable, '-c', code, path, output, here],
        capture_output=True,
        check=True,
        text=True,
    )
    n, peak = result.stdout.split()
    spent = time.perf_counter() - begin
    print(f'replay of {size / 1e9:.1f} GB, {n} samples: peak memory {peak} MB, {spent:.0f} s')


def main() -> None:
    """Measure reading, compensating and writing, and print the tables."""
    parser = argparse.ArgumentParser(description='Times `replay` and a script with rosbags.')
    parser.add_argument('--samples', type=int, default=1_000_000, help='samples of the bags')
    parser.add_argument('--hours', type=float, default=2.0, help='length of the bag to read [h]')
    parser.add_argument('--compression', default='zstd', choices=('none', 'lz4', 'zstd'))
    parser.add_argument('--gigabytes', type=float, default=0.0, help='size of the large bag [GB]')
    parser.add_argument('--repeats', type=int, default=2, help='runs of each measurement')
    options = parser.parse_args()
    print(
        f'{platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}, '
        f'numpy {np.__version__}'
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pipelines(folder, options.samples, options.repeats)
        day(folder, options.hours, options.compression, options.repeats)
        if options.gigabytes:
            memory(folder, options.gigabytes)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f'peak memory of this process {peak_mb:.0f} MB')


if __name__ == '__main__':
    main()
