# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The rest log has the right content and size, also after a kill of the node or on a full disk."""

import json
import signal
import threading
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

from builders import calibration
from diagnostic_msgs.msg import DiagnosticArray
from node_process import OVER_UDP, NodeProcess
from ros_helpers import SECOND_NS, START_NS, Driver, drive, node_arguments, node_in_thread

from thermo_comp.errors import OutputError
from thermo_comp.field.gather import RestFinder
from thermo_comp.field.rest import Rest, Start, decode, encode, thinned
from thermo_comp.ros import rest_log
from thermo_comp.ros.rest_log import RestLog
from thermo_comp.thermal.lags import MemorySpec
from thermo_comp.unit.calibration_file import save_calibration

RATE_HZ, CYCLE_NS = 50, 20_000_000
NOISE = 0.01  # noise of a sample [m/s^2]: 3 counts at 300 per m/s^2
START = Start(START_NS, 'T-1', 'counts', 9.80665, 'abc', MemorySpec(('case',), (('board', 60.0),)))


def rest(number):
    stamp, state = START_NS + number * 10 * SECOND_NS, (20.0, 1e-6, 0.0, 0.0, 0.0, 0.5, 1e-6)
    return Rest(stamp, 1000, (1.0, -2.0, 2941.25), (3.0,) * 3, (*state, 0.25, 0.0), (0.5,))


def test_rests_with_and_without_angular_rates_are_read_back_unchanged():
    between = ('board', 600.0, 60.0, 'case', 0.4)
    memory = MemorySpec(('case',), (('board', 60.0), between), ((600.0, 0.8, *between[2:]),),
                        ('case',))  # fmt: skip
    start = replace(START, memory=memory)
    row = rest(1)
    row = replace(row, shares=(0.5, 0.25),
                  state=(*row.state[:7], 0.01, 1e-9, *row.state[7:], 0.4, 0.0, 0.2))  # fmt: skip
    assert decode(encode(start) + encode(row)) == ([(start, row)], 0)
    assert b'"memory":[["case"],[["board",60.0]],[]]' in encode(START)


@pytest.fixture
def unit(tmp_path):
    path = tmp_path / 'unit.yaml'
    density = float(NOISE / np.sqrt(RATE_HZ))
    save_calibration(calibration(noise_density_m_s2_sqrt_hz=(density,) * 3), path)
    return path


def standing(n, seed=1):
    rng = np.random.default_rng(seed)
    return np.round((30.0, -20.0, 2941.0) + 300.0 * NOISE * rng.standard_normal((n, 3)))


def send(driver, samples, begin=0, rate_k_s=0.0):
    for k, sample in enumerate(samples.tolist(), begin):
        if k % RATE_HZ == 0:
            driver.temperatures(START_NS + k * CYCLE_NS, 21.0 + rate_k_s * k / RATE_HZ, 21.5)
        driver.counts(START_NS + k * CYCLE_NS, *sample)


def logged(folder):
    return [row for file in sorted(folder.glob('*.rests')) for row in decode(file.read_bytes())[0]]


def finder():
    given = np.full(3, 300.0), np.full(3, NOISE**2), 32767.0
    return RestFinder(*given, lambda: ((20.0,) * 7, ()), 1.0 / RATE_HZ)


def check_blocks(stamps, samples, cuts, whole):
    """Check that samples in blocks give the rests `whole`, found in all samples at once."""
    pieces, found = finder(), []
    for cut in np.split(np.arange(len(samples)), cuts):
        if len(cut):
            found += pieces.add(stamps[cut], samples[cut])
    assert [row.stamp_ns for row in found] == [row.stamp_ns for row in whole]
    assert np.allclose([row.mean for row in found], [row.mean for row in whole], atol=1e-9)


def test_logged_windows_are_means_over_10_s_at_rest_with_a_mean_rate_if_none_is_missing():
    # A rest of 25 s, 1 s of handling and a rest of 21 s: each rest has two windows of 10 s.
    first, second = standing(25 * RATE_HZ), standing(21 * RATE_HZ, 2)[:, [2, 1, 0]]
    handled = first[:RATE_HZ] + np.linspace(0.0, 900.0, RATE_HZ)[:, None]
    samples = np.concatenate((first, handled, second))
    stamps = START_NS + np.arange(len(samples)) * CYCLE_NS
    whole = finder().add(stamps, samples)
    assert [(row.stamp_ns - START_NS) / SECOND_NS for row in whole] == [5.0, 15.0, 31.0, 41.0]
    parts = [part[k : k + 500] for part in (first, second) for k in (0, 500)]
    for row, part in zip(whole, parts, strict=True):
        assert np.allclose(row.mean, part.mean(axis=0), atol=1e-9)
        assert np.allclose(row.sd, part.std(axis=0), rtol=0.05)
    check_blocks(stamps, samples, [7, 333, 334, 1201], whole)
    # WHY: messages with and without rates had 6 and 3 columns, which ended the log.
    samples = np.hstack((standing(25 * RATE_HZ), np.full((25 * RATE_HZ, 3), 0.01)))
    samples[7, 3:] = np.nan
    stamps = START_NS + np.arange(len(samples)) * CYCLE_NS
    first, second = finder().add(stamps, samples)
    assert (first.rate, len(second.rate)) == ((), 3)
    # The second that lacks an acceleration does not count as a rest.
    samples[7, :3] = np.nan
    rests = finder().add(stamps, samples)
    assert [(row.stamp_ns - START_NS) / SECOND_NS for row in rests] == [6.0, 16.0]


@pytest.mark.parametrize('rate', [1.0, 2.0, 3.3, 5.0, 50.0, 2000.0])
def test_rests_are_found_at_any_rate_of_samples(rate, rng):
    # Two rests last a minute; stamps have jitter; above `RATE_HZ` the noise density is constant.
    n = round(120 * rate)
    cycles = np.arange(n) + 0.1 * rng.uniform(-1.0, 1.0, n)
    stamps = START_NS + np.rint(cycles * SECOND_NS / rate).astype(np.int64)
    excess = np.sqrt(max(1.0, rate / RATE_HZ))
    samples = (30.0, -20.0, 2941.0) + 300.0 * NOISE * excess * rng.standard_normal((n, 3))
    samples[n // 2 :] = samples[n // 2 :, [2, 1, 0]]
    whole = finder().add(stamps, samples)
    # At most two windows are lost at the change of attitude, and one window at the end.
    assert sum(row.n for row in whole) >= 0.6 * n
    assert len(whole) >= 6
    for row in whole:
        is_first = row.stamp_ns < START_NS + 60 * SECOND_NS
        expected = (30.0, -20.0, 2941.0) if is_first else (2941.0, -20.0, 30.0)
        assert np.abs(np.array(row.mean) - expected).max() < 5.0 * 3.0 * excess / np.sqrt(row.n)
    check_blocks(stamps, samples, np.sort(rng.choice(n, 20, replace=False)), whole)


@pytest.mark.parametrize('fault', ['moves', 'shakes', 'stuck', 'tilts', 'saturated', 'gap'])
def test_motion_and_bad_samples_are_not_logged_as_rests(fault):
    samples = standing(12 * RATE_HZ)
    stamps = START_NS + np.arange(len(samples)) * CYCLE_NS
    if fault == 'moves':
        samples[300:] += 30.0  # step of 0.1 m/s^2
    elif fault == 'shakes':
        samples += 60.0 * np.sin(np.arange(len(samples)))[:, None]
    elif fault == 'stuck':
        samples[:] = samples[0]
    elif fault == 'tilts':
        samples[:, 0] += np.linspace(0.0, 100.0, len(samples))  # tilt by 3 mrad/s
    elif fault == 'saturated':
        samples[:, 0] = 32767.0
    else:
        stamps[300:] += 5 * SECOND_NS
    assert finder().add(stamps, samples) == []


def test_a_long_rest_is_logged_with_increasing_intervals():
    # 60 windows of a rest are logged in its first 10 min, 1 per min up to 1 h, then 1 per 5 min.
    kept, searching = 0, finder()
    samples = standing(6 * 60)
    for minute in range(71):
        stamps = START_NS + (np.arange(len(samples)) + minute * len(samples)) * SECOND_NS // 6
        kept += len(searching.add(stamps, samples))
    assert kept == 60 + 50 + 3


@given(st.integers(0, 2000), st.integers(0, 255))
def test_a_damaged_rest_log_loses_only_the_damaged_lines(place, value):
    content = encode(START) + b''.join(encode(rest(k)) for k in range(9))
    whole, n_damaged = decode(content)
    assert n_damaged == 0
    assert [row for _, row in whole] == [rest(k) for k in range(9)]
    assert {start for start, _ in whole} == {START}
    cut = decode(content[:place])[0]
    assert cut == whole[: len(cut)]
    changed = bytearray(content)
    changed[place % len(content)] = value
    left = [row for _, row in decode(bytes(changed))[0]]
    # One wrong byte loses a rest, a wrong newline two, a wrong line of a start all its rests.
    assert all(row in [rest(k) for k in range(9)] for row in left)
    assert len(left) >= 7 or place % len(content) < len(encode(START))


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=5), inner),
        max_leaves=12,
    ),
    st.integers(0, 6),
)
def test_a_line_with_a_right_checksum_and_wrong_content_is_counted_as_damaged(value, place):
    good = json.loads(encode(rest(0))[9:])
    for data in (value, [*good[:place], value, *good[place + 1 :]]):
        text = json.dumps(data).encode()
        rests, n_damaged = decode(encode(START) + b'%08x %s\n' % (zlib.crc32(text), text))
        assert len(rests) + n_damaged == 1
        for _, row in rests:
            assert np.isfinite([*row.mean, *row.sd, *row.state, *row.shares]).all()
            assert (len(row.mean), len(row.sd), len(row.state)) == (3, 3, 9)


def test_thinning_halves_the_rests_and_keeps_each_start():
    starts = [replace(START, start_ns=START_NS + k) for k in range(3)]
    lines = [encode(start) + b''.join(map(encode, map(rest, range(5)))) for start in starts]
    content = thinned(b''.join(lines))
    rests = decode(content)[0]
    assert [row.stamp_ns for _, row in rests] == 3 * [rest(k).stamp_ns for k in (0, 2, 4)]
    while len(content) > len(thinned(content)):
        content = thinned(content)
    assert [start for start, _ in decode(content)[0]] == starts


def test_the_size_of_a_rest_log_is_limited_per_day_and_in_total(tmp_path, monkeypatch):
    monkeypatch.setattr(rest_log, 'DAY_BYTES', 2000)
    monkeypatch.setattr(rest_log, 'FOLDER_BYTES', 5000)
    monkeypatch.setattr(rest_log, '_UNTHINNED_BYTES', 500)
    log = RestLog(str(tmp_path))
    for day in range(6):
        for k in range(40):
            log.put(rest(day * 8640 + k).stamp_ns, encode(START), encode(rest(day * 8640 + k)))
    log.close(10.0)
    sizes = [file.stat().st_size for file in sorted(tmp_path.glob('*.rests'))]
    assert len(sizes) == 6
    assert max(sizes) <= 2000
    assert sum(sizes) <= 5000 + 2000
    assert sizes[0] < sizes[-1] / 2
    assert log.n_rests == len(logged(tmp_path))
    assert (log.n_days, log.n_lost, log.reason) == (6, 0, '')


def test_rests_that_cannot_be_kept_are_counted_and_impossible_folders_refused(small_disk, unit):
    log = RestLog(str(small_disk))
    for k in range(100):
        log.put(rest(k).stamp_ns, encode(START), encode(rest(k)))
    log.close(10.0)
    kept = logged(small_disk)
    assert 0 < len(kept) < 100
    assert (log.n_rests, log.n_lost) == (len(kept), 100 - len(kept))
    assert log.reason == 'No space left on device'
    with pytest.raises(OutputError, match='rests: parameter `rest_log`: Not a directory'):
        RestLog(f'{unit}/rests')


def test_a_killed_node_damages_at_most_one_line_of_its_rest_log(tmp_path, unit, peer):
    folder = tmp_path / 'rests'
    samples = standing(200 * RATE_HZ)
    words = node_arguments(unit, f'rest_log:={folder}')
    sent = 0

    def until(condition, what):
        """Send bursts of 50 samples until a condition holds; samples before discovery are lost."""
        nonlocal sent
        pause = threading.Event()
        for _ in range(len(samples) // RATE_HZ):
            send(driver, samples[sent : sent + RATE_HZ], sent)
            sent += RATE_HZ
            if condition():
                return
            pause.wait(0.02)
        raise AssertionError(f'{what} did not come true')

    with NodeProcess(*words, **OVER_UDP) as process:
        driver = Driver(peer)
        until(lambda: bool(logged(folder)), 'a rest on the disk')
        assert process.stop(signal.SIGKILL) == -signal.SIGKILL
    (file,) = folder.iterdir()
    assert file.name == '2026-01-01.rests'
    with file.open('ab') as torn:
        torn.write(encode(rest(9))[:40])
    before = logged(folder)
    # The node appends its rests after the incomplete line.
    with node_in_thread(*words) as node:
        heard = peer.listen(DiagnosticArray, '/diagnostics')
        peer.join(node)
        until(lambda: len(logged(folder)) > len(before), 'a rest of the second start')

        def message():
            values = {value.key: value.value for a in heard[-1:] for value in a.status[0].values}
            return values.get('rests gathered') == str(len(logged(folder)))

        peer.wait_for(message, 'the number of rests in the diagnostics')
    rests = logged(folder)
    assert decode(file.read_bytes())[1] == 1
    last = rests[len(before)][1]
    begin = round((last.stamp_ns - START_NS) / SECOND_NS - 5.0) * RATE_HZ
    assert np.allclose(last.mean, samples[begin : begin + 10 * RATE_HZ].mean(axis=0), atol=1e-5)
    assert (last.n, last.state[0]) == (10 * RATE_HZ, pytest.approx(21.0, abs=1e-6))
    assert len({start.start_ns for start, _ in rests}) == 2
    assert {start.serial for start, _ in rests} == {'T-1'}


def test_a_rest_has_the_temperature_at_its_own_time_at_any_speed_of_playing(tmp_path, unit, peer):
    folder, rate_k_s = tmp_path / 'rests', 0.02
    words = node_arguments(unit, f'rest_log:={folder}', 'diagnostics_period:=1.0')
    with node_in_thread(*words) as node:
        driver, samples = drive(peer, node), standing(40 * RATE_HZ)
        send(driver, samples, rate_k_s=rate_k_s)
        # Samples of two seconds that arrive again must neither change a rest nor cause an error.
        send(driver, samples[-2 * RATE_HZ :], 38 * RATE_HZ, rate_k_s)
        peer.poll(lambda: len(logged(folder)) >= 3, 'three rests on the disk')
        counters = node._relay.running.compensator.counters
        peer.poll(lambda: counters.n_in >= 42 * RATE_HZ, 'the repeated samples')
        assert node._loop.n_failures == 0
    for _, row in logged(folder):
        true = 21.0 + rate_k_s * (row.stamp_ns - START_NS) / SECOND_NS
        assert row.state[0] == pytest.approx(true, abs=rate_k_s)


def test_the_diagnostics_warn_of_a_full_disk(small_disk, unit, peer):
    (small_disk / 'other').write_bytes(bytes(1 << 13)[: 1 << 12])
    with node_in_thread(*node_arguments(unit, f'rest_log:={small_disk}')) as node:
        heard = peer.listen(DiagnosticArray, '/diagnostics')
        driver = drive(peer, node)
        send(driver, standing(12 * RATE_HZ))
        text = 'not kept in the rest log: No space left on device'
        peer.wait_for(lambda: any(text in each.status[0].message for each in heard), text)
