"""`fibaction_transports.web.rosbridge.action_values`: values as rosbridge has them."""

from __future__ import annotations

import math
import sys
from typing import Any

import msgspec
import pytest

from fibaction.schema.payload import PayloadError
from fibaction.types.action import ActionInfo
from fibaction_transports.web.rosbridge.action_values import (
    LONGEST_LIST,
    ActionValues,
    MessageValues,
    arguments_text,
)

POSE = {
    "type": "object",
    "properties": {
        "raw": {"type": "string", "contentEncoding": "base64", "default": ""},
        "xs": {"type": "array", "items": {"$ref": "#/$defs/x"}, "default": []},
        "name": {"anyOf": [{"type": "string"}, {"type": "null"}], "default": None},
    },
    "$defs": {"x": {"type": "number"}},
}


def decoded(payload: bytes | None) -> Any:
    assert payload is not None
    return msgspec.msgpack.decode(payload)


def test_bytes_are_base64_text_or_numbers_and_null_is_nan_where_a_number_is() -> None:
    pose = MessageValues(POSE, "feedback")
    found = decoded(pose.encode({"raw": "AAH/", "xs": [1, None]}))
    assert (found["raw"], found["xs"][0], found["name"]) == (b"\0\1\xff", 1, None)
    assert math.isnan(found["xs"][1])
    assert decoded(pose.encode({"raw": [1, 2]}))["raw"] == b"\1\2"


def test_values_that_do_not_fit_are_an_error() -> None:
    with pytest.raises(PayloadError, match=r"feedback\.xs"):
        MessageValues(POSE, "feedback").encode({"xs": ["a"]})
    nested: Any = []
    for _ in range(5000):
        nested = [nested]
    deep = {"$ref": "#/$defs/n", "$defs": {"n": {"type": "array", "items": {"$ref": "#/$defs/n"}}}}
    with pytest.raises(PayloadError, match="nested too deeply"):
        MessageValues(deep, "feedback").encode(nested)


def test_a_goal_that_ends_early_has_a_result_only_if_it_has_another_than_an_empty_one() -> None:
    values = ActionValues(ActionInfo("a", result=POSE))
    whole: dict[str, Any] = {"raw": "", "xs": [], "name": None}
    for empty in (None, {}, whole):
        assert values.partial_result(empty) is None
    assert decoded(values.partial_result({"xs": [1]}))["xs"] == [1]
    assert decoded(values.result(None)) == decoded(values.result(whole))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_goal_with_a_number_that_json_does_not_have_is_an_error(number: float) -> None:
    for goal in (number, {"a": [1, {"b": number}]}):
        with pytest.raises(PayloadError, match="NaN or infinite, which rosbridge cannot carry"):
            arguments_text(msgspec.msgpack.encode(goal))
    assert arguments_text(msgspec.msgpack.encode({"a": [None]})) == '{"a":[null]}'


def test_no_goal_is_a_message_without_fields() -> None:
    assert arguments_text(b"\xc0") == arguments_text(b"\x80") == "{}"


def test_bytes_of_a_goal_are_numbers_unless_they_are_many() -> None:
    goal = msgspec.msgpack.encode({"raw": b"\0\xff", "parts": [{"x": b""}], "n": 1})
    assert arguments_text(goal) == '{"raw":[0,255],"parts":[{"x":[]}],"n":1}'
    assert arguments_text(msgspec.msgpack.encode(b"\1")) == '{"data":[1]}'
    for length, begin in ((LONGEST_LIST, '{"raw":[7,7,'), (LONGEST_LIST + 1, '{"raw":"BwcH')):
        assert arguments_text(msgspec.msgpack.encode({"raw": b"\7" * length})).startswith(begin)


def test_a_goal_that_is_nested_too_deeply_is_an_error() -> None:
    # How deep is too deep, and for whom first, differs between versions of Python.
    errors = {_error_of_nested(depth) for depth in range(100, 20 * sys.getrecursionlimit(), 200)}
    assert None in errors
    assert "the goal is nested too deeply" in errors
    assert _error_of_nested(20 * sys.getrecursionlimit()) is not None


def _error_of_nested(depth: int) -> str | None:
    try:
        arguments_text(b"\x91" * depth + b"\xc0")
    except PayloadError as exc:
        return str(exc)
    return None
