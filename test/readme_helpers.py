# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the outputs shown on README and docs/cli.md; run as a program it writes them anew."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / 'README.md').read_text(encoding='utf-8')
CLI_PAGE = ROOT / 'docs' / 'cli.md'
FENCE = re.compile(r'^```(\w+)\n(.*?)^```', re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r'-?\d+(?:\.\d+)?(?:e[+-]?\d+)?')


def shown():
    """Return the examples of docs/cli.md by sub-command: words of the command, and its output."""
    collected = {}
    for kind, text in FENCE.findall(CLI_PAGE.read_text(encoding='utf-8')):
        if kind == 'console':
            command, _, output = text.partition('\n')
            words = shlex.split(command.removeprefix('$ '))
            name = Path(words[1]).stem
            assert words[0] == ('python' if name == 'demo' else 'thermo_comp')
            collected[name] = (words[1:], output)
    return collected


def shown_of_demo():
    (text,) = (text for kind, text in FENCE.findall(README) if kind == 'text')
    return str(text).splitlines()


def is_alike(got, expected):
    """Whether outputs have equal words, and numbers that differ by at most 5 or by a third."""
    if _NUMBER.sub('#', got).split() != _NUMBER.sub('#', expected).split():
        return False
    numbers = zip(_NUMBER.findall(got), _NUMBER.findall(expected), strict=True)
    return all(abs(float(a) - float(b)) <= max(abs(float(b)) / 3.0, 5.0) for a, b in numbers)


def refresh():
    """Replace the outputs of the console examples on docs/cli.md by real outputs."""
    environment = {**os.environ, 'PYTHONPATH': str(ROOT), 'COLUMNS': '80'}
    with tempfile.TemporaryDirectory() as folder:
        for name in ('bags', 'benchmarks'):
            Path(folder, name).symlink_to(ROOT / name)

        def run(match):
            command = match[1].partition('\n')[0]
            python = shlex.quote(sys.executable)
            line = command.replace('$ thermo_comp', f'{python} -m thermo_comp', 1)
            finished = subprocess.run(
                ['bash', '-c', line.replace('$ python', python, 1)], cwd=folder,
                env=environment, capture_output=True, text=True, check=True,
            )  # fmt: skip
            return f'```console\n{command}\n{finished.stdout.rstrip()}\n```'

        page = CLI_PAGE.read_text(encoding='utf-8')
        text = re.sub(r'^```console\n(.*?)^```', run, page, flags=re.MULTILINE | re.DOTALL)
        shutil.copy(Path(folder, 'out/figures/4_gravity.png'), ROOT / 'docs/images/gravity.png')
    CLI_PAGE.write_text(text, encoding='utf-8')


if __name__ == '__main__':
    refresh()
