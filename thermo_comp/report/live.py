# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the live view: a certificate, anew when its files change, served to this machine alone."""

from __future__ import annotations

import hashlib
import sys
import threading
from collections.abc import Callable, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from ..errors import ThermoCompError
from ..fitting import ReducedBag
from ..judging.evaluation import open_bags
from ..recording.blocks import RecordingInfo
from ..recording.topics import Topics
from ..unit.calibration_file import load_calibration
from .evidence import Evidence, evidence_of_bags
from .page import ReportFigure, drawn_figures, figures_of, render_report

_HOST = '127.0.0.1'
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
}, 1000);
"""


class LiveReport:
    """The page of a calibration and bags, as the files are; what changes is read anew."""

    def __init__(
        self,
        calibration: Path,
        bags: Sequence[Path] = (),
        read: Callable[[RecordingInfo], None] = lambda _: None,
        topics: Topics | None = None,
        **judging: Any,
    ) -> None:
        self._calibration, self._bags = calibration, list(bags)
        self._read, self._topics, self._judging = read, topics, judging
        self._opened: dict[Path, tuple[str, ReducedBag]] = {}
        self._lock = threading.Lock()
        self._version = self._notice = ''
        # While nothing good was seen yet: a page with the reason, which goes on asking.
        self._evidence = Evidence(serial=calibration.name)
        self._drawn: list[tuple[ReportFigure, str]] = []

    def version(self) -> str:
        """Tell the state of the files: another text whenever one of them has changed."""
        return _signature(self._calibration, *self._bags)

    def page(self) -> str:
        """Make the page, if the files have changed, and return it."""
        with self._lock:
            version = self.version()
            if version != self._version:
                self._version, self._notice = version, ''
                try:
                    evidence = self.evidence()
                    self._drawn = drawn_figures(figures_of(evidence))
                    self._evidence = evidence
                except (ThermoCompError, OSError, ValueError) as error:
                    older = '\nThe page below is older.' if self._drawn else ''
                    self._notice = f'{error}{older}'
            return render_report(
                self._evidence, figures=self._drawn, script=_SCRIPT % version, notice=self._notice
            )

    def evidence(self) -> Evidence:
        """Judge the bags; those that have not changed are not read again."""
        calibration = load_calibration(self._calibration)
        for path in self._bags:
            signature = _signature(path)
            if self._opened.get(path, ('',))[0] != signature:
                (bag,) = open_bags([path], [calibration], topics=self._topics)
                self._opened[path] = (signature, bag)
                self._read(bag.info)
        bags = [self._opened[path][1] for path in self._bags]
        return evidence_of_bags(bags, calibration, **self._judging)


class LiveServer(ThreadingHTTPServer):
    """Serves one live report on the loopback interface; port 0 is any. OSError if it is taken."""

    daemon_threads = True
    #: Who comes while others are looked at waits here; else TCP asks again seconds later.
    request_queue_size = 512

    def __init__(self, report: LiveReport, port: int = 0) -> None:
        self.report = report
        self._most_threads = threading.active_count() + MOST_CLIENTS
        super().__init__((_HOST, port), _Handler)
        self.url = f'http://{_HOST}:{self.server_port}/'

    def verify_request(self, request: Any, client_address: Any) -> bool:  # noqa: ARG002
        """Take a client if there is a place for it."""
        return threading.active_count() < self._most_threads

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that went away."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: LiveServer
    timeout = _CLIENT_TIMEOUT_S
    server_version = 'thermo_comp'
    sys_version = ''

    def do_GET(self) -> None:
        """Answer with the page or with its version."""
        port = self.server.server_port
        status, kind, text = HTTPStatus.NOT_FOUND, 'plain', 'nothing here\n'
        # Else another site's page could come here through the browser.
        if self.headers.get('Host') not in (f'{_HOST}:{port}', f'localhost:{port}'):
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


def _signature(*paths: Path) -> str:
    """Describe files, and those of bags, by what changes when somebody writes them."""
    found: list[tuple[object, ...]] = []
    for path in paths:
        try:
            files = sorted(path.iterdir()) if path.is_dir() else [path]
            states = [(file, file.stat()) for file in files]
            found += [(str(file), s.st_mtime_ns, s.st_size, s.st_ino) for file, s in states]
        except OSError as error:  # noqa: PERF203 - each for itself
            found.append((str(path), error.errno))
    return hashlib.sha256(repr(found).encode()).hexdigest()[:16]
