from fractions import Fraction
from typing import Any

import pytest
from msgspec.msgpack import Ext

from fibaction.words.plain_data import (
    MAX_QUOTED,
    check_is_number,
    is_list,
    is_map,
    quoted,
)


@pytest.mark.parametrize(
    ("value", "kinds"),
    [
        ({}, (True, False)),
        *((value, (False, True)) for value in ([1], (), set[int](), frozenset[int]())),
        *((value, (False, False)) for value in ("text", b"bytes", 5, None)),
    ],
)
def test_maps_and_lists_are_told_apart_from_other_values(
    value: object, kinds: tuple[bool, bool]
) -> None:
    assert (is_map(value), is_list(value)) == kinds


def test_an_argument_that_is_not_a_number_is_told_by_its_name() -> None:
    for number in (1, 1.5, Fraction(1, 3)):
        check_is_number("timeout", number)
    with pytest.raises(TypeError, match="timeout must be a number, not '5'"):
        check_is_number("timeout", "5")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"a": [1, None, "ü"], "b": 2.5}, '{"a":[1,null,"ü"],"b":2.5}'),
        (b"hi", '"aGk="'),
        ("\ud800", r'"\ud800"'),
        ("\x1b\x9b\u202e", r'"\u001b\x9b\u202e"'),
        (-(10**500), '"-1e60 and more"'),
        (Ext(1, b""), '"<Ext>"'),
        ({(1, 2): 3}, '{"[1, 2]":3}'),
    ],
)
def test_a_value_is_quoted_as_json_on_one_printable_line(value: Any, text: str) -> None:
    assert quoted(value) == text


def test_the_quotation_of_a_large_value_is_short() -> None:
    deep: Any = []
    for _ in range(10_000):
        deep = [deep]
    wide: Any = {f"{i}": list(range(1000)) for i in range(1000)}
    values: list[Any] = [deep, wide, [[]] * 10**6, {"x" * 10**6: "y" * 10**6}]
    for value in values:
        assert len(quoted(value)) == MAX_QUOTED + len("...")
