from __future__ import annotations

import datetime
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from fibaction.schema.check import Check
from fibaction.schema.json_schema import JsonSchema, SchemaError


def fits(value: Any, schema: Any) -> bool:
    """Return whether the value matches the schema."""
    return not list(Check(JsonSchema(schema), 100).mismatches(value, schema))


def chosen(value: Any, schema: Any) -> Any:
    return Check(JsonSchema(schema), 100).resolved(schema, value)


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


@pytest.mark.parametrize(
    "schema",
    [
        {"allOf": [{"properties": {"a": {}}}, {"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "anyOf": [{"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "oneOf": [{"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "$ref": "#/$defs/b", "$defs": {"b": {"properties": {"b": {}}}}},
        {"properties": {"a": {}}, "patternProperties": {"b": {}}, "additionalProperties": False},
    ],
)
def test_schemas_that_are_combined_allow_the_fields_of_all(schema: Any) -> None:
    assert fits({"a": 1, "b": 2}, schema)


def test_a_constant_is_the_only_value() -> None:
    assert fits({"a": [1, "b"]}, {"const": {"a": [1.0, "b"]}})
    assert not fits(True, {"const": 1})


@pytest.mark.parametrize(
    ("schema", "right", "wrong"),
    [
        ({"not": {"type": "null"}}, 1, None),
        ({"enum": [1, [2]]}, [2], [3]),
        ({"propertyNames": {"maxLength": 1}}, {"a": 1}, {"ab": 1}),
        ({"propertyNames": False}, [], {"a": 1}),
        ({"prefixItems": [{"type": "null"}], "items": False}, [None], [None, 1]),
        ({"items": {"type": "null"}}, [None], [1]),
        ({"oneOf": [{"minimum": 2}, {"maximum": 3}]}, 1, 2),
        ({"anyOf": [{"minimum": 4}, {"maximum": 3}]}, 4, 3.5),
        ({"allOf": [{"minimum": 2}, {"maximum": 3}]}, 2, 1),
        (False, None, 1),
    ],
)
def test_schemas_are_combined(schema: Any, right: Any, wrong: Any) -> None:
    assert fits(right, schema) == (schema is not False)
    assert not fits(wrong, schema)


def test_values_that_json_writes_as_text_are_checked_as_text() -> None:
    assert fits(b"hi", {"type": "string", "contentEncoding": "base64", "minLength": 4})
    assert fits([datetime.date(2026, 1, 31)], {"items": {"format": "date"}})
    assert not fits({"a": b"hi"}, {"properties": {"a": {"type": "integer"}}})
    assert not fits([1], {"prefixItems": [False]})
    assert fits({1: 2}, {"properties": {"1": {"type": "integer"}}})


def test_an_alternative_is_chosen_by_type_tag_or_content() -> None:
    left = {"properties": {"kind": {"enum": ["left"]}, "x": {}}}
    right = {"properties": {"kind": {"const": "right"}, "y": {}}}
    tagged = {"anyOf": [{"anyOf": [left, {"$ref": "#/$defs/right"}]}, {"type": "null"}]}
    schema = {**tagged, "$defs": {"right": right}}

    assert chosen({"kind": "left"}, schema) is left
    assert chosen({"kind": "right", "y": "wrong"}, schema) is right
    assert chosen(None, {"anyOf": [{"type": "object"}, {"type": "null"}]}) == {"type": "null"}
    assert chosen(5, schema) is left  # the first that says nothing against a number
    assert chosen({"kind": "up"}, schema) == {}
    assert chosen(5, {"anyOf": [{"minimum": 9}, {"maximum": 9}]}) == {"maximum": 9}
    assert chosen(5, {"anyOf": [False, {"minimum": 9}]}) == {"minimum": 9}
    assert chosen(5, True) == {}


@pytest.mark.parametrize(
    ("schema", "value", "passes"),
    [
        ({"type": "integer", "maximum": 3}, 3, True),
        ({"type": "integer", "maximum": 3}, 4, False),
        ({"type": "null"}, None, True),
        ({"enum": [1]}, 1, False),
        ({"$ref": "#/$defs/a", "$defs": {"a": True}}, 1, False),
        ({}, [], False),
        ({}, b"hi", False),
        (True, 1, False),
    ],
)
def test_a_scalar_passes_without_a_visit_where_comparisons_decide(
    schema: Any, value: Any, passes: bool
) -> None:
    assert Check(JsonSchema(schema), 1).passes(value, schema) is passes


def doubled(levels: int, leaf: Any, keyword: str = "allOf") -> dict[str, Any]:
    """A schema that visits the leaf 2 ** levels times."""
    definitions = {
        str(level): {keyword: [{"$ref": f"#/$defs/{level + 1}"}] * 2} for level in range(levels)
    }
    return {"$ref": "#/$defs/0", "$defs": {**definitions, str(levels): leaf}}


@pytest.mark.parametrize(
    ("schema", "value"),
    [
        (doubled(40, True), 5),
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


def test_the_choice_of_an_alternative_ends_after_a_limited_number_of_steps() -> None:
    with pytest.raises(SchemaError, match="is too complex"):
        chosen(5, doubled(40, False, "anyOf"))
    with pytest.raises(SchemaError, match="nests deeper than 200 levels for one value"):
        chosen(5, {"anyOf": [{"anyOf": [{"$ref": "#"}]}]})
