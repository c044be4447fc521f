"""`rosbridge://host:port/path` and `rosbridges://host:port/path`: clients of a rosbridge_server."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, ClassVar, NoReturn, Unpack

from fibaction.border.abc import Connection
from fibaction.border.event_loop import Background
from fibaction.border.settings import TransportSettings
from fibaction.wire.frames import Framing
from fibaction.words.errors import TransportError
from fibaction_transports.web.http.handshake import ClientHandshake
from fibaction_transports.web.rosbridge.client.endpoint import RosbridgeConnection
from fibaction_transports.web.rosbridge.client.link_opener import LinkKeeper, RosbridgeSettings
from fibaction_transports.web.rosbridge.text_messages import RosbridgeClientFraming
from fibaction_transports.web.websocket_transport import (
    HOST,
    WebSocketLineTransport,
    WebSocketSettings,
)

if TYPE_CHECKING:
    from fibaction.wire.wire_server import WireServer
    from fibaction_transports.keywords import RosbridgeKeywords

ROSBRIDGE_PORT = 9090
"""The default port, which is that of rosbridge_server."""


class RosbridgeTransport(WebSocketLineTransport):
    """The actions of a robot with rosbridge_server, for clients without ROS.

    It has no servers: an address at `http://` serves rosbridge's clients.
    """

    settings_type: ClassVar[type[TransportSettings]] = RosbridgeSettings
    plain_scheme = "rosbridge"
    tls_schemes: ClassVar[tuple[str, ...]] = ("rosbridges",)
    own_ports: ClassVar[tuple[int, int]] = (ROSBRIDGE_PORT, ROSBRIDGE_PORT)

    def __init__(
        self,
        host: str = HOST,
        port: int | None = None,
        path: str = "/",
        **settings: Unpack[RosbridgeKeywords],
    ) -> None:
        """Take an address, and the settings of a client.

        Args:
            host: The host of the server.
            port: The port; 9090 if it is None.
            path: The path of the server; it begins with `/`.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, the path does not begin with `/`, or the token is
                not valid text.
        """
        made = RosbridgeSettings.of(self, settings)
        line = WebSocketSettings(token=made.token, limits=made.limits, tls=made.tls)
        super().__init__(host, port, path, line)
        self._own_settings = made

    def _client_framing(self) -> Framing:
        handshake = ClientHandshake(self._netloc(self._port), self._path, "", self.settings.token)
        return RosbridgeClientFraming(self.url, self.settings.max_frame, handshake)

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
            keeper = LinkKeeper(self.url, self.open_line, tasks, self._own_settings)
            try:
                yield RosbridgeConnection(keeper)
            finally:
                keeper.close()
