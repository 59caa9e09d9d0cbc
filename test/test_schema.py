# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Plain data become dataclasses by their type hints; generated pages agree with the code."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import make_reference
import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st

from thermo_comp.quantities import Bounds
from thermo_comp.unit.schema import SchemaError, build, plain


@dataclass(frozen=True)
class Circle:
    """A circle."""

    radius: Annotated[float, Bounds(above=0.0, below=10.0), 'In metres.']
    kind: Literal['circle'] = 'circle'


@dataclass(frozen=True)
class Square:
    """A square."""

    side: Annotated[float, Bounds(at_least=1.0)]
    kind: Literal['square'] = 'square'


@dataclass(frozen=True)
class Drawing:
    """A dataclass with a field of every kind of type hint."""

    name: Annotated[str, Bounds(shortest=2, longest=20)]
    shapes: tuple[Circle | Square, ...] = ()
    corner: tuple[float, float] = (0.0, 0.0)
    layer: int | str = 0
    colour: Literal['red', 'green', 'blue'] | None = None
    is_hidden: bool = False
    frame: Circle = field(default_factory=lambda: Circle(1.0))

    def __post_init__(self):
        if self.corner[0] > self.corner[1]:
            raise ValueError('`corner[1]` must be at least corner[0]')
        if self.is_hidden and self.colour:
            raise ValueError('hidden drawings have no colour')


names = st.text(min_size=2, max_size=5)
lengths = st.floats(1.0, 9.0)
drawings = st.builds(
    Drawing, name=names,
    shapes=st.lists(st.builds(Circle, lengths) | st.builds(Square, lengths)).map(tuple),
    layer=st.integers() | names, is_hidden=st.booleans(), frame=st.builds(Circle, lengths),
)  # fmt: skip


def test_only_integers_for_floats_are_converted():
    built = build(Drawing, {'name': 'ab', 'corner': [1, 2], 'layer': '3'})
    assert built == Drawing('ab', corner=(1.0, 2.0), layer='3')
    assert [type(value) for value in built.corner] == [float, float]


@given(drawings)
def test_a_dataclass_is_unchanged_by_a_round_trip_of_plain_values(drawing):
    assert build(Drawing, plain(drawing)) == drawing


@pytest.mark.parametrize(
    ('data', 'key', 'message'),
    [
        ({'name': 'a'}, 'name', "must have at least 2 characters, got 'a'"),
        ({'name': 'x' * 21}, 'name', 'must have at most 20 characters'),
        ({'name': 3}, 'name', 'must be a valid text, got 3'),
        ({'name': 'ab', 'layer': None}, 'layer', 'must be a valid integer or text, got None'),
        ({'name': 'ab', 'layer': True}, 'layer', 'must be a valid integer or text, got True'),
        ({'name': 'ab', 'is_hidden': 1}, 'is_hidden', 'must be a valid true or false, got 1'),
        ({'name': 'ab', 'colour': ['red']}, 'colour', "'blue', got a list"),
        ({'name': 'ab', 'colour': 'x' * 99}, 'colour', "got 'x{59}$"),
        ({'name': 'ab', 'corner': 'ab'}, 'corner', "must be a list, got 'ab'"),
        ({'name': 'ab', 'corner': [1, 10**999]}, 'corner[1]', 'must be a valid number'),
        ({'name': 'ab', 'corner': [2, 1]}, 'corner[1]', 'must be at least corner'),
        ({'name': 'ab', 'is_hidden': True, 'colour': 'red'}, '', 'hidden drawings have no'),
        ({'name': 'ab', 'shapes': [{'radius': 1}]}, 'shapes[0].kind', 'this key is missing'),
        ({'name': 'ab', 'shapes': [7]}, 'shapes[0]', 'must be a mapping of keys, got 7'),
        ({'name': 'ab', 'shapes': [{'kind': 1}]}, 'shapes[0].kind', "'circle' or 'square', got 1"),
        ({'name': 'ab', 'shapes': [{'kind': 'square'}]}, 'shapes[0].side', 'missing'),
        ({'name': 'ab', 'frame': {'radius': 10.0}}, 'frame.radius', 'less than 10, got 10.0'),
    ],
)
def test_the_message_about_a_wrong_value_names_its_key(data, key, message):
    with pytest.raises(SchemaError, match=message) as caught:
        build(Drawing, data)
    assert caught.value.key == key
    assert str(caught.value).startswith(key)


def test_generated_pages_are_up_to_date_and_targets_of_links_exist():
    for path, text in make_reference.pages().items():
        assert path.read_text() == text, f'{path} is stale: run python docs/make_reference.py'
    pages = [*ROOT.glob('*.md'), *(ROOT / 'docs').glob('*.md'), *(ROOT / 'bags').glob('*.md')]
    broken = []
    for page in pages:
        for piece in page.read_text().split('](')[1:]:
            target = piece.partition(')')[0].partition('#')[0]
            if target and '://' not in target and not (page.parent / target).exists():
                broken.append(f'{page.name}: {target}')
    assert not broken


def test_json_schema_agrees_with_the_dataclasses():
    schema = make_reference.json_schema(Drawing)
    assert schema['required'] == ['name']
    assert schema['additionalProperties'] is False
    assert schema['description'] == 'A dataclass with a field of every kind of type hint.'
    assert schema['properties']['name'] == {'type': 'string', 'minLength': 2, 'maxLength': 20}
    kinds = {'anyOf': [{'$ref': '#/$defs/Circle'}, {'$ref': '#/$defs/Square'}]}
    assert schema['properties']['shapes'] == {'type': 'array', 'items': kinds, 'default': []}
    assert schema['properties']['corner'] == {
        'type': 'array', 'prefixItems': [{'type': 'number'}, {'type': 'number'}], 'minItems': 2,
        'maxItems': 2, 'default': [0.0, 0.0],
    }  # fmt: skip
    kinds = [{'enum': ['red', 'green', 'blue'], 'type': 'string'}, {'type': 'null'}]
    assert schema['properties']['colour'] == {'anyOf': kinds, 'default': None}
    assert schema['properties']['frame']['default'] == {'kind': 'circle', 'radius': 1.0}
    assert schema['$defs']['Circle']['properties'] == {
        'radius': {'type': 'number', 'exclusiveMinimum': 0.0, 'exclusiveMaximum': 10.0,
                   'description': 'In metres.'},
        'kind': {'const': 'circle', 'default': 'circle'},
    }  # fmt: skip
    assert schema['$defs']['Circle']['required'] == ['radius']
