from __future__ import annotations

from typing import Any

import pytest

from fibaction.schema.json_schema import MAX_PARTS, JsonSchema, SchemaError


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
