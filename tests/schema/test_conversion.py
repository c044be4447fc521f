from __future__ import annotations

from typing import Any

import pytest

from fibaction.schema.check import Check
from fibaction.schema.conversion import (
    NoMatch,
    bytes_of,
    converted,
    converted_default,
    left_out,
    size_in_bytes,
)
from fibaction.schema.json_schema import JsonSchema, SchemaError

FIELDS: Any = {"properties": {"a": {"default": 1}, "b": {"contentEncoding": "base64"}}}


def check_of(schema: Any) -> Check:
    return Check(JsonSchema(schema), 10)


@pytest.mark.parametrize("keyword", ["anyOf", "oneOf"])
def test_a_value_gets_the_defaults_of_the_alternative_that_it_fits(keyword: str) -> None:
    schema = {keyword: [{"type": "null"}, FIELDS | {"type": "object"}]}

    assert converted(check_of(schema), {"b": "aGk="}, schema) == {"a": 1, "b": b"hi"}
    assert converted(check_of(schema), None, schema) is None


def test_a_value_that_does_not_match_is_told_with_its_place() -> None:
    with pytest.raises(NoMatch) as caught:
        converted(check_of(FIELDS), {"b": "?"}, FIELDS)

    assert caught.value.mismatch.path == ("b",)


@pytest.mark.parametrize(
    ("values", "found"), [([1, 255], b"\x01\xff"), ([256], [256]), ([True], [True]), ([], b"")]
)
def test_a_list_of_bytes_becomes_bytes(values: list[Any], found: Any) -> None:
    assert bytes_of(values) == found


def test_a_default_is_made_once_and_must_be_of_its_type() -> None:
    text = {"type": "string", "contentEncoding": "base64"}

    assert converted_default(check_of({}), text | {"default": "aGk="}) == b"hi"
    with pytest.raises(NoMatch):
        converted_default(check_of({}), text | {"default": 5})


def test_a_default_may_not_nest_deeply() -> None:
    value: Any = 0
    for _ in range(101):
        value = {"a": [value]}

    with pytest.raises(SchemaError, match="has a default that nests deeper than 100 levels"):
        converted_default(check_of({}), {"default": value})


def test_the_bytes_of_a_value_are_those_in_a_message() -> None:
    assert size_in_bytes({"a": [1, "b"]}) == 7
    assert size_in_bytes(10**30) == 0


@pytest.mark.parametrize(
    ("schema", "value", "sent"),
    [
        ({"items": {"type": "integer"}}, [1, 2.0], [1, 2]),
        ({"items": {"type": "integer"}}, [1.0, None, True], None),
        ({"prefixItems": [{"type": "integer"}], "items": True}, [3.0, 3.5, "a"], [3, 3.5, "a"]),
        ({"contentEncoding": "base64"}, [104, 105], b"hi"),
        ({"contentEncoding": "base64"}, "aGk=", b"hi"),
        ({"additionalProperties": {"contentEncoding": "base64"}}, {1: "aGk="}, {1: b"hi"}),
        (FIELDS, {"a": [2, 1.5]}, {"a": [2, 1.5]}),
        ({"properties": {"a": {"default": {"b": [1, "c"]}}}}, {}, {"a": {"b": [1, "c"]}}),
        ({"properties": {"a": True}}, {}, {}),
    ],
)
def test_a_value_is_sent_in_the_form_of_its_schema(schema: Any, value: Any, sent: Any) -> None:
    if sent is None:
        with pytest.raises(NoMatch):
            converted(check_of(schema), value, schema)
    else:
        assert converted(check_of(schema), value, schema) == sent


def test_the_fields_that_a_value_leaves_out_are_named_at_any_depth() -> None:
    stop: Any = {"type": "object", "properties": {"x": {"default": 0}, "id": {}}}
    schema: Any = {
        "type": "object",
        "properties": {"stops": {"type": "array", "items": stop}, "by": {"type": "string"}},
        "additionalProperties": stop,
    }
    value = {"stops": [{"x": 1, "id": 2}, {"x": 1}], "other": {"id": 3}, "1": 5}

    assert list(left_out(check_of(schema), value, schema)) == [".by", ".stops[1].id", ".other.x"]
    assert list(left_out(check_of(schema), {"by": "me", "stops": []}, schema)) == []
