from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import pytest

from fibaction.schema.check import Check, JsonSchema
from fibaction.schema.mismatch_texts import MAX_NAMED, sentences
from fibaction.schema.parts import SchemaParts


class Left(msgspec.Struct, tag="left", forbid_unknown_fields=True):
    x: int


class Right(msgspec.Struct, tag="right", forbid_unknown_fields=True):
    y: int
    z: int = 0


class Point(msgspec.Struct, forbid_unknown_fields=True):
    x: float
    y: float = 0.0


class Empty(msgspec.Struct, forbid_unknown_fields=True):
    pass


def errors_of(kind: Any, value: object) -> list[str]:
    return errors_by(msgspec.json.schema(kind), value)


def errors_by(schema: Any, value: object, name: str = "goal") -> list[str]:
    _, mismatches = SchemaParts(JsonSchema(schema)).root.tried(Check(), value)
    return [text for mismatch in mismatches for text in sentences(mismatch, name)]


@pytest.mark.parametrize(
    ("kind", "value", "texts"),
    [
        (int, "ten", ['goal must be a whole number, not "ten"']),
        (int, True, ["goal must be a whole number, not true"]),
        (str, 5, ["goal must be text, not 5"]),
        (list[int], {"a": 1}, ['goal must be a list, not {"a":1}']),
        (Point, [1], ["goal must be a map of fields, not [1]"]),
        (Point, {}, ["goal.x is missing"]),
        (Point, {"x": 1, "z": 1}, ['goal has no field "z"; it has x, y']),
        (Empty, {"z": 1}, ['goal has no field "z"; it has no fields']),
        (list[Point], [{"x": 1}, {"x": None}], ["goal[1].x must be a number, not null"]),
        (dict[str, Point], {"a": {"x": "b"}}, ['goal.a.x must be a number, not "b"']),
        (Literal["fast", "slow"], "now", ['goal must be "fast" or "slow", not "now"']),
        (Literal["fast"], "now", ['goal must be "fast", not "now"']),
        (
            Annotated[int, msgspec.Meta(le=255)],
            300,
            ["goal: 300 is greater than the maximum of 255"],
        ),
        (
            Annotated[str, msgspec.Meta(max_length=3)],
            "x" * 100,
            [f'goal: "{"x" * 59}... is longer than 3 characters'],
        ),
        (int | None, "a", ['goal must be a whole number or null, not "a"']),
        (int | Literal["auto"], "a", ['goal must be a whole number or "auto", not "a"']),
        (Point | None, {}, ["goal.x is missing"]),
        (Point | None, 5, ["goal must be a map of fields or null, not 5"]),
        (Left | Right, {"x": 1}, ['goal.type is missing: "left" or "right"']),
        (
            Left | Right,
            {"type": "up"},
            ['goal.type must be "left" or "right", not "up"'],
        ),
        (Left | Right, {"type": "left", "x": "a"}, ['goal.x must be a whole number, not "a"']),
        (
            Left | Right | None,
            {"type": "right", "y": 1, "zz": 2},
            ['goal has no field "zz"; did you mean z?'],
        ),
        (Left | Right | None, 5, ["goal must be a map of fields or null, not 5"]),
        (Left | Right | None, {"type": "up"}, ['goal.type must be "left" or "right", not "up"']),
    ],
)
def test_each_error_is_a_sentence_that_names_the_field(
    kind: Any, value: object, texts: list[str]
) -> None:
    assert errors_of(kind, value) == texts


def test_a_misspelled_field_is_not_reported_as_missing_too() -> None:
    class Order(msgspec.Struct, forbid_unknown_fields=True):
        order: int
        speed: int

    assert errors_of(Order, {"ordr": 1, "speed": 2}) == [
        'goal has no field "ordr"; did you mean order?'
    ]
    assert "goal.speed is missing" in errors_of(Order, {"ordr": 1})


def test_a_list_of_types_is_reported_like_alternatives() -> None:
    assert errors_by({"type": ["integer", "null"]}, "x", "feedback") == [
        'feedback must be a whole number or null, not "x"'
    ]


@pytest.mark.parametrize(
    ("schema", "value", "text"),
    [
        ({"const": 1}, 2, "goal must be 1, not 2"),
        ({"enum": []}, 2, "goal must be another value, not 2"),
        ({"anyOf": []}, 2, "goal must be another value, not 2"),
        (
            {"properties": {"a": False}},
            {"a": 1},
            "goal.a: 1 is a value where the schema allows none",
        ),
        ({"not": {"type": "integer"}}, 2, "goal: 2 is a value that the schema excludes"),
        ({"oneOf": [True, {"minimum": 1}]}, 2, "goal: 2 fits more than one alternative"),
        ({"oneOf": [{"maximum": 1}]}, 2, "goal: 2 is greater than the maximum of 1"),
        ({"multipleOf": 2}, 3, "goal: 3 is not a multiple of 2"),
        ({"prefixItems": [{}], "items": False}, [1, 2], "goal: [1,2] has more than 1 items"),
        ({"required": ["a"]}, {}, "goal.a is missing"),
        ({"required": ["a", "b"]}, {}, "goal: a and b are missing"),
        ({"required": list("abcdefgh")}, {}, "goal: a, b, c, d, e, f, g and h are missing"),
        (
            {"required": [f"a{number}" for number in range(MAX_NAMED + 1)]},
            {},
            "goal: " + ", ".join(f"a{one}" for one in range(MAX_NAMED)) + " and others are missing",
        ),
        (
            {"properties": {"pose": {"required": ["x", "y"]}}},
            {"pose": {}},
            "goal.pose: x and y are missing",
        ),
        ({"additionalProperties": False}, {"a": 1}, 'goal has no field "a"; it has no fields'),
    ],
)
def test_schemas_that_msgspec_does_not_write_are_reported_as_well(
    schema: Any, value: object, text: str
) -> None:
    assert errors_by(schema, value) == [text]


def test_a_tag_that_the_schema_describes_wrongly_is_not_looked_for() -> None:
    alternatives = [{"type": "string"}, {"type": "null"}]
    for choice in (5, {"propertyName": 5, "mapping": {}}, {"propertyName": "a", "mapping": 5}):
        texts = errors_by({"anyOf": alternatives, "discriminator": choice}, {"b": 1})
        assert texts == ['goal must be text or null, not {"b":1}']


def test_a_sentence_is_short_whatever_the_schema_and_the_data_are() -> None:
    long = "x" * 10_000
    many = {f"{long}{i}": {"type": "integer"} for i in range(100)}
    value: Any = {long: 1, f"{long}5": "a", "ab": 1}
    for _ in range(50):
        value = {long: value}
    schema: dict[str, Any] = {
        "properties": many,
        "required": list(many),
        "additionalProperties": {"$ref": "#"},
        "anyOf": [{"enum": [f"{i}{long}" for i in range(100)]}, {"properties": {}}],
    }

    texts = errors_by(schema, value)

    assert len(texts) > MAX_NAMED
    assert max(map(len, texts)) < 2000
    assert errors_by({"properties": many}, {long: 1})[0].endswith(", ...")


def test_the_first_of_many_values_are_named() -> None:
    (text,) = errors_by({"enum": list(range(1000))}, "x")

    assert text.endswith('18, 19 or another, not "x"')


def test_a_name_is_printed_without_control_characters() -> None:
    (text,) = errors_by({"properties": {"\x1b[2J": {}}}, {"\n": 1})

    assert text == 'goal has no field "\\n"; it has \\x1b[2J'
