"""Submessages as bytes and back, in both byte orders, and those that break a rule."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fibaction_transports.rtps.messages import layout
from fibaction_transports.rtps.messages.codec import packet_head, read_packet, submessage_bytes
from fibaction_transports.rtps.messages.ids import (
    Locator,
    locator_bytes,
    read_locator,
    udp_locator,
)
from fibaction_transports.rtps.messages.layout import (
    BIG,
    LITTLE,
    MAX_NUMBER,
    InvalidPacket,
    Order,
    duration_bytes,
    read_duration,
    seconds_of,
    time_halves,
)
from fibaction_transports.rtps.messages.parameters import Parameters
from fibaction_transports.rtps.messages.submessages import (
    AckNack,
    Data,
    DataFragment,
    Destination,
    FragmentNack,
    Gap,
    NumberSet,
    SourceInfo,
    Submessage,
    Timestamp,
    WriterHeartbeat,
)

HEAD = packet_head(b"\x01\x7f", bytes(12))
ENTITY = st.binary(min_size=4, max_size=4)
PREFIX = st.binary(min_size=12, max_size=12)
NUMBER = st.integers(1, MAX_NUMBER - 1)
COUNT = st.integers(0, 2**31 - 1)
ENDS = b"\0\0\1\4", b"\0\0\2\3"


@st.composite
def number_sets(draw: st.DrawFn, largest: int = MAX_NUMBER - 1, least: int = 1) -> NumberSet:
    base = draw(st.integers(least, largest))
    steps = draw(st.sets(st.integers(0, 255)))
    return NumberSet(base, tuple(sorted(base + step for step in steps if base + step > 0)))


@st.composite
def parameter_lists(draw: st.DrawFn, order: Order) -> Parameters | None:
    values = st.binary(max_size=5).map(lambda value: value * 4)
    pids = st.sampled_from([0x05, 0x70, 0x83, 0x800F, 0x4014])
    items = draw(st.none() | st.lists(st.tuples(pids, values), max_size=4))
    return None if items is None else Parameters(tuple(items), order)


@st.composite
def fragments(draw: st.DrawFn, order: Order) -> DataFragment:
    size, whole = draw(st.integers(1, 300)), draw(st.integers(4, 2000))
    total = -(-whole // size)
    first = draw(st.integers(1, total))
    count = draw(st.integers(1, total - first + 1))
    content = bytes(min(count * size, whole - (first - 1) * size))
    ends = draw(ENTITY), draw(ENTITY), draw(NUMBER)
    inline = draw(parameter_lists(order))
    return DataFragment(*ends, first, count, size, whole, content, inline, draw(st.booleans()))


@st.composite
def submessages(draw: st.DrawFn, order: Order) -> Submessage:
    entity, number, count = draw(ENTITY), draw(NUMBER), draw(COUNT)
    ends = entity, draw(ENTITY)
    flag, other = draw(st.booleans()), draw(st.booleans())
    content = draw(st.none() | st.binary(min_size=4, max_size=50))
    last = draw(st.integers(number - 1, MAX_NUMBER - 1))
    found: list[Submessage] = [
        Data(
            *ends,
            number,
            content,
            draw(parameter_lists(order)),
            flag and content is not None,
        ),
        draw(fragments(order)),
        WriterHeartbeat(*ends, number, last, count, flag, other),
        AckNack(*ends, draw(number_sets(least=0)), count, flag),
        FragmentNack(*ends, number, draw(number_sets(largest=2**31)), count),
        Gap(*ends, number, NumberSet(last + (last < number))),
        Destination(draw(PREFIX)),
        Timestamp(None if flag else draw(st.integers(0, 2**31 - 2))),
        SourceInfo(draw(st.binary(min_size=2, max_size=2)), draw(PREFIX)),
    ]
    return draw(st.sampled_from(found))


ORDERED = st.sampled_from([LITTLE, BIG]).flatmap(
    lambda order: st.tuples(st.just(order), st.lists(submessages(order), max_size=5))
)


EXAMPLES: list[Submessage] = [
    Data(*ENDS, 1, b"\0\1\0\0abcd", None, True),
    Data(*ENDS, 2**40),
    DataFragment(*ENDS, 3, 2, 2, 8, 23, bytes(15), None, True),
    WriterHeartbeat(*ENDS, 5, 4, 7, True, True),
    AckNack(*ENDS, NumberSet(2**33, (2**33, 2**33 + 255)), 8, True),
    FragmentNack(*ENDS, 5, NumberSet(1, (3, 33)), 9),
    Gap(*ENDS, 5, NumberSet(9, (11,))),
    SourceInfo(b"\1\x0f", bytes(range(12))),
    Timestamp(1_000_000),
    Timestamp(None),
]


@given(ORDERED)
@example((LITTLE, EXAMPLES))
@example((BIG, EXAMPLES))
def test_submessages_are_read_as_they_were_written(case: tuple[Order, list[Submessage]]) -> None:
    order, written = case
    packet = read_packet(HEAD + b"".join(submessage_bytes(each, order) for each in written))
    assert list(packet.submessages) == written


@given(ORDERED, st.data())
def test_changed_bytes_are_read_or_invalid(
    case: tuple[Order, list[Submessage]], data: st.DataObject
) -> None:
    order, written = case
    datagram = bytearray(HEAD + b"".join(submessage_bytes(each, order) for each in written))
    for _ in range(data.draw(st.integers(1, 4))):
        datagram[data.draw(st.integers(0, len(datagram) - 1))] = data.draw(st.integers(0, 255))
    del datagram[data.draw(st.integers(0, len(datagram))) :]
    try:
        read_packet(bytes(datagram))
    except InvalidPacket:
        return


def raw(kind: int, body: bytes, flags: int = 1, size: int | None = None) -> bytes:
    """Return a packet of one submessage."""
    length = len(body) if size is None else size
    return HEAD + struct.pack("<BBH", kind, flags, length) + body


def test_the_last_submessage_may_leave_out_its_length() -> None:
    data = Data(*ENDS, 7, b"\0\1\0\0abcd")
    body = submessage_bytes(data)[4:]
    assert read_packet(raw(layout.DATA, body, 5, size=0)).submessages == (data,)


def test_padding_and_an_invalid_time_have_no_length() -> None:
    content = struct.pack("<BBH", layout.PAD, 1, 0) + struct.pack("<BBH", layout.INFO_TS, 3, 0)
    packet = read_packet(HEAD + content + submessage_bytes(Destination(bytes(12))))
    assert packet.submessages == (Timestamp(None), Destination(bytes(12)))


def test_submessages_of_vendors_are_left_out() -> None:
    packet = read_packet(raw(0x80, bytes(56)) + submessage_bytes(Destination(bytes(12))))
    assert packet.submessages == (Destination(bytes(12)),)


def heartbeat(first: int, last: int) -> bytes:
    halves = (first >> 32, first & 0xFFFFFFFF, last >> 32, last & 0xFFFFFFFF)
    return struct.pack("<4s4siIiIi", *ENDS, *halves, 1)


def fragment(**changed: Any) -> bytes:
    fields: dict[str, Any] = {
        "inline": 28,
        "first": 1,
        "count": 1,
        "size": 8,
        "whole": 8,
        "content": bytes(8),
    }
    fields |= changed
    head = struct.pack("<HH4s4siI", 0, fields["inline"], *ENDS, 0, 1)
    tail = struct.pack("<IHHI", *(fields[name] for name in ("first", "count", "size", "whole")))
    content: bytes = fields["content"]
    return head + tail + content


INVALID = {
    "nothing": (b"", "does not begin as RTPS does"),
    "another protocol": (b"HTTP/1.1 200 OK\r\n\r\n\r\n", "does not begin as RTPS does"),
    "version 1": (b"RTPS\x01\x00" + bytes(14), "version 1 of RTPS is not 2"),
    "too long": (raw(layout.DATA, b"", size=20), "20 bytes is longer than its datagram"),
    "too short": (raw(layout.HEARTBEAT, bytes(20)), "shorter than its kind"),
    "number 0": (raw(layout.HEARTBEAT, heartbeat(0, 0)), "sequence number 0 is not between 1"),
    "number 2^62": (raw(layout.HEARTBEAT, heartbeat(2**62, 2**62)), "is not between 1 and 2"),
    "negative number": (raw(layout.HEARTBEAT, heartbeat(1, -5)), "number -5 is not between 0"),
    "last before first": (raw(layout.HEARTBEAT, heartbeat(9, 7)), "number 7 is not between 8"),
    "no encapsulation": (
        raw(layout.DATA, struct.pack("<HH4s4siI", 0, 16, *ENDS, 0, 1) + b"ab", 5),
        "payload of 2 bytes has no encapsulation header",
    ),
    "inline QoS before its place": (raw(layout.DATA_FRAG, fragment(inline=4)), "byte 8 is outside"),
    "inline QoS after the end": (raw(layout.DATA_FRAG, fragment(inline=99)), "byte 103 is outside"),
    "fragment 0": (raw(layout.DATA_FRAG, fragment(first=0)), "fragments 0 to 0 are not in"),
    "no fragments": (raw(layout.DATA_FRAG, fragment(count=0)), "fragments 1 to 0 are not in"),
    "fragment 2 of 1": (raw(layout.DATA_FRAG, fragment(first=2)), "fragments 2 to 2 are not in"),
    "fragments of no bytes": (raw(layout.DATA_FRAG, fragment(size=0)), "beyond the limits"),
    "2^32 fragments": (
        raw(layout.DATA_FRAG, fragment(size=1, whole=2**32 - 1)),
        "sample of 4294967295 bytes in fragments of 1 is beyond the limits",
    ),
    "missing bytes": (raw(layout.DATA_FRAG, fragment(content=b"abc")), "have 3 of 8 bytes"),
    "a set of 257": (
        raw(layout.ACK_NACK, struct.pack("<4s4siII", *ENDS, 0, 1, 257) + bytes(44)),
        "set of 257 numbers exceeds 256",
    ),
    "a GAP that goes back": (
        raw(layout.GAP, struct.pack("<4s4siIiII", *ENDS, 0, 9, 0, 8, 0)),
        "number 8 is not between 9",
    ),
    "a short prefix": (raw(layout.INFO_DST, bytes(8)), "destination is shorter than a prefix"),
    "endless parameters": (
        raw(
            layout.DATA,
            struct.pack("<HH4s4siI", 0, 16, *ENDS, 0, 1) + struct.pack("<HH", 5, 0) * 300,
            3,
        ),
        "no end within 256 parameters",
    ),
    "a long parameter": (
        raw(
            layout.DATA,
            struct.pack("<HH4s4siI", 0, 16, *ENDS, 0, 1) + struct.pack("<HH", 5, 99),
            3,
        ),
        "parameter 0x5 of 99 bytes is longer than its list",
    ),
}


@pytest.mark.parametrize("name", INVALID)
def test_a_packet_that_breaks_a_rule_is_invalid(name: str) -> None:
    datagram, reason = INVALID[name]
    with pytest.raises(InvalidPacket, match=reason):
        read_packet(datagram)


def test_a_submessage_that_is_too_long_for_its_length_is_not_written() -> None:
    with pytest.raises(ValueError, match="submessage of 70020 bytes exceeds 65535 bytes"):
        submessage_bytes(Data(*ENDS, 1, bytes(70_000)))


# A second less than the largest number: a float may round up to the next second, which is endless.
@given(st.integers(0, 2**31 - 3), st.integers(0, 999_999_999))
@example(2**31 - 3, 999_999_999)
def test_times_are_as_exact_as_a_float(whole: int, nanoseconds: int) -> None:
    seconds = whole + nanoseconds * 1e-9
    assert abs(seconds_of(*time_halves(seconds)) - seconds) < 1e-6


def test_durations_may_be_endless_and_are_never_negative() -> None:
    assert read_duration(duration_bytes(float("inf")), LITTLE) == float("inf")
    assert duration_bytes(float("inf"), BIG) == b"\x7f\xff\xff\xff\xff\xff\xff\xff"
    assert read_duration(b"\xff\xff\xff\xff\0\0\0\0", LITTLE) == 0
    assert read_duration(duration_bytes(0.1), LITTLE) == pytest.approx(0.1)


ADDRESSES = {
    "udp": (udp_locator(("192.168.0.7", 7411)), ("192.168.0.7", 7411)),
    "shared memory": (Locator(16, 7411, bytes(16)), None),
    "port 0": (udp_locator(("192.168.0.7", 0)), None),
    "port 70000": (udp_locator(("192.168.0.7", 70_000)), None),
    "no host": (udp_locator(("0.0.0.0", 7411)), None),
    "a group": (udp_locator(("239.255.0.1", 7411)), None),
    "broadcast": (udp_locator(("255.255.255.255", 7411)), None),
    "ipv6": (udp_locator(("fd00::2", 7411)), ("fd00::2", 7411)),
    "link-local": (udp_locator(("fe80::1%eth0", 7411)), ("fe80::1", 7411)),
    "no host of ipv6": (udp_locator(("::", 7411)), None),
    "a group of ipv6": (udp_locator(("ff1e::ffff:efff:1", 7411)), None),
    "ipv4 in ipv6": (udp_locator(("::ffff:10.0.0.1", 7411)), None),
    "port 0 of ipv6": (udp_locator(("fd00::2", 0)), None),
}


@pytest.mark.parametrize("name", ADDRESSES)
def test_only_addresses_of_one_host_are_sent_to(name: str) -> None:
    locator, address = ADDRESSES[name]
    assert locator.udp_address == address


def test_a_locator_of_ipv6_has_the_kind_and_the_bytes_of_the_specification() -> None:
    content = locator_bytes(udp_locator(("fd00::2", 7411)))
    assert content == struct.pack("<iI", 2, 7411) + b"\xfd" + bytes(14) + b"\2"
    assert read_locator(content, LITTLE).udp_address == ("fd00::2", 7411)
