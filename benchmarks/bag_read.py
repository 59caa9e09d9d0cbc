# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures the speed of reading a bag, by thermo_comp, rosbags and mcap in one run.

All bags hold counts at 400 Hz and two temperatures at 10 Hz; rosbags and mcap get shorter bags
(`--peer-samples`). `rosbags` reads and deserializes each message; `mcap` only reads each message.
A rate is the number of counts messages read per second of wall time, in the fastest of the
repeats. Ratios between the rates of two readers vary less from machine to machine than the rates.
For 'blocks' and 'whole' in the table thermo_comp reads a bag by blocks, or whole into memory.

    python benchmarks/bag_read.py --samples 1000000
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from thermo_comp.recording.reader import open_recording, read_recording
from thermo_comp.recording.writer import BagWriter

START_NS = 1_700_000_000_000_000_000
RATE_HZ = 400
TEMPERATURE_HZ = 10
CHUNK_BYTES = 1 << 20
COMPRESSIONS = ('none', 'lz4', 'zstd')


def write_bag(path: Path, n: int, compression: str, chunk_bytes: int) -> None:
    """Write a bag with n messages of counts at 400 Hz, and two temperatures at 10 Hz."""
    rng = np.random.default_rng(1)
    block = 1 << 17
    with BagWriter(path, compression=compression, chunk_bytes=chunk_bytes) as bag:
        for begin in range(0, n, block):
            index = np.arange(begin, min(begin + block, n))
            stamp_ns = START_NS + index * (1_000_000_000 // RATE_HZ)
            xyz = np.round(rng.normal([200.0, -3000.0, 28000.0], 8.0, (len(index), 3)))
            bag.write_counts('accel/counts', stamp_ns, xyz, 'accel_link')
            slow = stamp_ns[index % (RATE_HZ // TEMPERATURE_HZ) == 0]
            celsius = 20.0 + 15.0 * np.sin((slow - START_NS) * 1e-9 / 600.0)
            bag.write_temperature('temperature/board', slow, np.round(celsius / 0.005) * 0.005)
            bag.write_temperature('temperature/case', slow, celsius + 0.3)
            bag.flush()


def read_ours_whole(path: Path) -> int:
    """Read a whole bag into memory with thermo_comp."""
    return len(read_recording(path).columns)


def read_ours_blocks(path: Path) -> int:
    """Read a bag block by block with thermo_comp, as `replay` does."""
    with open_recording(path) as reader:
        return sum(len(block) for block in reader.blocks())


def read_rosbags(path: Path) -> int:
    """Read and deserialize every message with rosbags."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    typestore = get_typestore(Stores.ROS2_JAZZY)
    n = 0
    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            message = typestore.deserialize_cdr(data, connection.msgtype)
            n += hasattr(message, 'vector')
    return n


def read_mcap(path: Path) -> int:
    """Read every message with mcap, without decoding."""
    from mcap.reader import make_reader

    n = 0
    with path.open('rb') as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            n += channel.topic == '/accel/counts' and len(message.data) > 0
    return n


def timed(read: Callable[[Path], int], path: Path, n: int) -> tuple[float, float]:
    """Return wall and CPU time of reading a bag, per counts message [s]."""
    wall, cpu = time.perf_counter(), time.process_time()
    content = read(path)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    assert content == n, f'{content} messages read, {n} written'
    return wall / n, cpu / n


def measure(
    folder: Path, n: int, n_peers: int, repeats: int, chunk_bytes: int
) -> Iterator[dict[str, Any]]:
    """Yield a row per compression: for each reader the shortest time of all repeats."""
    for compression in COMPRESSIONS:
        ours, peers = folder / f'{compression}.mcap', folder / f'{compression}_peers.mcap'
        write_bag(ours, n, compression, chunk_bytes)
        write_bag(peers, n_peers, compression, chunk_bytes)
        readers = {
            'rosbags': (read_rosbags, peers, n_peers),
            'mcap': (read_mcap, peers, n_peers),
            'blocks': (read_ours_blocks, ours, n),
            'whole': (read_ours_whole, ours, n),
        }
        times = {name: (float('inf'), float('inf')) for name in readers}
        for _ in range(repeats):
            for name, (read, path, count) in readers.items():
                wall, cpu = timed(read, path, count)
                times[name] = (min(times[name][0], wall), min(times[name][1], cpu))
        yield {
            'compression': compression,
            'bytes_per_message': ours.stat().st_size / n,
            'rates': {name: 1.0 / wall for name, (wall, _) in times.items()},
            'cpu_s_per_message': {name: cpu for name, (_, cpu) in times.items()},
            'blocks_to_rosbags': times['rosbags'][0] / times['blocks'][0],
            'blocks_to_rosbags_cpu': times['rosbags'][1] / times['blocks'][1],
        }
        ours.unlink()
        peers.unlink()


def main() -> None:
    """Measure all readers and print the table."""
    parser = argparse.ArgumentParser(description='Measures how fast bags are read.')
    parser.add_argument(
        '--samples', type=int, default=2_000_000, help='messages that thermo_comp reads'
    )
    parser.add_argument(
        '--peer-samples', type=int, default=200_000, help='messages that rosbags and mcap read'
    )
    parser.add_argument('--repeats', type=int, default=3, help='runs of each reader')
    parser.add_argument('--chunk-bytes', type=int, default=CHUNK_BYTES, help='size of a chunk')
    parser.add_argument('--json', action='store_true', help='print JSON')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = list(
            measure(
                Path(folder),
                options.samples,
                options.peer_samples,
                options.repeats,
                options.chunk_bytes,
            )
        )
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    machine = f'{platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}'
    machine += f', numpy {np.__version__}'
    if options.json:
        json.dump({'machine': machine, 'peak_mb': peak_mb, 'rows': rows}, sys.stdout, indent=1)
        print()
        return
    print(f'{machine}; {options.samples} samples, chunks of {options.chunk_bytes} bytes')
    print('             bytes      million messages per second        speed: blocks / rosbags')
    print('compression  /msg  rosbags   mcap  blocks   whole        wall time   CPU time')
    for row in rows:
        million = ''.join(f'{rate / 1e6:8.2f}' for rate in row['rates'].values())
        print(
            f'{row["compression"]:11}{row["bytes_per_message"]:6.1f}{million}'
            f'{row["blocks_to_rosbags"]:14.1f} x{row["blocks_to_rosbags_cpu"]:9.1f} x'
        )


if __name__ == '__main__':
    main()
