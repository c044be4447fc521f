"""Templates: a value that a JSON Schema allows."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fibaction.action_files import load_action
from fibaction.schema.template import MAX_FIELDS, Template
from fibaction.types.schemas import schema_of
from tests.support.random_types import random_struct

ACTIONS = Path(__file__).parent.parent / "action_files"


UNITS: list[tuple[dict[str, Any], float]] = [
    ({"type": "integer", "multipleOf": 4}, 0),
    ({"type": "integer", "multipleOf": 4, "minimum": 4}, 4),
    ({"type": "integer", "multipleOf": 4, "minimum": 5}, 8),
    ({"type": "integer", "multipleOf": 4, "exclusiveMinimum": 0}, 4),
    ({"type": "integer", "multipleOf": 4, "exclusiveMinimum": 4}, 8),
    ({"type": "integer", "multipleOf": 4, "maximum": -5}, -8),
    ({"type": "integer", "multipleOf": 4, "exclusiveMaximum": -4}, -8),
    ({"type": "integer", "multipleOf": 1.5, "minimum": 4}, 6),
    ({"type": "integer", "multipleOf": 8, "minimum": 2**60 + 1}, 2**60 + 8),
    ({"type": "number", "multipleOf": 0.5, "exclusiveMinimum": 0, "maximum": 1}, 0.5),
    ({"type": "number", "multipleOf": 0.1, "minimum": 0.25}, 0.4),
    ({"type": "number", "multipleOf": 2, "exclusiveMinimum": math.inf}, math.inf),
    ({"type": "integer", "multipleOf": 0.3, "minimum": 1}, 3),
    ({"type": "integer", "multipleOf": 0.07, "minimum": 1}, 1),
]
"""Numbers with a unit, and the template of each. The last has no multiple near its limit."""


@pytest.mark.parametrize(
    ("schema", "goal"),
    [
        ({}, {}),
        ({"type": "integer"}, 0),
        ({"type": ["boolean", "null"]}, False),
        ({"type": []}, None),
        ({"type": "array", "prefixItems": [{"type": "integer"}, {"type": "string"}]}, [0, ""]),
        ({"type": "string", "format": "date"}, "2026-01-31"),
        ({"type": "string", "format": "unheard-of"}, ""),
        ({"anyOf": [{"type": "null"}, {"type": "integer", "minimum": 3}]}, 3),
        ({"oneOf": [{"type": "null"}]}, None),
        ({"const": 7}, 7),
        ({"type": "array", "items": {"type": "number"}, "minItems": 2}, [0.0, 0.0]),
        ({"type": "array", "prefixItems": [{"const": 1}], "minItems": 2}, [1, {}]),
        ({"type": "array", "minItems": MAX_FIELDS}, {}),
        ({"type": "string", "minLength": 2}, "xx"),
        ({"type": "string", "minLength": 10_000}, {}),
        ({"type": "string", "contentEncoding": "base64", "minLength": 4}, "AAAA"),
        ({"type": "number", "exclusiveMinimum": 0, "maximum": 1}, 0.5),
        ({"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 4}, 1),
        ({"type": "integer", "exclusiveMinimum": 0, "maximum": 1}, 1),
        ({"type": "number", "exclusiveMinimum": 3}, 4),
        ({"type": "integer", "maximum": -2}, -2),
        *UNITS,
        ({"type": "integer", "exclusiveMaximum": 0}, -1),
        ({"$ref": "#/$defs/A", "$defs": {"A": {"enum": ["on", "off"]}}}, "on"),
        ({"$ref": "#/$defs/A", "$defs": {"A": {"default": 5}}}, 5),
        ({"properties": {"a": True, "b": {"default": [1]}}}, {"a": {}, "b": [1]}),
        ({"$ref": "http://evil/schema"}, {}),
        ({"properties": 7}, {}),
    ],
)
def test_a_schema_of_any_form_has_a_template(schema: Any, goal: object) -> None:
    assert Template(schema).value == goal


@pytest.mark.parametrize("seed", range(100))
def test_the_template_of_a_random_struct_is_a_goal_of_it(seed: int) -> None:
    kind = random_struct(random.Random(seed), 3)
    template = Template(schema_of(kind))
    assert isinstance(msgspec.json.decode(msgspec.json.encode(template.value), type=kind), kind)


@pytest.mark.parametrize("path", sorted(ACTIONS.rglob("*.action")), ids=lambda path: path.stem)
def test_the_template_of_an_action_file_is_a_goal_of_it(path: Path) -> None:
    kind = load_action(path, search=[ACTIONS]).goal.type
    template = Template(schema_of(kind)).value
    assert msgspec.convert(template, kind, builtin_types=()) == kind()


def test_the_work_for_a_hostile_schema_is_limited() -> None:
    part: dict[str, Any] = {"type": "integer"}
    for _ in range(20):
        part = {"anyOf": [part]}
    assert Template(part).value == {}
    wide: dict[str, Any] = {"properties": {f"a{number}": {} for number in range(MAX_FIELDS)}}
    assert Template(wide).value == {}


@pytest.mark.parametrize(
    "endless", [{"type": "array", "minItems": math.inf}, {"type": "string", "minLength": math.inf}]
)
def test_of_a_goal_of_endless_length_there_is_an_empty_template(endless: dict[str, Any]) -> None:
    assert Template(endless).value == {}
