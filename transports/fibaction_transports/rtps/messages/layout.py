"""The binary layouts of RTPS in both byte orders, and the numbers in them."""

from __future__ import annotations

from struct import Struct
from typing import Literal, TypeAlias

from fibaction_transports.rtps.messages.errors import InvalidPacket

Order: TypeAlias = Literal["<", ">"]
LITTLE: Order = "<"
BIG: Order = ">"

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


U16 = Layout("H")
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
