"""`WebTransport`: an ASGI application that is also a transport."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, Unpack
from urllib.parse import SplitResult

from fibaction.border.http_access import rules
from fibaction.border.settings import TransportSettings
from fibaction.observe.metrics import Metrics
from fibaction.wire.channel import Line
from fibaction.wire.settings import WireSettings
from fibaction.wire.transport import WireTransport
from fibaction.wire.wire_server import WireServer
from fibaction.words.errors import TransportError
from fibaction_transports._http.exchange import Receive, Scope, Send
from fibaction_transports.web.http.application import WebApplication, refuse
from fibaction_transports.web.rosbridge.server.channel import RosbridgeGuest

if TYPE_CHECKING:
    from fibaction_transports.keywords import WebKeywords

URL = "asgi://"
"""The URL of an application, whose address only the program knows that it is part of."""

ONLY_SERVES = (
    "a WebTransport only serves: connect to the address of its program, as in"
    " ws://127.0.0.1:8000/robot/"
)


class WebSettings(WireSettings, frozen=True, kw_only=True):
    """The settings of a `WebTransport`."""

    for_clients: ClassVar[bool] = False

    hosts: Sequence[str] = ()
    """Names of the server, in addition to all addresses and the names of its machine; `*` permits
    all. They are not needed with TLS."""
    origins: Sequence[str] = ()
    """Pages that may use the server, for example `https://robot.example`, besides those that come
    from its own address; `*` permits all."""
    console: bool = True
    """Serve the console as a page."""
    metrics: Metrics | None = None
    """Serve these at `/metrics`; they are a watcher, too, for `serve`."""


class WebTransport(WireTransport):
    """An ASGI application: REST with events, and over WebSocket the wire protocol and rosbridge.

        web = WebTransport(tokens=TOKENS)

        @asynccontextmanager
        async def lifespan(app):
            async with serve(server, web):
                yield

        app = FastAPI(lifespan=lifespan)
        app.mount("/robot", web)

    It answers requests while `serve` lasts, and with the status 503 otherwise.
    """

    settings_type: ClassVar[type[TransportSettings]] = WebSettings

    def __init__(self, **settings: Unpack[WebKeywords]) -> None:
        """Take the settings of a server: see the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, `orphans` is another word, or a token is not
                valid text.
        """
        made = WebSettings.of(self, settings)
        super().__init__(made)
        self._rules = rules(
            "localhost", "/", hosts=tuple(made.hosts), origins=tuple(made.origins), has_tls=False
        )
        self._console = made.console
        self._metrics = made.metrics
        self._application: WebApplication | None = None

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Reject every URL: an application has none."""
        raise ValueError("an application has no URL: make a WebTransport(), or use http://")

    @property
    def url(self) -> str:
        """A name in place of the address, which the application does not know."""
        return URL

    async def open_line(self) -> Line:
        raise TransportError(ONLY_SERVES)

    def connect(self) -> NoReturn:
        raise TransportError(ONLY_SERVES)

    @asynccontextmanager
    async def accept_lines(self, server: WireServer) -> AsyncGenerator[str, None]:
        if self._application is not None:
            raise TransportError("this WebTransport serves already: make another one")
        application = self._application = WebApplication(
            server, self._rules, RosbridgeGuest(), console=self._console, metrics=self._metrics
        )
        try:
            yield URL
        finally:
            await application.close()
            self._application = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request, as ASGI defines it."""
        if scope["type"] == "lifespan":
            raise TransportError("a WebTransport has no lifespan: serve() it in that of a program")
        if self._application is None:
            await refuse(scope, receive, send)
        else:
            await self._application(scope, receive, send)
