from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import pytest
from jsonschema import Draft202012Validator, ValidationError

from fibaction._json_errors import place, quoted, sentences


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
    validator = Draft202012Validator(msgspec.json.schema(kind))
    errors = sorted(validator.iter_errors(value), key=place)
    return [text for error in errors for text in sentences(error, "goal")]


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
            [f'goal: "{"x" * 59}... is too long'],
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


@pytest.mark.parametrize(
    ("keyword", "value", "text"),
    [
        ("format", "date-time", 'goal must be a date and time in ISO 8601, not "soon"'),
        ("format", "uuid", 'goal must be a UUID, not "soon"'),
        ("contentEncoding", "base64", 'goal must be bytes in base64, not "soon"'),
    ],
)
def test_text_in_a_wrong_format_is_reported_with_the_format(
    keyword: str, value: str, text: str
) -> None:
    error = ValidationError("", validator=keyword, validator_value=value, instance="soon")

    assert list(sentences(error, "goal")) == [text]


def test_a_list_of_types_is_reported_like_alternatives() -> None:
    (error,) = Draft202012Validator({"type": ["integer", "null"]}).iter_errors("x")

    assert list(sentences(error, "feedback")) == [
        'feedback must be a whole number or null, not "x"'
    ]


def test_a_long_value_is_quoted_in_part() -> None:
    assert quoted("x" * 1000) == '"' + "x" * 59 + "..."
