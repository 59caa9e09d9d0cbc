# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Commands in the documentation print the output shown, and every page is in the site's menu."""

import contextlib
import io
import json
import re
import shutil
import sys

import matplotlib as mpl
import pytest
import yaml
from conftest import ROOT, parsed, ran
from matplotlib import pyplot as plt
from readme_helpers import FENCE, is_alike

pytestmark = pytest.mark.usefixtures('equal_fits_once', 'no_figures')

PAGES = [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))]
TUTORIAL = ROOT / 'docs' / 'tutorial.ipynb'
# Other files test these commands: `play` takes minutes, `record` waits for 18 positions.
ELSEWHERE = (
    'thermo_comp play bags/held_out.mcap --rate 20',
    'thermo_comp record session --positions 18 --soak 45min -o bags/unit42',
)


def commands():
    """Return page, command, and the output shown for it (empty for none)."""
    collected = []
    for page in PAGES:
        for kind, text in FENCE.findall(page.read_text(encoding='utf-8')):
            if kind not in ('console', 'sh'):
                continue
            joined = re.sub(r'\\\n\s*', '', text)
            prompt = r'^\$ ' if kind == 'console' else r'^'
            for part in re.split(prompt, joined, flags=re.MULTILINE):
                line, _, output = part.partition('\n')
                command = re.sub(r'\s+#.*', '', line).strip()
                if command.startswith('thermo_comp ') and command not in ELSEWHERE:
                    collected.append((page.name, command, output if kind == 'console' else ''))
    return collected


COMMANDS = commands()


@pytest.mark.parametrize(('page', 'command', 'output'), COMMANDS, ids=[c for _, c, _ in COMMANDS])
def test_a_command_on_a_page_gives_the_output_shown(page, command, output, desk):
    if '--install-completion' in command:
        pytest.skip('the command writes into the home folder of the user')
    finished = desk.run(command)
    if '--json' in command:
        assert parsed(finished.stdout)
    if output.strip():
        assert is_alike(finished.stdout, output), finished.stdout


def test_bash_accepts_the_completion_script():
    bash = shutil.which('bash')
    if bash is None:
        pytest.skip('bash is not installed')
    # thermo_comp asks which shell started it; without the `:` bash would replace itself by Python.
    words = f'eval "$({sys.executable} -m thermo_comp --show-completion; :)"; complete'
    finished = ran(bash, '-c', words)
    assert (finished.returncode, finished.stderr) == (0, '')
    assert 'thermo_comp' in finished.stdout


def test_pages_are_in_the_site_s_menu_and_their_tables_have_rows_of_equal_length():
    def listed(entry):
        if isinstance(entry, str):
            return [entry]
        inner = entry.values() if isinstance(entry, dict) else entry
        return [page for part in inner for page in listed(part)]

    nav = yaml.safe_load((ROOT / 'mkdocs.yml').read_text())['nav']
    assert sorted(listed(nav)) == sorted(page.name for page in [*PAGES[1:], TUTORIAL])
    assert {page for page, _, _ in COMMANDS} >= {'README.md', 'integration.md', 'recording.md'}
    # WHY: the bars of |f| in a table were taken for borders of cells.
    for page in PAGES:
        text = re.sub(FENCE, '', page.read_text(encoding='utf-8'))
        for table in re.findall(r'^\|.*\n(?:\|.*\n)+', text, re.MULTILINE):
            numbers = {len(re.findall(r'(?<!\\)\|', row)) for row in table.splitlines()}
            assert len(numbers) == 1, f'{page.name}: {table[:200]}'


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    for module in ('material', 'mkdocstrings', 'mkdocs_jupyter'):
        pytest.importorskip(module, reason=f'{module} of the extra `docs` is not installed')
    words = ('mkdocs', 'build', '--strict', '--site-dir', tmp_path / 'site')
    finished = ran(sys.executable, '-m', *words)
    assert finished.returncode == 0, finished.stderr
    assert (tmp_path / 'site' / 'index.html').is_file()


def test_the_tutorial_prints_the_output_stored_in_the_notebook(monkeypatch):
    mpl.use('Agg')
    monkeypatch.chdir(ROOT / 'docs')
    names = {}
    n_figures = 0
    for cell in json.loads(TUTORIAL.read_text())['cells']:
        if cell['cell_type'] != 'code':
            continue
        shown = ''.join(''.join(out.get('text', '')) for out in cell['outputs'])
        drawn = [out for out in cell['outputs'] if 'image/png' in out.get('data', {})]
        text = io.StringIO()
        with contextlib.redirect_stdout(text):
            exec(''.join(cell['source']), names)  # noqa: S102 - our own page
        assert is_alike(text.getvalue(), shown), text.getvalue()
        assert len(plt.get_fignums()) == len(drawn)
        n_figures += len(drawn)
        plt.close('all')
    assert n_figures == 2


def test_messages_quoted_on_the_pages_are_in_the_source():
    text = ''.join((ROOT / 'docs' / name).read_text() for name in ('recording.md', 'at_home.md'))
    quoted = re.findall(r'^\| `([^`]+)` \|', text, re.MULTILINE)
    assert len(quoted) > 10
    sources = ''.join(path.read_text() for path in (ROOT / 'thermo_comp').rglob('*.py'))
    plain = re.sub(r"'\s+f?'", '', sources)
    for sentence in quoted:
        # Numbers and '...' stand for values at run time: compare the longest text between values.
        words = max(re.split(r'\d+(?:\.\d+)?|\.\.\.', sentence), key=len).strip(' ,;')
        assert words in plain, sentence
