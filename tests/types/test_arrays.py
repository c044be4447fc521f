"""Arrays of numbers of `array` and of numpy as msgpack, and back."""

from __future__ import annotations

import array
import struct
import sys
from importlib import import_module
from typing import Any

import msgspec
import pytest

from fibaction.types import ros_messages
from fibaction.types.ros_messages import LARGE_ARRAY, pack, plain_array, unpack

numpy: Any = import_module("numpy")

encode = msgspec.msgpack.encode
decode = msgspec.msgpack.decode
COUNTS = [3, LARGE_ARRAY]


@pytest.mark.parametrize("count", [LARGE_ARRAY, 65536])
def test_a_large_array_of_each_width_is_packed_and_unpacked(count: int) -> None:
    for limits in map(numpy.iinfo, "bBhHiIqQ"):
        for number in (limits.min, limits.max):
            numbers = numpy.full(count, number, dtype=limits.dtype)
            packed = pack(numbers)
            assert decode(bytes(packed)) == numbers.tolist()
            assert unpack(packed).tolist() == numbers.tolist()


@pytest.mark.parametrize(
    "value",
    [
        b"\x00" * 300,
        [0] * (LARGE_ARRAY - 1),
        [None] * LARGE_ARRAY,
        [[]] * LARGE_ARRAY,
        [1, 1000] * LARGE_ARRAY,
        ["a"] * LARGE_ARRAY,
        # As long as LARGE_ARRAY numbers of three bytes each, but not these.
        [1000] * (LARGE_ARRAY - 2) + [1, 70000],
    ],
    ids=lambda value: f"{type(value).__name__} {value[0]!r}",
)
def test_a_value_that_is_not_a_large_array_of_like_numbers_is_left_to_msgspec(value: Any) -> None:
    packed = encode(value)
    assert unpack(msgspec.Raw(packed)) is None


def test_numbers_of_different_lengths_are_not_taken_for_like_ones() -> None:
    # 1000 in three bytes, 254 times; then one byte, and five: as long as 256 times three.
    packed = b"\xdc" + struct.pack(">H", LARGE_ARRAY)
    packed += b"\xcd\x03\xe8" * (LARGE_ARRAY - 2) + b"\x01" + b"\xce\x00\x01\x11\x70"
    assert len(packed) == 3 + 3 * LARGE_ARRAY
    assert unpack(msgspec.Raw(packed)) is None
    assert decode(packed) == [1000] * (LARGE_ARRAY - 2) + [1, 70000]


def test_small_numbers_of_one_byte_each_are_unpacked_unless_one_is_not_a_number() -> None:
    assert unpack(pack(numpy.full(LARGE_ARRAY, -32))).tolist() == [-32] * LARGE_ARRAY
    assert unpack(msgspec.Raw(encode([True] * LARGE_ARRAY))) is None


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("code", "bhHiIlLqQfd")
def test_an_array_of_the_standard_library_is_a_list_of_numbers(code: str, count: int) -> None:
    numbers = array.array(code, [3] * count)
    assert decode(encode(plain_array(numbers))) == numbers.tolist()


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize(
    "kind", ["i1", "<i2", ">i2", "u2", "<i4", ">u4", "i8", "u8", "f2", "<f4", ">f4", "f8", "g", "?"]
)
def test_an_array_of_numpy_is_a_list_of_numbers(kind: str, count: int) -> None:
    numbers = numpy.ones(count, kind)
    assert decode(encode(plain_array(numbers))) == [1] * count


@pytest.mark.parametrize(
    "numbers", [array.array("B", b"ab" * 4), numpy.frombuffer(b"ab" * 4, "u1")]
)
def test_numbers_of_8_bits_are_bytes_that_are_not_copied_before(numbers: Any) -> None:
    plain = plain_array(numbers)
    assert isinstance(plain, memoryview)
    assert decode(encode(plain)) == b"ab" * 4
    assert plain_array(numpy.frombuffer(b"ab" * 4, "u1")[::2]) == b"aaaa"


def test_more_dimensions_are_lists_of_lists_and_none_is_a_number() -> None:
    assert plain_array(numpy.zeros((2, 1), "u1")) == [[0], [0]]
    assert plain_array(numpy.float32(0.5)) == 0.5
    assert type(plain_array(numpy.longdouble(0.5))) is float
    assert plain_array(numpy.array([])) == []


def test_without_numpy_arrays_of_the_standard_library_are_lists(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ros_messages, "numpy", lambda: None)
    assert plain_array(array.array("d", [0.5] * LARGE_ARRAY)) == [0.5] * LARGE_ARRAY
    assert unpack(msgspec.Raw(encode([0.5] * LARGE_ARRAY))) is None


def test_numpy_is_none_where_it_is_not_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ros_messages.numpy.cache_clear()
    assert ros_messages.numpy() is numpy
    ros_messages.numpy.cache_clear()
    monkeypatch.setitem(sys.modules, "numpy", None)
    monkeypatch.setattr(ros_messages, "find_spec", lambda name: None)
    assert ros_messages.numpy() is None
    ros_messages.numpy.cache_clear()
