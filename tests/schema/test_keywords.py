from __future__ import annotations

from typing import Any

import pytest

from fibaction.schema.check import Check, JsonSchema
from fibaction.schema.parts import SchemaParts

UUID = "12345678-1234-5678-1234-567812345678"
NAN = float("nan")


@pytest.mark.parametrize(
    ("keyword", "expected", "right", "wrong"),
    [
        ("type", "integer", [1, 2.0, 10**400], [1.5, True, "1", float("inf")]),
        ("type", "unheard of", [None, "a"], []),
        ("enum", [[1, 2]], [[1, 2.0]], [[1], [1, 2, 3], [1, 3]]),
        ("minimum", 2, [2, 3, "a", NAN, True], [1, 1.5]),
        ("maximum", 2.5, [2, "a", NAN], [3, 10**400]),
        ("exclusiveMinimum", 2, [3, NAN], [2]),
        ("exclusiveMaximum", 2, [1, NAN], [2]),
        ("multipleOf", 2, [4, 4.0, "a", 10**400], [3, 4.5, NAN, float("inf")]),
        ("multipleOf", 5e-324, [10**400], [NAN]),
        ("multipleOf", 0.01, [19.99, 0.3, -19.99, 1e22], [19.995, 0.001]),
        ("multipleOf", 0.5, [1e308], [0.4]),
        ("format", "date", ["2026-01-31", 5], ["soon", "\ud800"]),
        ("format", "duration", ["PT1S", "P2W", "P1M", "1 day, 1:00:00"], ["P", "PT", "soon"]),
        ("format", "date-time", ["2025-01-01T00:00Z", "2025-01-01T00:00:00"], ["12:00"]),
        ("format", "date-time-local", ["2025-01-01T00:00:00"], ["2025-01-01T00:00:00Z"]),
        ("format", "time", ["12:00", "12:00:00Z"], ["noon"]),
        ("format", "iso-time", ["12:00:00", "12:00:00Z"], ["12:00"]),
        ("format", "partial-time", ["12:00:00"], ["12:00:00Z"]),
        ("format", "uuid", [UUID, f"urn:uuid:{UUID}"], ["1"]),
        ("format", "regex", ["("], []),
        ("contentEncoding", "base64", ["aGk=", 5], ["?", "a", "ü"]),
        ("contentEncoding", "gzip", ["?"], []),
    ],
)
def test_a_value_is_compared_as_the_keyword_says(
    keyword: str, expected: Any, right: list[Any], wrong: list[Any]
) -> None:
    part = SchemaParts(JsonSchema({keyword: expected, "additionalProperties": True})).root
    assert [part.tried(Check(10), value)[1] for value in right] == [[]] * len(right)
    assert [len(part.tried(Check(10), value)[1]) for value in wrong] == [1] * len(wrong)
