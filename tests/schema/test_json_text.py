"""`read_json` of `fibaction.schema.turns`: JSON texts of strangers."""

from __future__ import annotations

import json
from time import thread_time
from typing import Any

import msgspec
import pytest

from fibaction.schema.turns import MOST_COSTLY, has_costly_numbers, read_json

COSTLY = ["1e308"] * (MOST_COSTLY + 1)
HALVES = [r'"\ud83e"', r'"\uDD16\ud83e"', r'{"\udd16":1}']


def listed(*more: str) -> str:
    return f"[{','.join([*COSTLY, *more])}]"


@pytest.mark.parametrize(
    "number", ["1e308", "1e-308", "1E+0308", "17976931348623157e292", "1.e300"]
)
def test_numbers_that_take_long_are_found(number: str) -> None:
    for text in (",".join([number] * 101), ",".join([number] * 101).encode()):
        assert has_costly_numbers(text)
    assert not has_costly_numbers(",".join([number] * 100))
    assert not has_costly_numbers(",".join(["1.5e99", "123", '"see300"'] * 1000))


@pytest.mark.parametrize(
    "more", ['"e"', "1.5", "-0.0", "null", '{"a":[true,"\\u00e9"]}', "12345", '"\\ud83e\\uDD16"']
)
def test_a_text_has_the_same_value_either_way(more: str) -> None:
    text = listed(more)
    assert read_json(text) == read_json(text.encode()) == msgspec.json.decode(text)
    assert read_json(more) == json.loads(more)


@pytest.mark.parametrize(
    "more", ["1e400", "-1e999", "NaN", "Infinity", "1e", '"\x01"', "'a'", "]", *HALVES]
)
def test_what_is_not_json_is_an_error_either_way(more: str) -> None:
    for text in (listed(more), more):
        with pytest.raises(ValueError, match=r"."):
            read_json(text)
        with pytest.raises(ValueError, match=r"."):
            read_json(text.encode())


def test_bytes_that_are_no_text_and_deep_nesting_are_errors() -> None:
    with pytest.raises(ValueError, match="utf-8"):
        read_json(listed().encode() + b"\xff")
    with pytest.raises(RecursionError):
        read_json(listed("[" * 100_000))


def test_a_mebibyte_of_the_worst_numbers_takes_a_tenth_of_what_msgspec_takes() -> None:
    def seconds(read: Any, text: str) -> float:
        began = thread_time()
        read(text)
        return thread_time() - began

    text = f"[{','.join(['1e308'] * 20_000)}]"
    assert seconds(read_json, text) * 3 < seconds(msgspec.json.decode, text)
