# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of a report in a browser: on a phone, and in print."""

import re
import shutil
import subprocess
import zlib

import pytest
from report_helpers import certificate

pytestmark = pytest.mark.usefixtures('equal_fits_once')

TIMEOUT_S = 60.0
HEADLESS = (
    *('--headless', '--no-sandbox', '--disable-gpu', '--no-first-run', '--disable-sync'),
    *('--disable-background-networking', '--disable-component-update'),
)


def browser():
    found = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser'))), None)
    if found is None:
        pytest.skip('no Chromium here (Debian: apt install chromium)')
    return found


def test_browser_draws_the_page_for_a_phone_whole_and_without_a_complaint(tmp_path):
    # A headless browser has no window as narrow as a phone, but a frame in it can be.
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
            browser(), *HEADLESS, '--enable-logging=stderr', '--allow-file-access-from-files',
            f'--user-data-dir={tmp_path / "profile"}', f'--screenshot={tmp_path / "phone.png"}',
            frame.as_uri(),
        ],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=True,
    )  # fmt: skip
    (said,) = [line for line in finished.stderr.splitlines() if 'CONSOLE' in line]
    cut, n_tables = re.search(r'(\d+) of (\d+) tables are cut', said).groups()
    assert int(n_tables) >= 5
    assert cut == '0'
    assert (tmp_path / 'phone.png').stat().st_size > 10_000


def test_no_printed_page_is_empty(tmp_path):
    (tmp_path / 'page.html').write_text(certificate(), encoding='utf-8')
    subprocess.run(
        [
            browser(), *HEADLESS, f'--user-data-dir={tmp_path / "profile"}',
            '--no-pdf-header-footer', f'--print-to-pdf={tmp_path / "page.pdf"}',
            (tmp_path / 'page.html').as_uri(),
        ],
        capture_output=True, timeout=TIMEOUT_S, check=True,
    )  # fmt: skip
    printed = (tmp_path / 'page.pdf').read_bytes()
    pages = re.findall(rb'/Type /Page\n.*?/Contents (\d+) 0 R', printed, re.DOTALL)
    assert 5 <= len(pages) <= 12
    for number in pages:
        drawn = re.search(rb'\n%s 0 obj.*?stream\r?\n' % number, printed, re.DOTALL)
        # The margin takes some lines.
        assert zlib.decompressobj().decompress(printed[drawn.end() :]).count(b'\n') > 200
