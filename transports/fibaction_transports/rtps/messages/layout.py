"""The binary layouts of RTPS in both byte orders: numbers, sets of numbers, and submessages."""

from __future__ import annotations

import struct
from struct import Struct
from typing import Literal, TypeAlias

from fibaction.words.errors import ProtocolError


class InvalidPacket(ProtocolError):
    """A datagram, or a list of parameters in it, that breaks the rules or the limits of RTPS."""


Order: TypeAlias = Literal["<", ">"]
LITTLE: Order = "<"
BIG: Order = ">"

ENCAPSULATION = 4
"""Size of the encapsulation header, with which each payload begins."""
MAX_NUMBER = 2**62
"""The bound of sequence numbers: sums with those that are believed fit into the wire's 64 bits."""

LOW = 2**32 - 1
"""The bits of the lower half of a sequence number."""
_FRACTIONS = 2**32
_ENDLESS_SECONDS = 0x7FFFFFFF


class Layout(dict[Order, Struct]):
    """One binary layout, by the byte order. A `dict` because it is looked up for each field."""

    def __init__(self, form: str) -> None:
        super().__init__({LITTLE: Struct(LITTLE + form), BIG: Struct(BIG + form)})
        self.size = self[LITTLE].size


U32 = Layout("I")
_PAIR = Layout("iI")


def checked_number(high: int, low: int, least: int = 1) -> int:
    """Return the sequence number of two halves.

    Raises:
        InvalidPacket: It is too small or too large.
    """
    number = (high << 32) | low
    if not least <= number < MAX_NUMBER:
        raise invalid_number(number, least)
    return number


def invalid_number(number: int, least: int) -> InvalidPacket:
    """Return the error for a sequence number that is too small or too large."""
    return InvalidPacket(f"sequence number {number} is not between {least} and 2^62")


def halves(number: int) -> tuple[int, int]:
    """Return the two halves of a sequence number."""
    return number >> 32, number & LOW


def time_halves(seconds: float) -> tuple[int, int]:
    """Return a time or duration as seconds and fractions; infinity is the largest of both."""
    if seconds >= _ENDLESS_SECONDS:
        return _ENDLESS_SECONDS, _FRACTIONS - 1
    whole = int(seconds // 1)
    return whole, min(int((seconds - whole) * _FRACTIONS + 0.5), _FRACTIONS - 1)


def seconds_of(whole: int, fraction: int) -> float:
    """Return the seconds of two halves."""
    return whole + fraction / _FRACTIONS


def duration_bytes(seconds: float, order: Order = LITTLE) -> bytes:
    """Return a duration as in a parameter."""
    return _PAIR[order].pack(*time_halves(seconds))


def read_duration(value: bytes, order: Order) -> float:
    """Read a duration of a parameter: infinity for the endless one, and no less than 0."""
    whole, fraction = _PAIR[order].unpack_from(value)
    return float("inf") if whole == _ENDLESS_SECONDS else max(0.0, seconds_of(whole, fraction))


MAX_BITS = 256
"""The most numbers that a set spans."""
_WORD = 32
_BITS = tuple(tuple(at for at in range(8) if byte >> (7 - at) & 1) for byte in range(256))
"""The places of the bits that are set in each byte, from the highest on."""


def bits_bytes(base: int, numbers: tuple[int, ...], order: Order) -> bytes:
    """Return the bits of ascending numbers, which are within 256 from the base on."""
    count = numbers[-1] - base + 1 if numbers else 0
    words = [0] * -(-count // _WORD)
    for number in numbers:
        word, bit = divmod(number - base, _WORD)
        words[word] |= 1 << (_WORD - 1 - bit)
    return struct.pack(f"{order}I{len(words)}I", count, *words)


def read_bits(
    data: memoryview, order: Order, offset: int, base: int
) -> tuple[tuple[int, ...], int]:
    """Read the numbers of a set; return them and the place after them.

    Raises:
        InvalidPacket: The set spans too many numbers.
        struct.error: There are too few bytes.
    """
    (count,) = U32[order].unpack_from(data, offset)
    if count > MAX_BITS:
        raise InvalidPacket(f"set of {count} numbers exceeds {MAX_BITS} numbers")
    words = struct.unpack_from(f"{order}{-(-count // _WORD)}I", data, offset + U32.size)
    end = base + count
    numbers = tuple(
        number
        for first, byte in enumerate(struct.pack(f">{len(words)}I", *words))
        if byte
        for bit in _BITS[byte]
        if (number := base + 8 * first + bit) < end
    )
    return numbers, offset + U32.size * (1 + len(words))


MAGIC = b"RTPS"
VERSION = b"\x02\x03"
PACKET_HEAD = 20
"""Size of the head of a packet: magic, version, vendor and prefix."""
SUBMESSAGE_HEAD = Layout("BBH")

PAD = 0x01
ACK_NACK = 0x06
HEARTBEAT = 0x07
GAP = 0x08
INFO_TS = 0x09
INFO_SRC = 0x0C
INFO_DST = 0x0E
NACK_FRAG = 0x12
DATA = 0x15
DATA_FRAG = 0x16

LITTLE_FLAG = 0x01
FINAL_FLAG = 0x02
ALIVE_FLAG = 0x04
INLINE_FLAG = 0x02
PAYLOAD_FLAG = 0x04
KEY_FLAG = 0x08
FRAGMENT_KEY_FLAG = 0x04
INVALID_FLAG = 0x02

DATA_HEAD = Layout("HH4s4siI")
FRAGMENT_HEAD = Layout("HH4s4siIIHHI")
TO_INLINE = 4
"""Bytes before the place from which the distance to the inline QoS counts."""
HEARTBEAT_BODY = Layout("4s4siIiIi")
ACK_NACK_HEAD = Layout("4s4siI")
NACK_FRAG_HEAD = Layout("4s4siII")
GAP_HEAD = Layout("4s4siIiI")
SOURCE_BODY = Layout("4x2s2s12s")
TIME_BODY = Layout("II")
COUNT = Layout("i")
