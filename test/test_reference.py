# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Generated parts of the documentation agree with the code."""

from pathlib import Path

import make_reference
from test_schema import Drawing

ROOT = Path(__file__).resolve().parent.parent


def test_generated_pages_are_up_to_date():
    stale = [
        str(path) for path, text in make_reference.pages().items() if path.read_text() != text
    ]
    assert not stale, 'run: python docs/make_reference.py'


def test_json_schema_agrees_with_the_dataclasses():
    schema = make_reference.json_schema(Drawing)
    assert schema['required'] == ['name']
    assert schema['additionalProperties'] is False
    assert schema['description'] == 'A dataclass with a field of every kind of type hint.'
    assert schema['properties']['name'] == {'type': 'string', 'minLength': 2, 'maxLength': 20}
    assert schema['properties']['shapes'] == {
        'type': 'array',
        'items': {'anyOf': [{'$ref': '#/$defs/Circle'}, {'$ref': '#/$defs/Square'}]},
        'default': [],
    }
    assert schema['properties']['corner'] == {
        'type': 'array', 'prefixItems': [{'type': 'number'}, {'type': 'number'}], 'minItems': 2,
        'maxItems': 2, 'default': [0.0, 0.0],
    }  # fmt: skip
    assert schema['properties']['colour'] == {
        'anyOf': [{'enum': ['red', 'green', 'blue'], 'type': 'string'}, {'type': 'null'}],
        'default': None,
    }
    assert schema['properties']['frame']['default'] == {'kind': 'circle', 'radius': 1.0}
    assert schema['$defs']['Circle']['properties'] == {
        'radius': {'type': 'number', 'exclusiveMinimum': 0.0, 'exclusiveMaximum': 10.0,
                   'description': 'In metres.'},
        'kind': {'const': 'circle', 'default': 'circle'},
    }  # fmt: skip
    assert schema['$defs']['Circle']['required'] == ['radius']


def test_targets_of_the_links_between_pages_exist():
    pages = [*ROOT.glob('*.md'), *(ROOT / 'docs').glob('*.md'), *(ROOT / 'bags').glob('*.md')]
    broken = []
    for page in pages:
        for piece in page.read_text().split('](')[1:]:
            target = piece.partition(')')[0].partition('#')[0]
            if target and '://' not in target and not (page.parent / target).exists():
                broken.append(f'{page.name}: {target}')
    assert not broken
