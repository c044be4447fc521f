"""Requests for WebSocket, right and wrong."""

from __future__ import annotations

from collections.abc import Mapping

RIGHT = {
    b"Host": b"127.0.0.1",
    b"Upgrade": b"websocket",
    b"Connection": b"Upgrade",
    b"Sec-WebSocket-Key": b"dGhlIHNhbXBsZSBub25jZQ==",
    b"Sec-WebSocket-Version": b"13",
    b"Sec-WebSocket-Protocol": b"fibaction.1",
}


def upgrade(
    changes: Mapping[bytes, bytes | None] = RIGHT,
    line: bytes = b"GET / HTTP/1.1",
    body: bytes = b"",
) -> bytes:
    """Return a request; a header that is None is left out."""
    headers = {**RIGHT, **changes}
    lines = [b"%s: %s" % (name, value) for name, value in headers.items() if value is not None]
    return b"\r\n".join([line, *lines, b"", b""]) + body


UPGRADE: dict[str, tuple[bytes, int, str]] = {
    "another method": (upgrade(line=b"POST / HTTP/1.1"), 405, "GET requests"),
    "a body": (upgrade({b"Content-Length": b"2"}, body=b"{}"), 400, "has no body"),
    "another path": (upgrade(line=b"GET /../x HTTP/1.1"), 404, "there is nothing at"),
    "a plain request": (upgrade({b"Upgrade": None}), 426, "this is a fibaction server"),
    "an old HTTP": (upgrade(line=b"GET / HTTP/1.0"), 426, "this is a fibaction server"),
    "a request that closes": (upgrade({b"Connection": b"close"}), 426, "a fibaction server"),
    "an old version": (upgrade({b"Sec-WebSocket-Version": b"8"}), 426, "WebSocket is 13"),
    "no key": (upgrade({b"Sec-WebSocket-Key": None}), 400, "no Sec-WebSocket-Key"),
    "no subprotocol": (upgrade({b"Sec-WebSocket-Protocol": None}), 400, "must offer"),
    "another subprotocol": (
        upgrade({b"Sec-WebSocket-Protocol": b"fibaction.2"}),
        400,
        "must offer",
    ),
    "no host": (upgrade({b"Host": None}), 400, "Host"),
    "another host": (upgrade({b"Host": b"evil.example"}), 421, "not known as 'evil.example'"),
    "a foreign page": (upgrade({b"Origin": b"http://evil.example"}), 403, "may not use the server"),
    "a line that is too long": (b"GET /" + b"a" * 20_000, 431, ""),
    "headers that are too long": (upgrade({b"Cookie": b"a" * 20_000})[:17_000], 431, ""),
    "another protocol": (b"\0\0\0\2\x91\0\r\n\r\n", 400, "illegal"),
    "TLS": (b"\x16\x03\x01\x02\0\x01\0\r\n\r\n", 400, ""),
}
"""Requests that are rejected, each with the status and a part of the reason."""
