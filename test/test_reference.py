# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""What the documentation takes from the code is what the code says today."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_generated_pages_are_up_to_date():
    spec = importlib.util.spec_from_file_location(
        'make_reference', ROOT / 'docs/make_reference.py'
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    stale = [str(path) for path, text in module.pages().items() if path.read_text() != text]
    assert not stale, 'run: python docs/make_reference.py'


def test_links_between_pages_lead_somewhere():
    pages = [*ROOT.glob('*.md'), *(ROOT / 'docs').glob('*.md'), *(ROOT / 'bags').glob('*.md')]
    broken = []
    for page in pages:
        for piece in page.read_text().split('](')[1:]:
            target = piece.partition(')')[0].partition('#')[0]
            if target and '://' not in target and not (page.parent / target).exists():
                broken.append(f'{page.name}: {target}')
    assert not broken
