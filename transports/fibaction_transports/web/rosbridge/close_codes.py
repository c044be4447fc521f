"""The codes and the reasons with which WebSockets of rosbridge clients are closed."""

from __future__ import annotations

from fibaction.wire.messages import Goodbye, Why
from fibaction_transports.web.http.websocket_frames import NORMAL, TRY_AGAIN

AWAY, PROTOCOL, FORBIDDEN, FAILED = 1001, 1002, 1008, 1011
"""Codes of a close, of RFC 6455."""
LONGEST_REASON = 123
"""Bytes of the reason of a close, at most."""

_CODES = {
    0: AWAY,
    Why.FORBIDDEN: FORBIDDEN,
    Why.LIMIT: TRY_AGAIN,
    Why.PROTOCOL: PROTOCOL,
    Why.CONNECTION_LOST: AWAY,
}


def closing(goodbye: Goodbye | None, found: int) -> tuple[int, str]:
    """Return the code and the reason of a close after a goodbye, or without one.

    `found` is the code of what was wrong with a message; 1000 if nothing was.
    """
    if goodbye is None:
        return found, ""
    reason = goodbye.reason.encode("utf-8", "replace")[:LONGEST_REASON].decode("utf-8", "ignore")
    if found != NORMAL and goodbye.why == Why.PROTOCOL:
        return found, reason
    return _CODES.get(goodbye.why, FAILED), reason
