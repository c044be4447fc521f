"""A fuzz target: the bytes of a hostile peer of WebSocket, before and after the handshake.

    python -m tests.fuzz.websocket -max_total_time=600

The input arrives in pieces, of a size that its own first byte gives. Whatever it is, the framing
returns frames or raises an `ActionError`, and can always say goodbye. Needs atheris, which
`make fuzz` installs.
"""

from __future__ import annotations

from contextlib import suppress

from fibaction.border.http_access import rules
from fibaction.wire.frames import FrameReader
from fibaction.wire.messages import Goodbye, Ping, encode
from fibaction.words.errors import ActionError
from fibaction_transports.web.http.handshake import ClientHandshake, ServerHandshake
from fibaction_transports.web.http.websocket_frames import BinaryMessages, WebSocketFraming
from tests.fuzz.fuzzer import fuzz
from tests.transports.web.upgrade import upgrade

LIMIT = 2**16
PING = encode(Ping())
RULES = rules("127.0.0.1", "/", hosts=(), origins=(), has_tls=False)


def framings() -> list[WebSocketFraming]:
    """A server before and after its handshake, and a client before."""

    def framing(handshake: ClientHandshake | ServerHandshake) -> WebSocketFraming:
        return WebSocketFraming("the fuzzer", BinaryMessages(FrameReader(LIMIT)), handshake)

    known = framing(ServerHandshake(RULES))
    known.feed(upgrade())
    return [known, framing(ServerHandshake(RULES)), framing(ClientHandshake("127.0.0.1", "/"))]


def one_input(data: bytes) -> None:
    size, data = (data[0] or 1) if data else 1, data[1:]
    for framing in framings():
        with suppress(ActionError):
            for start in range(0, len(data), size):
                framing.feed(data[start : start + size])
                framing.encode([PING])
            framing.check()
        framing.encode([encode(Goodbye("it is wrong"))])
        framing.goodbye()
        framing.discard(data)
        framing.close()


def main() -> None:
    fuzz("websocket", one_input, logs=False)


if __name__ == "__main__":
    main()
