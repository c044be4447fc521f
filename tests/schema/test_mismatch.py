from __future__ import annotations

from typing import Any

import pytest

from fibaction.schema.check import Mismatch, only_value


@pytest.mark.parametrize(
    ("schema", "value"),
    [
        ({"const": None}, (None,)),
        ({"enum": ["left"]}, ("left",)),
        ({"enum": ["left", "right"]}, None),
        ({"enum": []}, None),
        ({}, None),
        (True, None),
    ],
)
def test_a_schema_with_one_value_is_a_tag(schema: Any, value: Any) -> None:
    assert only_value(schema) == value


def test_an_alternative_is_excluded_by_the_kind_of_the_value_or_by_a_tag() -> None:
    kind = Mismatch(("a",), "type", "null", 5, {}, is_other_kind=True)
    content = Mismatch(("a",), "minimum", 6, 5, {})
    tag = Mismatch(("a", "b"), "const", "left", "right", {"const": "left"})
    field = Mismatch(("a", "b"), "type", "null", 5, {}, is_other_kind=True)

    found = [one.excludes(("a",)) for one in (kind, content, tag, field)]
    assert found == [True, False, True, False]
