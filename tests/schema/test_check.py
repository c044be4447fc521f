from __future__ import annotations

import datetime
import operator
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from fibaction.schema.check import MAX_PARTS, Check, JsonSchema, Path, SchemaError
from fibaction.schema.keywords import bytes_of, size_in_bytes
from fibaction.schema.parts import SchemaParts


def visited(value: Any, schema: Any) -> tuple[Any, list[Path]]:
    """Return a value as it is sent, and where it does not match."""
    made, found = SchemaParts(JsonSchema(schema)).root.tried(Check(1000), value)
    return made, [one.path for one in found]


def fits(value: Any, schema: Any) -> bool:
    """Return whether the value matches the schema."""
    return not visited(value, schema)[1]


def sent(value: Any, schema: Any) -> Any:
    made, paths = visited(value, schema)
    assert paths == []
    return made


NAMES = st.sampled_from(["a", "b", "c"])
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 3) | st.sampled_from(["", "a", "abc", 1.0, 0.5]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=6,
)


def larger(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Schemas with these parts, of all keywords that are checked."""
    some = st.lists(inner, min_size=1, max_size=3)
    kinds = st.sampled_from(["null", "boolean", "integer", "number", "string", "array", "object"])
    small = st.integers(0, 3)
    return st.fixed_dictionaries(
        {},
        optional={
            "type": kinds | st.lists(kinds, min_size=1, max_size=2),
            "enum": st.lists(VALUES, max_size=3),
            "const": VALUES,
            "minimum": small,
            "exclusiveMaximum": small,
            "multipleOf": st.sampled_from([1, 2, 0.5]),
            "minLength": small,
            "maxItems": small,
            "minProperties": small,
            "required": st.lists(NAMES, max_size=2),
            "properties": st.dictionaries(NAMES, inner, max_size=2),
            "additionalProperties": inner,
            "propertyNames": inner,
            "prefixItems": some,
            "items": inner,
            "anyOf": some,
            "allOf": some,
            "oneOf": some,
            "not": inner,
            "$ref": st.sampled_from(["#/$defs/a", "#/$defs/b"]),
        },
    )


PARTS = st.recursive(st.booleans(), larger, max_leaves=6)
LEAVES = larger(st.booleans()).map(
    lambda schema: {key: schema[key] for key in schema if key != "$ref"}
)


def opened(schema: Any) -> Any:
    """Return the schema with a word for further fields, which are otherwise not allowed."""
    if isinstance(schema, dict):
        whole: dict[str, Any] = {
            key: part if key in ("enum", "const") else opened(part) for key, part in schema.items()
        }
        return {"additionalProperties": True, **whole} if "properties" in schema else whole
    return [opened(part) for part in schema] if isinstance(schema, list) else schema


@given(PARTS, LEAVES, LEAVES, VALUES)
@example({"anyOf": [True], "oneOf": [False]}, {}, {}, None)
def test_a_value_matches_where_a_complete_validator_says_so(
    part: Any, one: Any, other: Any, value: Any
) -> None:
    schema = opened({"$defs": {"a": one, "b": other}, "allOf": [part]})

    assert fits(value, schema) == Draft202012Validator(schema).is_valid(value)


def test_a_schema_with_fields_allows_no_others() -> None:
    schema: Any = {"properties": {"a": {"properties": {"b": {}}}}}

    assert fits({"a": {"b": 1}}, schema)
    assert not fits({"c": 1}, schema)
    assert not fits({"a": {"c": 1}}, schema)
    assert not fits({"c": 1}, {"properties": {"a": {}}, "unevaluatedProperties": False})


@pytest.mark.parametrize(
    "schema",
    [
        {"allOf": [{"properties": {"a": {}}}, {"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "anyOf": [{"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "oneOf": [{"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "$ref": "#/$defs/b", "$defs": {"b": {"properties": {"b": {}}}}},
        {"allOf": [{"properties": {"a": {}}}], "anyOf": [{"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "if": {}, "then": {"properties": {"b": {}}}},
        {"properties": {"a": {}}, "dependentSchemas": {"a": {"properties": {"b": {}}}}},
        {"properties": {"a": {}}, "unevaluatedProperties": {}},
        {"$ref": "#/$defs/b", "unevaluatedProperties": {}, "$defs": {"b": {"properties": {}}}},
        {"properties": {"a": {}}, "patternProperties": {"b": {}}, "additionalProperties": False},
    ],
)
def test_schemas_that_are_combined_allow_the_fields_of_all(schema: Any) -> None:
    assert fits({"a": 1, "b": 2}, schema)


def test_values_that_json_writes_as_text_are_checked_as_text() -> None:
    assert fits(b"hi", {"type": "string", "contentEncoding": "base64", "minLength": 4})
    assert fits([datetime.date(2026, 1, 31)], {"items": {"format": "date"}})
    assert not fits({"a": b"hi"}, {"properties": {"a": {"type": "integer"}}})
    assert not fits([1], {"prefixItems": [False]})
    assert fits({1: 2}, {"properties": {"1": {"type": "integer"}}})


def only(name: str, value: str) -> dict[str, Any]:
    """A map whose one field has one value."""
    return {"type": "object", "properties": {name: {"const": value}}}


TEXT: Any = {"type": "string", "contentEncoding": "base64"}
FIELDS: Any = {"properties": {"a": {"default": 1}, "b": {"contentEncoding": "base64"}}}
MAP: Any = FIELDS | {"type": "object"}
LEFT: Any = {"properties": {"kind": {"enum": ["left"]}, "x": {"default": 1}}, "type": "object"}
RIGHT: Any = {"properties": {"kind": {"const": "right"}, "y": TEXT}, "type": "object"}
TAGGED: Any = {"anyOf": [{"anyOf": [LEFT, {"$ref": "#/$defs/right"}]}, {"type": "null"}]}
TAGGED["$defs"] = {"right": RIGHT}
OBJECT: Any = {"type": "object", "properties": {"a": {"type": "integer"}}}
LOOSE: Any = {"type": "object", "additionalProperties": {"type": "integer"}}


@pytest.mark.parametrize(
    ("schema", "value", "made"),
    [
        ({"items": {"type": "integer"}}, [1, 2.0], [1, 2]),
        ({"prefixItems": [{"type": "integer"}], "items": True}, [3.0, 3.5, "a"], [3, 3.5, "a"]),
        ({"contentEncoding": "base64"}, [104, 105], b"hi"),
        ({"contentEncoding": "base64"}, "aGk=", b"hi"),
        (TEXT | {"minLength": 8, "maxLength": 8}, "AAAA/w==", b"\x00\x00\x00\xff"),
        (TEXT | {"minLength": 8, "maxLength": 8}, [0, 0, 0, 255], b"\x00\x00\x00\xff"),
        ({"additionalProperties": {"contentEncoding": "base64"}}, {1: "aGk="}, {1: b"hi"}),
        ({"properties": {"1": TEXT}}, {1: "aGk="}, {1: b"hi"}),
        (FIELDS, {"a": [2, 1.5]}, {"a": [2, 1.5]}),
        ({"properties": {"a": {"default": {"b": [1, "c"]}}}}, {}, {"a": {"b": [1, "c"]}}),
        ({"properties": {"a": TEXT | {"default": "aGk="}}}, {}, {"a": b"hi"}),
        ({"properties": {"a": True}}, {}, {}),
        ({"properties": {"a": {"default": 1}}, "required": ["a"]}, {}, {"a": 1}),
        ({"anyOf": [{"type": "null"}, MAP]}, {"b": "aGk="}, {"a": 1, "b": b"hi"}),
        ({"oneOf": [{"type": "null"}, MAP]}, {"b": "aGk="}, {"a": 1, "b": b"hi"}),
        ({"oneOf": [{"type": "null"}, MAP]}, None, None),
        ({"allOf": [{"type": "object"}, MAP]}, {}, {"a": 1}),
        ({"$ref": "#/$defs/m", "title": "m", "$defs": {"m": MAP}}, {}, {"a": 1}),
        ({"$ref": "#/$defs/m", "type": "object", "$defs": {"m": MAP}}, {}, {"a": 1}),
        (TAGGED, {"kind": "left"}, {"kind": "left", "x": 1}),
        (TAGGED, {"kind": "right", "y": "aGk="}, {"kind": "right", "y": b"hi"}),
        (TAGGED, None, None),
        ({"anyOf": [{"type": "integer", "minimum": 9}, {"type": "integer"}]}, 5.0, 5),
        ({"anyOf": [{"type": "integer"}, {"type": "number"}]}, 1.5, 1.5),
        ({"anyOf": [OBJECT, LOOSE]}, {"b": 1}, {"b": 1}),
        ({"anyOf": [{"type": "array", "maxItems": 1}, {"type": "array"}]}, [1, 2], [1, 2]),
        (OBJECT | {"minProperties": 1}, {"a": 1.0}, {"a": 1}),
        ({"items": FIELDS}, [{}, {}], [{"a": 1}, {"a": 1}]),
        (TEXT, b"hi", b"hi"),
        ({"enum": ["a"], "minLength": 1}, "a", "a"),
        ({"anyOf": [only("k", "l"), only("j", "r")]}, {"j": "r"}, {"j": "r"}),
    ],
)
def test_a_value_is_sent_in_the_form_of_its_schema(schema: Any, value: Any, made: Any) -> None:
    found = sent(value, schema)
    assert found == made
    assert repr(found) == repr(made)  # 3 is not 3.0


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


WHOLE = msgspec.json.schema(Whole)


@pytest.mark.parametrize(
    "value",
    [
        {"mode": "fast"},
        {"mode": "slow", "some": [1, 2.0], "maybe": 3, "any": [{"a": "x"}]},
        {"mode": "fast", "points": [{"x": 1}, {"y": 2.5, "x": 0, "note": "here"}]},
        {"mode": "fast", "tool": {"type": "left", "data": "aGk="}, "pair": [1, [104, 105]]},
        {"mode": "fast", "tool": {"type": "right", "kids": [{"type": "right"}] * 2}},
        {"mode": "fast", "names": {"a": {"x": 1}}, "at": "2026-01-02T03:04:05Z"},
    ],
)
def test_a_message_of_a_type_is_what_the_type_reads(value: Any) -> None:
    made = msgspec.convert(sent(value, WHOLE), Whole)
    assert made.mode == value["mode"]
    assert sent(msgspec.msgpack.decode(msgspec.msgpack.encode(made)), WHOLE)


@pytest.mark.parametrize(
    ("value", "path"),
    [
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
    ],
)
def test_the_field_that_does_not_match_is_found(value: Any, path: Path) -> None:
    assert visited(value, WHOLE)[1] == [path]


def test_a_default_of_another_type_is_checked_as_a_given_value() -> None:
    schema = {"type": "object", "properties": {"a": {"type": "integer", "default": "x"}}}
    assert visited({}, schema)[1] == [("a",)]
    assert fits({"a": 1}, schema)


def test_a_default_is_not_filled_in_itself() -> None:
    schema: Any = {"type": "object", "properties": {"a": {"$ref": "#", "default": {}}}}
    assert sent({}, schema) == {"a": {}}


def test_what_is_sent_shares_plain_lists_and_empty_maps() -> None:
    value: Any = [[1.0, 2], ["a"], [None]]
    schema: Any = {"items": {"items": {"type": ["number", "string", "null"]}}}
    assert all(map(operator.is_, sent(value, schema), value))
    made = sent([{}, {}], {"items": FIELDS})
    assert made[0] is made[1]


def test_numbers_of_a_list_cost_a_step_each() -> None:
    check = Check(10_000)
    schema = {"type": "array", "items": {"type": "integer"}}
    SchemaParts(JsonSchema(schema)).root.tried(check, [1] * 10_000)
    assert check.steps.spent < 10_100


def test_the_fields_that_a_value_leaves_out_are_found_at_any_depth() -> None:
    stop: Any = {"type": "object", "properties": {"x": {"default": 0}, "id": {}}}
    other: Any = {"type": "object", "properties": {"y": {"type": "null"}, "z": {}}}
    schema: Any = {
        "type": "object",
        "properties": {"stops": {"type": "array", "items": stop}, "by": {"type": "string"}},
        "additionalProperties": {"anyOf": [other, {"type": "integer"}, stop]},
    }
    value = {"stops": [{"x": 1, "id": 2}, {"x": 1}], "other": {"id": 3}, "1": 5}
    check = Check(100, fills=False)
    check.left_out = []
    SchemaParts(JsonSchema(schema)).root.tried(check, value)
    assert check.left_out == [("by",), ("stops", 1, "id"), ("other", "x")]


@pytest.mark.parametrize(
    ("values", "found"), [([1, 255], b"\x01\xff"), ([256], [256]), ([True], [True]), ([], b"")]
)
def test_a_list_of_bytes_becomes_bytes(values: list[Any], found: Any) -> None:
    assert bytes_of(values) == found


def test_the_bytes_of_a_value_are_those_in_a_message() -> None:
    assert size_in_bytes({"a": [1, "b"]}) == 7
    assert size_in_bytes(10**30) == 0


def doubled(levels: int, leaf: Any, keyword: str = "allOf") -> dict[str, Any]:
    """A schema that visits the leaf 2 ** levels times."""
    definitions = {
        str(level): {keyword: [{"$ref": f"#/$defs/{level + 1}"}] * 2} for level in range(levels)
    }
    with_default = {"properties": {"a": {"$ref": "#/$defs/0", "default": 5}}}
    whole = {**definitions, str(levels): leaf, "a": with_default}
    return {"$ref": "#/$defs/0", "$defs": whole}


@pytest.mark.parametrize(
    ("schema", "value"),
    [
        (doubled(40, True), 5),
        (doubled(40, True) | {"$ref": "#/$defs/a"}, {}),
        (doubled(40, False, "anyOf"), 5),
        (doubled(40, False, "oneOf"), 5),
        (doubled(10, {"enum": [list(range(1000))]}), list(range(1000))),
        (doubled(10, {"enum": ["x" * 10**6]}), "x" * 10**6),
        (doubled(10, {"required": ["a"] * 10_000}), {}),
        (doubled(14, {"contentEncoding": "base64"}), "a" * 4000),
        (doubled(16, {"properties": {"b": {}}, "additionalProperties": {}}), {"a": 1, "b": 2}),
    ],
)
def test_a_check_ends_after_a_limited_number_of_steps(schema: Any, value: Any) -> None:
    with pytest.raises(SchemaError, match="is too complex: a check by it takes over"):
        fits(value, schema)


def test_definitions_that_nothing_refers_to_are_not_read() -> None:
    JsonSchema({"$defs": {"a": {"$ref": "http://h/"}, "b": 5}, "default": {"$ref": "http://h/"}})


def test_a_schema_may_nest_to_any_depth() -> None:
    root: Any = {}
    for _ in range(MAX_PARTS - 1):
        root = {"items": root}

    JsonSchema(root)

    with pytest.raises(SchemaError, match="has more than 20,000 parts"):
        JsonSchema({"items": root})


@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        ("type", 5),
        ("type", [5]),
        ("minimum", "1"),
        ("maximum", True),
        ("minLength", -1),
        ("multipleOf", 0),
        ("multipleOf", float("inf")),
        ("multipleOf", float("nan")),
        ("enum", "abc"),
        ("anyOf", {}),
        ("properties", []),
        ("required", "name"),
        ("required", [1]),
        ("$ref", 5),
        ("format", []),
        ("contentEncoding", {}),
    ],
)
def test_a_keyword_with_a_wrong_value_is_an_error(keyword: str, value: Any) -> None:
    with pytest.raises(SchemaError, match=r"is malformed: .* cannot be "):
        JsonSchema({keyword: value})
