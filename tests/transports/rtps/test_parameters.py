"""The values of parameters: read when asked for, and never believed blindly."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import pytest

from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.ids import Guid, udp_locator
from fibaction_transports.rtps.messages.layout import BIG, LITTLE, InvalidPacket
from fibaction_transports.rtps.messages.parameters import (
    Parameters,
    SampleIdentity,
    identity_value,
    locator_items,
    parameters_bytes,
    read_parameters,
    text_value,
)

GUID = Guid(range(16))


def one(value: bytes, pid: int = 5) -> Parameters:
    return Parameters(((pid, value),))


def test_values_are_read_in_the_byte_order_of_their_list() -> None:
    items = (
        (1, b""),
        (5, b"\0\0\0\x06hello\0"),
        (0x58, b"\0\0\x0c\x3f"),
        (2, b"\0\0\0\x14\x80\0\0\0"),
    )
    big = Parameters(items, BIG)
    assert big.text(5) == "hello"
    assert big.u32(0x58, 0) == 0xC3F
    assert big.duration(2, 0) == 20.5
    assert big.duration(3, math.inf) == math.inf
    assert big.u32(9, 7) == 7
    assert (big.text(9), big.guid(9), big.identity(9), big.blob(9)) == (None,) * 4


def test_a_list_is_read_with_its_padding_and_without_the_bits_of_vendors() -> None:
    pad, sentinel = struct.pack("<HH", 0, 4) + bytes(4), struct.pack("<HH", 1, 0)
    known = struct.pack("<HH", 0x4005, 4) + b"abcd"
    tag = struct.pack("<HH", 0x4014, 4) + b"efgh"
    found, end = read_parameters(pad + known + tag + sentinel + b"rest", LITTLE)
    assert found.items == ((5, b"abcd"), (pids.DOMAIN_TAG, b"efgh"))
    assert end == 8 + 8 + 8 + 4


def test_an_identifier_is_shown_in_hexadecimal_digits() -> None:
    assert repr(GUID) == f"Guid({GUID})" == "Guid(000102030405060708090a0b0c0d0e0f)"


def test_values_are_padded() -> None:
    assert parameters_bytes(one(b"abc")) == b"\x05\0\x04\0abc\0\x01\0\0\0"


def test_a_sample_is_named_by_its_writer_and_number() -> None:
    identity = SampleIdentity(GUID, 2**33 + 5)
    assert one(identity_value(identity)).identity(5) == identity
    unknown = SampleIdentity(GUID, -(2**32))
    assert one(identity_value(unknown)).identity(5) == unknown


def test_locators_of_all_parameters_are_read() -> None:
    locators = [udp_locator(("10.0.0.1", 1)), udp_locator(("10.0.0.2", 2))]
    items = (*locator_items(0x31, locators), (0x32, b""))
    assert Parameters(tuple(items)).locators(0x31) == locators


def test_texts_of_a_sequence_are_read() -> None:
    value = struct.pack("<I", 2) + text_value("a") + b"\0" * 2 + text_value("bcd")
    assert one(value).texts(5) == ["a", "bcd"]
    assert one(struct.pack("<I", 0)).texts(5) == []
    assert one(b"").texts(6) == []


BROKEN: dict[str, Callable[[], object]] = {
    "short guid": lambda: one(b"abc").guid(5),
    "short number": lambda: one(b"abc").u32(5, 0),
    "short duration": lambda: one(b"abcdefg").duration(5, 0),
    "short identity": lambda: one(bytes(20)).identity(5),
    "short locator": lambda: one(bytes(20)).locators(5),
    "text beyond its value": lambda: one(struct.pack("<I", 9) + b"abc").text(5),
    "text of 4 GiB": lambda: one(struct.pack("<I", 2**32 - 1) + b"abc").text(5),
    "long text": lambda: one(text_value("x" * 2000)).text(5),
    "not UTF-8": lambda: one(struct.pack("<I", 2) + b"\xff\0").text(5),
    "texts beyond the value": lambda: one(struct.pack("<I", 9) + text_value("abc")).texts(5),
    "texts that are not UTF-8": lambda: one(struct.pack("<III", 1, 1, 0xFF)).texts(5),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_value_is_invalid(name: str) -> None:
    with pytest.raises(InvalidPacket):
        BROKEN[name]()
