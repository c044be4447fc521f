"""Sets of numbers as on the wire: a base, and one bit for each number from there on."""

from __future__ import annotations

import struct

from fibaction_transports.rtps.messages.errors import InvalidPacket
from fibaction_transports.rtps.messages.layout import U32, Order

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
