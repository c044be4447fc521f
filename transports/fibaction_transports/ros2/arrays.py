"""Large arrays of numbers, between msgpack and numpy, with no Python object for each number.

Only a way to be quick: what does not fit here is left to msgspec. Knows nothing of ROS.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import msgspec

numpy: Any = import_module("numpy")

LARGE = 256
"""From how many numbers on it pays: below, msgspec is as quick."""

# Each number in msgpack is one byte that says its type, and then itself, big-endian; integers
# from -32 to 127 are that one byte (github.com/msgpack/msgpack/blob/master/spec.md).
_TYPES = {
    0xCA: ">f4",
    0xCB: ">f8",
    0xCC: "u1",
    0xCD: ">u2",
    0xCE: ">u4",
    0xCF: ">u8",
    0xD0: "i1",
    0xD1: ">i2",
    0xD2: ">i4",
    0xD3: ">i8",
}
_CELLS: dict[int, Any] = {
    tag: numpy.dtype([("tag", "u1"), ("number", kind)]) for tag, kind in _TYPES.items()
}
_INLINE = numpy.dtype("i1")
_LEAST_INLINE, _MOST_INLINE = -32, 127
_FLOATS = {4: 0xCA, 8: 0xCB}
_INTEGERS = [
    (tag, numpy.iinfo(_TYPES[tag])) for tag in (0xD0, 0xCC, 0xD1, 0xCD, 0xD2, 0xCE, 0xD3, 0xCF)
]

_ARRAY_16, _ARRAY_32 = 0xDC, 0xDD
_HEAD = 5  # of the larger kind of array: that byte, and the count


def pack(numbers: Any) -> msgspec.Raw:
    """A numpy array of numbers, at least one, as msgpack; floats in their own width."""
    count: int = len(numbers)
    tag = _tag_for(numbers)
    cells = _INLINE if tag is None else _CELLS[tag]
    packed = bytearray(_HEAD + count * cells.itemsize)
    packed[:_HEAD] = bytes([_ARRAY_32]) + count.to_bytes(4, "big")
    body = numpy.frombuffer(packed, cells, offset=_HEAD)
    if tag is None:
        body[:] = numbers
    else:
        body["tag"] = tag
        body["number"] = numbers
    return msgspec.Raw(packed)


def _tag_for(numbers: Any) -> int | None:
    """The narrowest type that holds all the numbers; None where each is one byte."""
    if numbers.dtype.kind == "f":
        return _FLOATS[numbers.dtype.itemsize]
    least, most = int(numbers.min()), int(numbers.max())
    if least >= _LEAST_INLINE and most <= _MOST_INLINE:
        return None
    return next(tag for tag, limits in _INTEGERS if limits.min <= least and most <= limits.max)


def unpack(packed: msgspec.Raw) -> Any:
    """The numbers of a large array in msgpack, if all of them are of one type; else None."""
    view = memoryview(packed)
    if view[0] == _ARRAY_16:
        count, body = int.from_bytes(view[1:3], "big"), view[3:]
    elif view[0] == _ARRAY_32:
        count, body = int.from_bytes(view[1:5], "big"), view[5:]
    else:
        return None
    if count < LARGE:
        return None
    if len(body) == count:
        numbers = numpy.frombuffer(body, _INLINE)
        return numbers if (numbers >= _LEAST_INLINE).all() else None
    cells = _CELLS.get(body[0])
    # The length alone does not tell: a few short numbers could be made up for by a long one.
    if cells is None or len(body) != count * cells.itemsize:
        return None
    found = numpy.frombuffer(body, cells)
    return found["number"] if (found["tag"] == body[0]).all() else None
