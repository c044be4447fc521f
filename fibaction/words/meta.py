"""The meta of a goal: a small text map beside it, for traces."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import TypeAlias

from fibaction.words.errors import InvalidMessage

Meta: TypeAlias = Mapping[str, str]
"""A small text map that goes with a goal: the keys `traceparent`, `tracestate` and `baggage` of the
W3C, and others. It is not part of the goal: that of a retry is ignored."""

MAX_KEYS = 8
"""Keys of a meta, at most."""
MAX_META_BYTES = 4096
"""Bytes of all keys and values of a meta in UTF-8, at most."""

DETACHED = "detached"
"""Key of a goal whose client does not wait for it. Its trace is linked to that of the client."""

PARENT = "parent"
"""Key of a goal that the executor of another one has sent: the ID of that, as hexadecimal digits.
"""

TRACE_KEYS = ("traceparent", "tracestate", "baggage")
"""Keys of the W3C: headers in HTTP, and environment variables in upper case."""

NO_META: Meta = MappingProxyType({})


def size_of(meta: Meta | None) -> int:
    """Return the bytes of a meta; 0 for None.

    Raises:
        InvalidMessage: It has too many keys or bytes, or something in it is not text.
    """
    if not meta:
        return 0
    if len(meta) > MAX_KEYS:
        raise InvalidMessage(f"the goal's meta has {len(meta)} keys, and {MAX_KEYS} are the limit")
    try:
        size = sum(len(key.encode()) + len(value.encode()) for key, value in meta.items())
    except (AttributeError, UnicodeEncodeError):
        raise InvalidMessage("the goal's meta maps text to text, and part of it is not") from None
    if size > MAX_META_BYTES:
        raise InvalidMessage(
            f"the goal's meta has {size} bytes, and {MAX_META_BYTES} are the limit"
        )
    return size


def checked_meta(meta: Meta | None) -> dict[str, str] | None:
    """Return a copy of a meta; None if it is empty.

    Raises:
        InvalidMessage: As for `size_of`.
    """
    return dict(meta) if meta and size_of(meta) else None


def fitting(meta: Meta) -> dict[str, str]:
    """Return the entries that are within the limits, one after the other; the rest is left out."""
    fits: dict[str, str] = {}
    for key, value in meta.items():
        with suppress(InvalidMessage):
            size_of({**fits, key: value})
            fits[key] = value
    return fits


def trace_meta(headers: Mapping[str, str], *, is_detached: bool) -> dict[str, str]:
    """Return the meta for a goal, as far as it fits: the headers of a trace, whose names are in
    lower case, and whether the client does not wait for the goal.
    """
    meta = {DETACHED: "1"} if is_detached else {}
    return fitting(meta | {key: headers[key] for key in TRACE_KEYS if key in headers})
