"""Shapes beside the search that knows all keywords: both agree, and only one of them looks."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given

from fibaction.schema import conversion
from fibaction.schema.check import Check
from fibaction.schema.conversion import NoMatch, converted
from fibaction.schema.json_schema import JsonSchema, SchemaError
from fibaction.schema.shapes import choices, containers, scalars, shape
from fibaction.schema.shapes.shape import AnyShape, SearchShape
from fibaction.schema.shapes.shapes import Shapes
from tests.schema.test_check import LEAVES, PARTS, VALUES
from tests.schema.test_payload import ANY_JSON, SCHEMAS

Outcome = tuple[Any, tuple[str | int, ...] | None]


def by_shape(schema: JsonSchema, value: Any) -> Outcome:
    """Return the value as it is sent, or where it does not match."""
    shapes = Shapes(schema)
    try:
        return shapes.of(schema.root).convert(shapes.check(1000), value), None
    except NoMatch as exc:
        return None, (*reversed(exc.way), *exc.mismatch.path)


def by_search(schema: JsonSchema, value: Any) -> Outcome:
    try:
        return converted(Check(schema, 1000), value, schema.root), None
    except NoMatch as exc:
        return None, exc.mismatch.path


def agree(schema: Any, value: Any) -> None:
    """Check that shapes and the search send the same, or find that the value does not match."""
    try:
        read = JsonSchema(schema)
        expected = by_search(read, value)
        found = by_shape(read, value)
    except (SchemaError, ValueError):
        return
    assert (found[1] is None) == (expected[1] is None)
    assert repr(found[0]) == repr(expected[0])


@given(PARTS, LEAVES, LEAVES, VALUES)
def test_a_shape_and_the_search_agree_about_any_schema_of_all_keywords(
    part: Any, one: Any, other: Any, value: Any
) -> None:
    if isinstance(part, dict):
        agree({**part, "$defs": {"a": one, "b": other}}, value)


@given(SCHEMAS, ANY_JSON)
def test_a_shape_and_the_search_agree_about_any_schema(schema: Any, value: Any) -> None:
    agree(schema, value)


class Point(msgspec.Struct):
    x: float
    y: float = 0.0
    note: str | None = None


class Left(msgspec.Struct, tag="left"):
    data: bytes = b""


class Right(msgspec.Struct, tag="right", forbid_unknown_fields=True):
    count: Annotated[int, msgspec.Meta(ge=0)] = 1
    kids: list[Right] = []


class Whole(msgspec.Struct):
    mode: Literal["fast", "slow"]
    only: Literal["one"] = "one"
    points: list[Point] = []
    tool: Left | Right | None = None
    pair: tuple[int, bytes] | None = None
    names: dict[str, Point] = {}
    at: Annotated[datetime.datetime, msgspec.Meta(tz=True)] | None = None
    some: Annotated[list[int], msgspec.Meta(min_length=1, max_length=3)] | None = None
    any: Any = None
    maybe: int | msgspec.UnsetType = msgspec.UNSET


GOOD = [
    {"mode": "fast"},
    {"mode": "slow", "some": [1, 2.0], "maybe": 3, "any": [{"a": b"x"}]},
    {"mode": "fast", "points": [{"x": 1}, {"y": 2.5, "x": 0, "note": "here"}]},
    {"mode": "fast", "tool": {"type": "left", "data": "aGk="}, "pair": [1, [104, 105]]},
    {"mode": "fast", "tool": {"type": "right", "kids": [{"type": "right"}, {"type": "right"}]}},
    {"mode": "fast", "names": {"a": {"x": 1}}, "at": "2026-01-02T03:04:05Z", "pair": [1, b"hi"]},
]
BAD: list[tuple[Any, tuple[str | int, ...]]] = [
    ({}, ()),
    ([], ()),
    ({"mode": "fast", "more": 1}, ()),
    ({"mode": "soon"}, ("mode",)),
    ({"mode": "fast", "only": "two"}, ("only",)),
    ({"mode": "fast", "points": [{"x": 1}, {"x": 1, "y": None}]}, ("points", 1, "y")),
    ({"mode": "fast", "points": [{"x": 1}, {}]}, ("points", 1)),
    ({"mode": "fast", "points": {}}, ("points",)),
    ({"mode": "fast", "names": {"a": {"x": 1}, "b": {"x": "1"}}}, ("names", "b", "x")),
    ({"mode": "fast", "tool": {"type": "up"}}, ("tool",)),
    ({"mode": "fast", "tool": {}}, ("tool",)),
    ({"mode": "fast", "tool": 5}, ("tool",)),
    ({"mode": "fast", "tool": {"type": "right", "count": -1}}, ("tool", "count")),
    ({"mode": "fast", "pair": [1]}, ("pair",)),
    ({"mode": "fast", "pair": [1, "?"]}, ("pair", 1)),
    ({"mode": "fast", "pair": ["1", ""]}, ("pair", 0)),
    ({"mode": "fast", "some": []}, ("some",)),
    ({"mode": "fast", "some": [1, 2, 3, 4]}, ("some",)),
    ({"mode": "fast", "maybe": 1.5}, ("maybe",)),
    ({"mode": "fast", "at": "soon"}, ("at",)),
]
WHOLE = JsonSchema(msgspec.json.schema(Whole))


@pytest.mark.parametrize("value", GOOD)
def test_a_message_is_sent_as_the_search_would_send_it(value: Any) -> None:
    assert by_shape(WHOLE, value) == by_search(WHOLE, value)
    assert by_shape(WHOLE, value)[1] is None


@pytest.mark.parametrize(("value", "path"), BAD)
def test_the_field_that_does_not_match_is_found(value: Any, path: tuple[str | int, ...]) -> None:
    assert by_shape(WHOLE, value) == (None, path)


def test_a_message_of_a_usual_type_is_not_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    def search(check: Check, value: Any, schema: Any) -> Any:
        raise AssertionError(value)

    for module in (containers, choices, scalars, shape):
        monkeypatch.setattr(module, "converted", search)
    monkeypatch.setattr(conversion, "completed", search)
    plain = {
        "mode": "slow",
        "points": [{"x": 1}],
        "tool": {"type": "left"},
        "names": {"a": {"x": 1}},
    }

    assert by_shape(WHOLE, plain)[1] is None


def test_a_missing_field_of_a_large_message_is_found_without_a_look_at_the_others() -> None:
    shapes = Shapes(JsonSchema(msgspec.json.schema(Whole)))
    check = shapes.check(1000)

    with pytest.raises(NoMatch):
        shapes.of(shapes.root).convert(check, {"points": [{"x": 1}] * 1000})
    assert check.steps.spent < 10_000


def test_empty_maps_share_what_they_are_sent_as() -> None:
    schema = {"items": {"$ref": "#/$defs/p"}, "type": "array", "$defs": {"p": {"type": "object"}}}
    schema["$defs"]["p"]["properties"] = {"a": {"type": "integer", "default": 1}}  # type: ignore[index]
    found, _ = by_shape(JsonSchema(schema), [{}, {}, {}])

    assert found == [{"a": 1}] * 3
    assert found[1] is found[2]


def test_defaults_are_limited_by_the_size_of_the_message() -> None:
    field = {"type": "array", "items": {"type": "integer"}, "default": [0] * 10_000}
    item = {"type": "object", "properties": {"a": field}}
    shapes = Shapes(JsonSchema({"type": "array", "items": item}))

    with pytest.raises(SchemaError, match="has too many defaults: in this message they take over"):
        shapes.of(shapes.root).convert(shapes.check(1000), [{}] * 1000)


def test_a_default_of_another_type_is_left_to_the_search() -> None:
    field = {"type": "integer", "default": "x"}
    schema = JsonSchema({"type": "object", "properties": {"a": field}})

    assert by_shape(schema, {}) == (None, ("a",))
    assert by_shape(schema, {"a": 1}) == ({"a": 1}, None)


@pytest.mark.parametrize(
    ("schema", "kind"),
    [
        (True, AnyShape),
        ({"description": "anything"}, AnyShape),
        (False, SearchShape),
        ({"allOf": [{"type": "integer"}]}, SearchShape),
        ({"type": "object", "patternProperties": {}}, SearchShape),
        ({"anyOf": [{"$ref": "#"}]}, SearchShape),
        ({"anyOf": [{"type": "array"}, {"allOf": []}]}, SearchShape),
        ({"enum": [1, 2]}, SearchShape),
        ({"type": "array", "prefixItems": [True]}, SearchShape),
        ({"type": "anything"}, SearchShape),
    ],
)
def test_other_schemas_have_no_shape_of_their_own(schema: Any, kind: type) -> None:
    assert type(Shapes(JsonSchema(schema)).of(schema)) is kind


OBJECT: Any = {"type": "object", "properties": {"a": {"type": "integer"}}}
LOOSE: Any = {"type": "object", "additionalProperties": {"type": "integer"}}


@pytest.mark.parametrize(
    ("schema", "value"),
    [
        ({"type": "array"}, [1, "a", {"b": [2]}]),
        ({"type": "array", "items": OBJECT, "maxItems": 1}, [{}, {}]),
        (OBJECT | {"minProperties": 1}, {}),
        (OBJECT | {"minProperties": 1}, {"a": 1}),
        (LOOSE | {"maxProperties": 1}, {"a": 1, "b": 2}),
        (LOOSE, {1: 2}),
        (LOOSE, {1: "a"}),
        (OBJECT | {"additionalProperties": True}, {"b": 1}),
        (OBJECT | {"required": ["a"]}, {"b": 1}),
        (OBJECT | {"required": ["b"]}, {}),
        ({"anyOf": [OBJECT, {"type": "object"}]}, {"a": 1}),
        ({"anyOf": [OBJECT, LOOSE]}, {"b": 1}),
        ({"anyOf": [{"type": "array"}, {"type": "array", "maxItems": 1}]}, [1, 2]),
        ({"anyOf": [{"type": "integer"}, {"type": "number"}]}, 1.5),
        ({"type": ["integer", "null"]}, None),
        ({"oneOf": [{"type": "integer"}, {"type": "null"}]}, 1),
        ({"oneOf": [{"type": "integer"}, {"type": "number"}]}, 1),
        ({"type": "string", "contentEncoding": "base64", "minLength": 8}, "AAAAAA=="),
        ({"type": "string", "contentEncoding": "base64", "minLength": 8}, [0, 0, 0, 255]),
        ({"type": "string", "contentEncoding": "base64", "maxLength": 4}, "AAAAAA=="),
    ],
)
def test_a_shape_and_the_search_agree_about_odd_cases(schema: Any, value: Any) -> None:
    read = JsonSchema(schema)
    expected, found = by_search(read, value), by_shape(read, value)

    assert found == expected


def test_bytes_of_a_fixed_length_are_sent_as_bytes() -> None:
    schema = {"type": "string", "contentEncoding": "base64", "minLength": 8, "maxLength": 8}
    sent, mismatch = by_shape(JsonSchema({"properties": {"a": schema}}), {"a": "AAAA/w=="})
    assert (sent, mismatch) == ({"a": b"\x00\x00\x00\xff"}, None)


def test_a_shape_is_prepared_once() -> None:
    schema: Any = {"type": "array", "items": {"type": "array", "items": {"type": "integer"}}}
    shapes = Shapes(JsonSchema(schema))
    shape_of_lists = shapes.of(schema)

    assert shapes.of(schema) is shape_of_lists
    for value in ([[1], [2]], [[3]]):
        assert shape_of_lists.convert(shapes.check(), value) == value
