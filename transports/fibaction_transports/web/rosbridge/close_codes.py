"""The codes and the reasons with which WebSockets of rosbridge clients are closed."""

from __future__ import annotations

from fibaction.wire.messages import Goodbye, Why

NORMAL, AWAY, PROTOCOL, UNSUPPORTED, INVALID = 1000, 1001, 1002, 1003, 1007
FORBIDDEN, TOO_BIG, FAILED, TRY_AGAIN = 1008, 1009, 1011, 1013
"""Codes of a close, of RFC 6455 and of its registry."""
LONGEST_REASON = 123
"""Bytes of the reason of a close, at most."""
BINARY = "it sent a binary message: rosbridge has JSON in text messages here"

_CODES = {
    0: AWAY,
    Why.FORBIDDEN: FORBIDDEN,
    Why.LIMIT: TRY_AGAIN,
    Why.PROTOCOL: PROTOCOL,
    Why.CONNECTION_LOST: AWAY,
}


def close_code(goodbye: Goodbye, found: int) -> int:
    """Return the code of a close for the reason of a goodbye.

    `found` is the code of what was wrong with a message; 1000 if nothing was.
    """
    if found != NORMAL and goodbye.why == Why.PROTOCOL:
        return found
    return _CODES.get(goodbye.why, FAILED)


def shortened_bytes(text: str, length: int) -> str:
    """Return as much of a text as fits into so many bytes."""
    return text.encode("utf-8", "replace")[:length].decode("utf-8", "ignore")
