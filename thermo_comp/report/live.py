# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the live view: the certificate served on this machine, made anew when its files change.

The page asks for the version of its files once a second and reloads itself when that differs. A
file that cannot be read, as while it is being written, is said above the last good page. Served
on the loopback interface only, and only under its own names, so that no other site's page can
reach it through the browser.
"""

from __future__ import annotations

import hashlib
import secrets
import sys
import threading
from collections.abc import Callable, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from ..errors import ThermoCompError
from ..fitting import ReducedBag
from ..judging import open_bag
from ..recording import Input, RecordingInfo, Topics
from ..unit.calibration_file import load_calibration
from .evidence import Evidence
from .figures import ReportFigure, drawn_figures, figures_of
from .gather import evidence_of_bags
from .page import render_page

HOST = '127.0.0.1'
_NAMES = ('127.0.0.1', 'localhost')
_POLL_MS = 1000
# A client that keeps a connection open without a word is let go after this [s].
_CLIENT_TIMEOUT_S = 2.0
#: So many are answered at once; who finds no place is let go, and a page asks again by itself.
MOST_CLIENTS = 16
_SCRIPT = """
const shown = "%s", title = document.title;
setInterval(async () => {
  try {
    const answer = await fetch("version", {cache: "no-store"});
    if (answer.ok && await answer.text() !== shown) location.reload();
    document.title = title;
  } catch (error) { document.title = "(not served any more) " + title; }
}, %d);
"""


class LiveReport:
    """
    The page of a calibration and bags, as the files are; a bag is read when it changes, and told.
    """

    def __init__(
        self,
        calibration: Path,
        bags: Sequence[Path] = (),
        topics: Topics | None = None,
        input: Input = 'auto',  # noqa: A002 - as everywhere
        read: Callable[[RecordingInfo], None] | None = None,
        **judging: Any,
    ) -> None:
        self._calibration = calibration
        self._bags = list(bags)
        self._topics, self._input, self._read = topics, input, read
        self._judging = judging  # of `evidence_of_bags`
        self._lock = threading.Lock()
        self._opened: dict[Path, tuple[str, ReducedBag]] = {}
        self._version = ''
        self._made: tuple[Evidence, list[tuple[ReportFigure, str]]] | None = None
        self._notice = ''

    def version(self) -> str:
        """Tell the state of the files: another text whenever one of them has changed."""
        return _signature([self._calibration, *self._bags])

    def page(self) -> str:
        """Make the page, if the files have changed, and return it."""
        with self._lock:
            version = self.version()
            if version != self._version:
                self._make(version)
            # While nothing good was seen yet: a page with the reason, which goes on asking.
            evidence = Evidence(serial=self._calibration.name, unit='counts')
            return render_page(
                *(self._made or (evidence, [])),
                script=_SCRIPT % (version, _POLL_MS),
                nonce=secrets.token_urlsafe(16),
                notice=self._notice,
            )

    def _make(self, version: str) -> None:
        self._version = version
        try:
            evidence = self._evidence()
            self._made = (evidence, drawn_figures(figures_of(evidence)))
            self._notice = ''
        except (ThermoCompError, OSError, ValueError) as error:
            older = '' if self._made is None else '\nThe page below is older.'
            self._notice = f'{error}{older}'

    def _evidence(self) -> Evidence:
        calibration = load_calibration(self._calibration)
        bags = []
        for path in self._bags:
            signature = _signature([path])
            known = self._opened.get(path)
            if known is None or known[0] != signature:
                bag = open_bag(path, self._topics, self._input, calibration=calibration)
                if self._read is not None:
                    self._read(bag.info)
                known = (signature, bag)
                self._opened[path] = known
            bags.append(known[1])
        return evidence_of_bags(bags, calibration, **self._judging)


class LiveServer(ThreadingHTTPServer):
    """Serves one live report on the loopback interface; port 0 is any. OSError if it is taken."""

    daemon_threads = True
    #: Who comes while others are looked at waits here; else TCP asks again seconds later.
    request_queue_size = 512

    def __init__(self, report: LiveReport, port: int = 0) -> None:
        self.report = report
        self._places = threading.BoundedSemaphore(MOST_CLIENTS)
        super().__init__((HOST, port), _Handler)

    def verify_request(self, request: Any, client_address: Any) -> bool:  # noqa: ARG002
        """Take a client if there is a place for it."""
        return self._places.acquire(blocking=False)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a client, and give its place to another."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that went away."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        """Where the page is."""
        return f'http://{HOST}:{self.server_port}/'


class _Handler(BaseHTTPRequestHandler):
    server: LiveServer
    timeout = _CLIENT_TIMEOUT_S
    server_version = 'thermo_comp'
    sys_version = ''

    def do_GET(self) -> None:
        """Answer with the page or with its version."""
        name, _, port = self.headers.get('Host', '').partition(':')
        status, kind, text = HTTPStatus.NOT_FOUND, 'plain', 'nothing here\n'
        if name not in _NAMES or port != str(self.server.server_port):
            status, text = HTTPStatus.FORBIDDEN, 'another host\n'
        elif self.path == '/':
            status, kind, text = HTTPStatus.OK, 'html', self.server.report.page()
        elif self.path == '/version':
            status, text = HTTPStatus.OK, self.server.report.version()
        content = text.encode()
        self.send_response(status)
        for header, value in (
            ('Content-Type', f'text/{kind}; charset=utf-8'),
            ('Content-Length', str(len(content))),
            ('Cache-Control', 'no-store'),
            ('X-Content-Type-Options', 'nosniff'),
            ('X-Frame-Options', 'DENY'),
        ):
            self.send_header(header, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the base's name
        """Say nothing: a request a second is no news."""


def _signature(paths: Sequence[Path]) -> str:
    return hashlib.sha256('\n'.join(map(_state, paths)).encode()).hexdigest()[:16]


def _state(path: Path) -> str:
    """Describe a file, or a bag's files, by what changes when somebody writes them."""
    try:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        found = [(str(file), file.stat()) for file in files]
    except OSError as error:
        return f'{path}: {error.errno}'
    return repr([(name, s.st_mtime_ns, s.st_size, s.st_ino) for name, s in found])
