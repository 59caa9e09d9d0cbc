# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Holds the live view: it follows its files, survives bad ones, and answers to nobody else."""

from __future__ import annotations

import http.client
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import urllib.request
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest
from builders import calibration
from conftest import ROOT
from report_helpers import certificate, fitted, write_bag

from thermo_comp.report import live
from thermo_comp.report.live import MOST_CLIENTS, LiveReport, LiveServer
from thermo_comp.unit.calibration import Calibration
from thermo_comp.unit.calibration_file import save_calibration

pytestmark = pytest.mark.usefixtures('equal_fits_once')

TIMEOUT_S = 60.0


@contextmanager
def served(report: LiveReport) -> Iterator[LiveServer]:
    server = LiveServer(report)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join(TIMEOUT_S)


def save(path: Path, note: str, one: Calibration | None = None) -> Path:
    # The least to draw: what is drawn is tested with the page.
    one = calibration() if one is None else one
    save_calibration(replace(one, provenance=replace(one.provenance, notes=(note,))), path)
    return path


@pytest.fixture
def unit(tmp_path) -> Path:
    return save(tmp_path / 'unit.yaml', 'first note')


def get(url: str) -> str:
    with urllib.request.urlopen(url, timeout=TIMEOUT_S) as answer:  # noqa: S310 - our own server
        return answer.read().decode()


def test_page_follows_the_file_and_outlives_a_bad_one(unit):
    report = LiveReport(unit)
    before = report.version()
    assert report.version() == before
    assert 'first note' in report.page()
    save(unit, 'second note')
    assert report.version() != before
    assert 'second note' in report.page()
    good = unit.read_text()
    unit.write_text(good.replace('gravity_m_s2', 'levity_m_s2'))
    page = report.page()
    assert 'levity_m_s2' in page
    assert 'The page below is older.' in page
    assert 'second note' in page
    unit.write_text(good)
    assert 'older' not in report.page()


def test_clients_that_say_nothing_grow_no_threads(unit, monkeypatch):
    # WHY: each of 900 half-open connections had a thread of its own, for half a minute. WHAT: some
    # are heard at a time, and dropped at the time-out, which is short here.
    monkeypatch.setattr(live._Handler, 'timeout', 0.1)
    with served(LiveReport(unit)) as server:
        before = threading.active_count()
        most, silent = 0, []
        for number in range(100):
            client = socket.create_connection(server.server_address, TIMEOUT_S)
            if number % 2:
                with suppress(ConnectionError):
                    client.sendall(b'GET / HT')
            most = max(most, threading.active_count() - before)
            silent.append(client)
        for client in silent:
            most = max(most, threading.active_count() - before)
            with suppress(ConnectionError):
                assert client.recv(1) == b''
            client.close()
        assert 0 < most <= MOST_CLIENTS
        assert 'first note' in get(server.url)


def test_a_client_that_goes_away_is_no_news(unit, capfd):
    with served(LiveReport(unit)) as server:
        client = socket.create_connection(server.server_address)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
        client.sendall(b'GET / HT')
        client.close()  # with a reset
        assert 'first note' in get(server.url)
    assert capfd.readouterr().err == ''


def test_first_bad_file_makes_a_page_that_goes_on_asking(tmp_path):
    bad = tmp_path / 'unit.yaml'
    bad.write_text('format_version: <b>1</b>')
    report = LiveReport(bad)
    page = report.page()
    assert 'nothing to show yet' in page
    assert 'fetch("version"' in page
    assert '<b>1' not in page
    bad.unlink()
    assert 'No such file' in report.page()


def test_bag_is_read_once_and_judged_again(tmp_path):
    # Without the drawing, which takes seconds: what is drawn is tested with the page.
    one = fitted().calibration
    unit = save(tmp_path / 'unit.yaml', 'first note', one)
    bag = write_bag(tmp_path / 'held_out.mcap')
    told = []
    report = LiveReport(unit, [bag], read=lambda info: told.append(info.path.name))
    assert report.evidence().bags[0].source.name == 'held_out.mcap'
    ((_, opened),) = report._opened.values()
    save(unit, 'second note', one)
    assert report.evidence().findings == ('second note',)
    ((_, again),) = report._opened.values()
    assert again is opened
    assert told == ['held_out.mcap']
    bag.unlink()
    write_bag(bag, 1)
    report.evidence()
    ((_, other),) = report._opened.values()
    assert other is not opened


def test_script_runs_by_the_page_s_own_leave_only(unit):
    page = LiveReport(unit).page()
    (nonce,) = {part.split('"')[0] for part in page.split('<script nonce="')[1:]}
    assert f"script-src 'nonce-{nonce}'; connect-src 'self'" in page
    assert page.count('<script') == 1


def test_server_answers_its_own_names_only(unit):
    with served(LiveReport(unit)) as server:
        assert server.server_address[0] == '127.0.0.1'
        assert get(f'{server.url}version') == server.report.version()
        for path, host, status in (
            ('/', f'127.0.0.1:{server.server_port}', 200),
            ('/version', f'localhost:{server.server_port}', 200),
            ('/', f'evil.example:{server.server_port}', 403),
            ('/version', '127.0.0.1', 403),
            ('/../unit.yaml', f'127.0.0.1:{server.server_port}', 404),
        ):
            connection = http.client.HTTPConnection('127.0.0.1', server.server_port)
            connection.request('GET', path, headers={'Host': host})
            answer = connection.getresponse()
            answer.read()
            assert answer.status == status
            assert answer.headers['Cache-Control'] == 'no-store'
            connection.close()


class Watched(LiveReport):
    """Tells when the browser has come for the page, and for its version after that."""

    def __init__(self, calibration: Path) -> None:
        super().__init__(calibration)
        self.shown: list[str] = []
        self.changed = threading.Condition()

    def page(self) -> str:
        page = super().page()
        with self.changed:
            self.shown.append('second' if 'second note' in page else 'first')
            self.changed.notify_all()
        return page

    def wait_for(self, expected: list[str]) -> bool:
        with self.changed:
            return self.changed.wait_for(lambda: self.shown[-1:] == expected, TIMEOUT_S)


HEADLESS = (
    *('--headless', '--no-sandbox', '--disable-gpu', '--no-first-run', '--disable-sync'),
    *('--disable-background-networking', '--disable-component-update'),
)


def browser() -> str:
    found = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser'))), None)
    if found is None:
        pytest.skip('no Chromium here (Debian: apt install chromium)')
    return found


@contextmanager
def browsing(url: str, profile: Path) -> Iterator[None]:
    command = [
        browser(),
        *HEADLESS,
        f'--user-data-dir={profile}',
        '--remote-debugging-port=0',  # keeps it alive, on a port of its own
        url,
    ]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(TIMEOUT_S)


def test_browser_reloads_when_the_fit_runs_again(unit, tmp_path):
    report = Watched(unit)
    with served(report) as server, browsing(server.url, tmp_path / 'profile'):
        assert report.wait_for(['first'])
        save(unit, 'second note')
        assert report.wait_for(['second'])


def test_browser_draws_the_page_for_a_phone_whole_and_without_a_complaint(tmp_path):
    # No window of a headless browser is as narrow as a phone; a frame in it is.
    (tmp_path / 'page.html').write_text(certificate(), encoding='utf-8')
    frame = tmp_path / 'frame.html'
    frame.write_text("""<iframe src="page.html" style="width:390px;height:800px;border:0"></iframe>
<script>onload = () => {
  const page = frames[0].document;
  const shown = [page.documentElement, ...page.querySelectorAll("div:not(.drawing)")];
  console.log(shown.filter(one => one.scrollWidth > Math.max(one.clientWidth, 1)).length
    + " of " + page.querySelectorAll("table").length + " tables are cut");
}</script>""")
    finished = subprocess.run(
        [
            browser(),
            *HEADLESS,
            '--enable-logging=stderr',
            '--allow-file-access-from-files',
            f'--user-data-dir={tmp_path / "profile"}',
            f'--screenshot={tmp_path / "phone.png"}',
            frame.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=True,
    )
    (said,) = [line for line in finished.stderr.splitlines() if 'CONSOLE' in line]
    cut, n_tables = re.search(r'(\d+) of (\d+) tables are cut', said).groups()
    assert int(n_tables) >= 5
    assert cut == '0'
    assert (tmp_path / 'phone.png').stat().st_size > 10_000


def test_no_printed_page_is_empty(tmp_path):
    (tmp_path / 'page.html').write_text(certificate(), encoding='utf-8')
    subprocess.run(
        [
            browser(),
            *HEADLESS,
            f'--user-data-dir={tmp_path / "profile"}',
            '--no-pdf-header-footer',
            f'--print-to-pdf={tmp_path / "page.pdf"}',
            (tmp_path / 'page.html').as_uri(),
        ],
        capture_output=True,
        timeout=TIMEOUT_S,
        check=True,
    )
    printed = (tmp_path / 'page.pdf').read_bytes()
    pages = re.findall(rb'/Type /Page\n.*?/Contents (\d+) 0 R', printed, re.DOTALL)
    assert 5 <= len(pages) <= 12
    for number in pages:
        drawn = re.search(rb'\n%s 0 obj.*?stream\r?\n' % number, printed, re.DOTALL)
        # The margin alone takes some lines.
        assert zlib.decompressobj().decompress(printed[drawn.end() :]).count(b'\n') > 200


def test_command_serves_until_it_is_interrupted(unit):
    process = subprocess.Popen(
        [sys.executable, '-m', 'thermo_comp', 'view', str(unit), '--port', '0'],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
    )
    url = process.stdout.readline().split()[0]
    assert 'Thermal calibration certificate' in get(url)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0
    assert 'Traceback' not in errors


def test_command_says_what_is_wrong(cli, unit, tmp_path):
    assert 'no such file' in cli('view', tmp_path / 'none.yaml', code=1).stderr
    with served(LiveReport(unit)) as server:
        taken = cli('view', unit, '--port', str(server.server_port), code=1)
    assert 'give another one with --port' in taken.stderr
