"""Arrays of numbers of `array` and of numpy, in values and as msgpack.

Large ones make no Python object for each number. Arrays that do not fit here are left to msgspec,
and without numpy, all of them. Numpy is imported by the first large array.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import msgspec

LARGE_ARRAY = 256
"""Numbers from which on it is worth it. With fewer, msgspec is as fast."""

# In msgpack, a number is a byte for its type, and then the number itself, big-endian. Integers from
# -32 to 127 are one byte in all (github.com/msgpack/msgpack/blob/master/spec.md).
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
_INLINE = "i1"
_LEAST_INLINE, _MOST_INLINE = -32, 127
_FLOATS = {4: 0xCA, 8: 0xCB}
_INTEGERS = (0xD0, 0xCC, 0xD1, 0xCD, 0xD2, 0xCE, 0xD3, 0xCF)

_OCTETS = ("B", "u1")
_PACKED = (*"bhHiIlLqQfd", "i1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
"""The types of `array`, and those of numpy in either byte order, that can be packed."""

_ARRAY_16, _ARRAY_32 = 0xDC, 0xDD
_HEAD = 5  # the length of the head of a large array: its type, and the count


@cache
def numpy() -> Any:
    """Return numpy; None if it is not installed.

    It is imported for the first large array, since that takes longer than to import all else here.
    """
    return import_module("numpy") if find_spec("numpy") else None


@cache
def _cells(tag: int) -> Any:
    """Return the type of a number after its tag; None if there is no such tag."""
    kind = _TYPES.get(tag)
    return None if kind is None else numpy().dtype([("tag", "u1"), ("number", kind)])


def pack(numbers: Any) -> msgspec.Raw:
    """Return a numpy array with at least one number as msgpack. Floats keep their width."""
    count: int = len(numbers)
    tag = _tag_for(numbers)
    cells = numpy().dtype(_INLINE) if tag is None else _cells(tag)
    packed = bytearray(_HEAD + count * cells.itemsize)
    packed[:_HEAD] = bytes([_ARRAY_32]) + count.to_bytes(4, "big")
    body = numpy().frombuffer(packed, cells, offset=_HEAD)
    if tag is None:
        body[:] = numbers
    else:
        body["tag"] = tag
        body["number"] = numbers
    return msgspec.Raw(packed)


def _tag_for(numbers: Any) -> int | None:
    """Return the narrowest type for all the numbers; None if each is one byte."""
    if numbers.dtype.kind == "f":
        return _FLOATS[numbers.dtype.itemsize]
    least, most = int(numbers.min()), int(numbers.max())
    if least >= _LEAST_INLINE and most <= _MOST_INLINE:
        return None
    limits = ((tag, numpy().iinfo(_TYPES[tag])) for tag in _INTEGERS)
    return next(tag for tag, one in limits if one.min <= least and most <= one.max)


def plain_array(numbers: Any) -> Any:
    """Return an array of `array` or of numpy, or a number of numpy, as msgspec can encode it.

    One dimension of numbers of 8 bits without a sign is bytes, as in ROS's messages.
    """
    code, dimensions = getattr(numbers, "typecode", ""), getattr(numbers, "ndim", 1)
    kind = code or numbers.dtype.str[1:]
    if dimensions == 1 and kind in _OCTETS:
        view = memoryview(numbers)
        return view if view.c_contiguous else view.tobytes()
    if dimensions == 1 and kind in _PACKED and len(numbers) >= LARGE_ARRAY and numpy() is not None:
        return pack(numpy().asarray(numbers))
    if kind.startswith("f") and kind not in _PACKED:  # of 16 bits, or more than 64
        numbers = numbers.astype("f8")
    return numbers.tolist()


def unpack(packed: msgspec.Raw) -> Any:
    """Return the numbers of a large array in msgpack; None if they are not all of one type, or
    without numpy.
    """
    view = memoryview(packed)
    if view[0] == _ARRAY_16:
        count, body = int.from_bytes(view[1:3], "big"), view[3:]
    elif view[0] == _ARRAY_32:
        count, body = int.from_bytes(view[1:5], "big"), view[5:]
    else:
        return None
    if count < LARGE_ARRAY or numpy() is None:
        return None
    if len(body) == count:
        numbers = numpy().frombuffer(body, _INLINE)
        return numbers if (numbers >= _LEAST_INLINE).all() else None
    cells = _cells(body[0])
    # The length is not enough: several short numbers and a long one may add up to it, too.
    if cells is None or len(body) != count * cells.itemsize:
        return None
    found = numpy().frombuffer(body, cells)
    return found["number"] if (found["tag"] == body[0]).all() else None
