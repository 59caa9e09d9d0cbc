# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A node process publishes no wrong output at restarts, signals, reloads and wrong files."""

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

import soak
from fault_bench import bench
from fault_rig import RATE_HZ, SIGMAS, START_NS, bag, corrected, ratios_to_sd, seconds_of, unit
from node_process import OVER_UDP

from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import SIZE_LIMIT, dump_calibration, save_calibration

SLOW = pytest.mark.slow


@pytest.fixture
def path(tmp_path):
    save_calibration(unit(), tmp_path / 'unit.yaml')
    return tmp_path / 'unit.yaml'


@pytest.fixture
def node(path):
    with bench(path) as started:
        yield started


def sigmas(heard):
    seconds = (heard.stamp_ns - START_NS) * 1e-9
    return ratios_to_sd(heard.force, heard.covariance, seconds).max()


def test_a_restarted_publisher_changes_no_output(node):
    events = bag(duration_s=100.0)
    first = node.play([e for e in events if seconds_of(e[1]) < 50.0])
    node.restart_publishers()
    second = node.play([e for e in events if seconds_of(e[1]) >= 50.0])
    _, table = corrected(events)
    np.testing.assert_array_equal(np.concatenate((first.force, second.force)), table[:, :3])
    assert second.values['lost'] == '0'


@pytest.mark.slow
def test_a_node_killed_in_a_ramp_restarts_with_larger_covariance(path):
    events = [e for e in bag() if seconds_of(e[1]) < 300.0]
    _, undisturbed = corrected(events)
    with bench(path, **OVER_UDP) as node:
        before = node.play([e for e in events if seconds_of(e[1]) < 90.0])
        assert sigmas(before) < SIGMAS
        assert before.values['regime'] == 'dynamic'
        assert node.process.stop(signal.SIGKILL) == -signal.SIGKILL
        assert 'Traceback' not in node.process.said
        node.is_ended = True
    with bench(path) as node:
        first = node.play([e for e in events if 90.0 <= seconds_of(e[1]) < 91.0])
        assert (first.values['regime'], first.values['memory settled']) == ('unknown', 'False')
        rest = node.play([e for e in events if seconds_of(e[1]) >= 91.0])
    n = len(first.force)
    # After a start lag states are unknown, so the covariance is larger than without a restart.
    at = round(90.0 * RATE_HZ)
    assert (first.covariance[:, 0, 0] > 4.0 * undisturbed[at : at + n, 3].max()).all()
    assert max(sigmas(first), sigmas(rest)) < SIGMAS
    late = rest.stamp_ns > START_NS + 280 * 1_000_000_000
    expected = undisturbed[-late.sum() :, :3]
    np.testing.assert_allclose(rest.force[late], expected, rtol=0.0, atol=9.80665e-6)


def replaced(path):
    path.write_text(dump_calibration(unit(unit=Unit('F-2', 'counts', 8388607.0, 0.08))))


def truncated(path):
    path.write_bytes(path.read_bytes()[:-300])


def cut_between_keys(path):
    # WHY: a file cut before `misalignment_sd` was accepted, as all later keys have defaults.
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b'\nmisalignment_sd:') + 1])


def unreadable(path):
    if os.geteuid():
        path.chmod(0)
    else:
        # Root can open any file, but not even root can read the first byte of /proc/self/mem.
        path.unlink()
        path.symlink_to('/proc/self/mem')


def aliases(path):
    lines = ['a0: &a0 [x, x, x, x, x, x, x, x, x]']
    lines += [f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 9)}]' for k in range(1, 30)]
    path.write_text('\n'.join(lines))


def directory(path):
    path.unlink()
    path.mkdir()


def fifo(path):
    path.unlink()
    os.mkfifo(path)


DAMAGES = {
    replaced: "unit.serial: must be 'F-1'", truncated: 'the file is cut',
    cut_between_keys: 'the file is cut', unreadable: 'cannot be read: ',
    lambda path: os.truncate(path, 1 << 30): f'at most {SIZE_LIMIT} are accepted',
    aliases: 'YAML aliases are not accepted', directory: 'cannot be read: ',
    fifo: 'cannot be read: not a regular file',
    Path.unlink: 'cannot be read: No such file or directory',
}  # fmt: skip


def test_bad_calibration_files_leave_the_running_calibration(path, tmp_path):
    events = bag(duration_s=90.0)
    good = path.read_bytes()
    heard = []
    with bench(path, 'serial:=F-1') as node:
        for k, (damage, reason) in enumerate(DAMAGES.items()):
            bad = tmp_path / f'bad{k}.yaml'
            bad.write_bytes(good)
            result = node.set_parameters(calibration_file=str(bad))
            assert result.successful, result.reason
            damage(bad)
            begin, end = 10.0 * k, 10.0 * (k + 1)
            heard.append(node.play([e for e in events if begin <= seconds_of(e[1]) < end]))
            result = node.set_parameters(calibration_file=str(bad))
            assert not result.successful
            assert result.reason.startswith(f'{bad}: ')
            assert reason in result.reason
            assert '\n' not in result.reason
    n = sum(len(block.force) for block in heard)
    table = corrected(events)[1][:n, :3]
    force = np.concatenate([block.force for block in heard])
    np.testing.assert_allclose(force, table, rtol=0.0, atol=1e-9)
    assert n == sum(e[0] == 'counts' for e in events if seconds_of(e[1]) < 10.0 * len(DAMAGES))


@pytest.mark.slow
def test_many_reloads_at_1_khz_lose_no_sample(tmp_path):
    path = tmp_path / 'fast.yaml'
    save_calibration(unit(unit=Unit('F-1', 'counts', 8388607.0, 1e-3)), path)
    # The test stops sending at the answer to the last reload, before the end of the 60 s.
    events = bag(rate_hz=1000.0, duration_s=60.0)
    n_reloads = 100
    with bench(path) as node:
        answers, news = list[bool](), threading.Event()
        node.take()

        def ask():
            future = node.ask(calibration_file=str(path))
            future.add_done_callback(lambda _: news.set())
            return future

        asked = [ask() for _ in range(20)]
        begin, n, n_samples = time.monotonic(), 0, 0
        while len(answers) < n_reloads and n < len(events):
            while n < len(events) and seconds_of(events[n][1]) < time.monotonic() - begin:
                n_samples += node.send([events[n]])
                n += 1
            answered = [future for future in asked if future.done()]
            answers += [future.result().results[0].successful for future in answered]
            asked = [future for future in asked if future not in answered]
            asked += [ask() for _ in answered]
            if n < len(events):
                news.wait(max(0.0, begin + seconds_of(events[n][1]) - time.monotonic()))
                news.clear()
        node.settle()
        heard = node.take()
    assert len(answers) >= n_reloads
    assert all(answers)
    assert len(heard.force) == n_samples
    # One sample in a million has an error above 5 sd by noise alone; for all samples 6 sd suffice.
    assert sigmas(heard) < SIGMAS + 1.0


@pytest.mark.parametrize('number', [signal.SIGINT, pytest.param(signal.SIGTERM, marks=SLOW)])
def test_a_signal_while_samples_flow_ends_the_node_cleanly(path, number):
    with bench(path) as node:
        heard = node.play(bag(duration_s=20.0))
        node.send(bag(duration_s=40.0, start_s=20.0))
        node.process.process.send_signal(number)
        # A launch without a terminal passes Ctrl-C on to a node that has already received it.
        assert node.process.stop(signal.SIGTERM if number == signal.SIGINT else signal.SIGINT) == 0
        assert node.process.said == ''
        node.is_ended = True
    assert sigmas(heard) < SIGMAS


def test_the_slope_of_the_soak_benchmark_has_the_claimed_standard_error(rng):
    time = np.arange(3600.0)
    values = 100.0 + 7.0 * time / 3600.0 + rng.standard_normal(3600)
    # `slope` leaves out the first 10 % of the run, here 360 s.
    values[:300] += 50.0
    slope, sd = soak.slope(list(zip(time.tolist(), values.tolist(), strict=True)), 60.0)
    # Expected sd: sd of a mean over 60 s / sqrt(sum of (t - mean t)^2) over the 54 means.
    assert sd == pytest.approx(1.0 / 60**0.5 / (54 * 0.9**2 / 12) ** 0.5, rel=0.3)
    assert abs(slope - 7.0) < 4.0 * sd
    assert soak.slope([(0.0, 1.0), (1.0, 1.0)], 60.0) is None
