"""`rosbridge://host:port/path` and `rosbridges://host:port/path`: clients of a rosbridge_server."""

from __future__ import annotations

import math
import ssl
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, ClassVar, NoReturn

from fibaction.border.abc import Connection
from fibaction.border.event_loop import Background
from fibaction.wire.frames import Framing
from fibaction.wire.settings import Limits, WireKeywords
from fibaction.wire.tls_files import TlsFiles
from fibaction.wire.transport import boolean
from fibaction.words.errors import TransportError
from fibaction_transports.web.http.handshake import ClientHandshake
from fibaction_transports.web.rosbridge.client.connection import RosbridgeConnection
from fibaction_transports.web.rosbridge.client.frames import RosbridgeClientFraming
from fibaction_transports.web.rosbridge.client.link_opener import ClientTerms, LinkKeeper
from fibaction_transports.web.websocket_transport import HOST, WebSocketTransport

if TYPE_CHECKING:
    from fibaction.wire.wire_server import WireServer

ROSBRIDGE_PORT = 9090
"""The default port, which is that of rosbridge_server."""
HEARTBEAT = 5.0
"""Seconds between signs of life: a robot that is busy answers late."""
ACCEPTED_AFTER = 1.5
"""Seconds without an answer after which a goal counts as accepted. A server looks for the action
for a second, and then rejects the goal."""
ANSWER_TIMEOUT = 10.0
"""Seconds for the answer to a call of rosapi, for which a server itself waits up to 5 s."""


class RosbridgeTransport(WebSocketTransport):
    """The actions of a robot with rosbridge_server, for clients without ROS.

    It has no servers: an address at `http://` serves rosbridge's clients.
    """

    wire_settings = ("token", "heartbeat", "window", "limits")
    own_settings: ClassVar[tuple[str, ...]] = (
        "tls",
        "accepted_after",
        "answer_timeout",
        "schemas",
        "cancel_on_disconnect",
    )
    own_url_settings: ClassVar = {
        "accepted_after": float,
        "answer_timeout": float,
        "schemas": boolean,
        "cancel_on_disconnect": boolean,
    }
    plain_scheme = "rosbridge"
    tls_schemes: ClassVar[tuple[str, ...]] = ("rosbridges",)
    own_ports: ClassVar[tuple[int, int]] = (ROSBRIDGE_PORT, ROSBRIDGE_PORT)

    def __init__(
        self,
        host: str = HOST,
        port: int | None = None,
        path: str = "/",
        *,
        tls: TlsFiles | ssl.SSLContext | None = None,
        token: str = "",
        heartbeat: float = HEARTBEAT,
        window: int = 256,
        limits: Limits | None = None,
        accepted_after: float = ACCEPTED_AFTER,
        answer_timeout: float = ANSWER_TIMEOUT,
        schemas: bool = True,
        cancel_on_disconnect: bool = False,
    ) -> None:
        """Take an address, and the settings of a client.

        A URL has the text, number and boolean settings after its `?`. With `rosbridges://` it has
        the paths `ca`, `cert` and `key` as well.

        Args:
            host: The host of the server.
            port: The port; 9090 if it is None.
            path: The path of the server; it begins with `/`.
            tls: The files to make TLS from, or a context.
            token: The access token, sent in the header `Authorization`: rosbridge itself asks for
                none, but a proxy in front of it may.
            heartbeat: The seconds between signs of life of the server, which is pinged twice as
                often; after four times that without one the connection is lost.
            window: The feedback messages of a goal that wait to be read; the oldest is dropped for
                one more.
            limits: `frame` is the size of the largest message of the server, in bytes.
            accepted_after: The seconds after which a goal counts as accepted if the server has said
                nothing: rosbridge answers rejections only.
            answer_timeout: The seconds for an answer of rosapi.
            schemas: Ask rosapi for the types of the actions that are listed, so that goals are
                checked before they are sent. False is for older releases of rosapi, which end when
                they are asked for some types.
            cancel_on_disconnect: Ask the server to cancel goals whose connection is lost. Most
                servers do not know it yet.

        Raises:
            ValueError: A number is out of range, the path does not begin with `/`, or the token is
                not valid text.
        """
        shared = WireKeywords(token=token, heartbeat=heartbeat, window=window, limits=limits)
        super().__init__(host, port, path, tls=tls, **shared)
        for name, value in (("accepted_after", accepted_after), ("answer_timeout", answer_timeout)):
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} is at least 0 seconds and finite, not {value}")
        self._terms = ClientTerms(
            heartbeat,
            window,
            self.client_settings.max_frame,
            accepted_after,
            answer_timeout,
            schemas,
            cancel_on_disconnect,
        )

    def _client_framing(self) -> Framing:
        handshake = ClientHandshake(
            self._netloc(self._port), self._path, "", self.client_settings.token
        )
        return RosbridgeClientFraming(self.url, self.client_settings.max_frame, handshake)

    def accept_lines(self, server: WireServer) -> NoReturn:
        """Raise an error: a rosbridge server is elsewhere.

        Raises:
            TransportError: Always.
        """
        raise TransportError(
            f"{self.url} is for clients: serve at http://, where clients of rosbridge connect, too"
        )

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`. The first request opens the connection."""
        async with Background() as tasks:
            keeper = LinkKeeper(self.url, self.open_line, tasks, self._terms)
            try:
                yield RosbridgeConnection(keeper)
            finally:
                keeper.close()
