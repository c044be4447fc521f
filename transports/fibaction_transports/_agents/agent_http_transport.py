"""`AgentHttpTransport`: the address, the tokens and the rules of a server of HTTP for agents, and
`DocumentApp`, which takes the documents out of their requests before an SDK reads them.

Requests are let in by the rules of this project's web servers: the `Host` must be this machine or
an address, the `Origin` none or the same, and the token must be right, before anything is read. So
no page of a browser and no other user of the machine can move a robot.

The SDKs make models of all that a request has, and check each of them on the event loop, which
takes seconds for a large goal. So the goals are taken out of the JSON here, in a thread if the
request is large, and what is left has a small bound.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Collection, Mapping, Sequence
from contextlib import asynccontextmanager
from ssl import SSLContext
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, TypeAlias, Unpack
from urllib.parse import SplitResult

import msgspec
from starlette.responses import JSONResponse

from fibaction.border.byte_budgets import ByteBudget
from fibaction.border.event_loop import Background, asyncio_task
from fibaction.border.gateway import Gateway, GatewayTransport
from fibaction.border.http_access import HttpRules, Refused, bearer_in, rules
from fibaction.border.peer_text import excerpt
from fibaction.border.settings import TransportSettings
from fibaction.schema.turns import in_turn, read_json
from fibaction.wire.auth import AccessPolicy, check_token
from fibaction.wire.frames import FrameMemory
from fibaction.wire.settings import DEFAULT_LIMITS, Limits
from fibaction.wire.transport import ConfiguredTransport, TlsFiles, host_only
from fibaction.words.errors import TransportError
from fibaction.words.plain_data import is_map
from fibaction_transports._agents.robot_actions import AgentPolicy
from fibaction_transports._http.application import HttpApplication
from fibaction_transports._http.exchange import App, Exchange, Message, Receive, Scope, Send
from fibaction_transports._http.server import SPEAKS_TLS, HttpServer
from fibaction_transports._socket_lines.stream_transport import check_is_safe, listen_at

if TYPE_CHECKING:
    from fibaction_transports.keywords import AgentHttpKeywords

HOST = "127.0.0.1"
"""The default host: this machine only."""
SEND_BUFFER = 2**16
"""Bytes of a connection that the system may hold: an agent that reads slowly must hold the executor
while what it has not read is kept (`MOST_BYTES`), and little is lost with a connection."""
MAX_PORT = 65535
"""The largest port: a number of 16 bits."""
LARGEST_REST = 2**14
"""Bytes of a request without its documents."""
PARSE_ERROR, INVALID_REQUEST = -32700, -32600
"""Codes of errors of JSON-RPC."""
LENGTH = b"content-length"
Take: TypeAlias = Callable[[dict[str, Any]], Any]
"""Takes the documents out of a request, and leaves small values in their places."""


class AgentTransport(GatewayTransport, ConfiguredTransport):
    """Actions for agents. It only serves."""

    settings_type: ClassVar[type[TransportSettings]] = AgentPolicy
    clients: ClassVar[str]
    """The clients, in the plural, for people."""

    def __init__(self, policy: AgentPolicy) -> None:
        self.policy = policy
        """The rules for what an agent may do."""

    def connect(self) -> NoReturn:
        """Raise an error: the clients are agents.

        Raises:
            TransportError: Always.
        """
        raise TransportError(
            f"the clients of {self.url} are {self.clients}: connect to the servers of its actions"
        )


class AgentGateway(Gateway):
    """The serving end for agents: its URL, and the names that they have for the actions."""

    def __init__(self, url: str, names: Callable[[], list[str]]) -> None:
        self._url = url
        self._names = names

    @property
    def url(self) -> str:
        return self._url

    @property
    def names(self) -> list[str]:
        return self._names()


class AgentApplication(HttpApplication):
    """An application of others, which gets only the requests that are permitted."""

    page_headers: ClassVar[str] = (
        f"{HttpApplication.page_headers}, a2a-version, mcp-protocol-version, mcp-session-id"
    )
    shown_headers: ClassVar[str] = "mcp-session-id"

    def __init__(
        self,
        app: App,
        rules: HttpRules,
        access: AccessPolicy,
        limits: Limits,
        public: Collection[str] = (),
    ) -> None:
        """Guard an application; anyone may read its `public` paths.

        In its scope, `state["client"]` is the client with a valid token, or None.
        """
        self._bodies = ByteBudget(limits.total_memory)
        super().__init__(rules, limits, FrameMemory(self._bodies))
        self._app = app
        self._access = access
        self._public = public

    async def answer(self, exchange: Exchange) -> None:
        token = bearer_in(exchange.headers)
        peer = self._access.admit(exchange.peer, token) if token else None
        is_read = exchange.method in ("GET", "HEAD")
        if peer is None and not (is_read and exchange.path in self._public):
            reason = "the header Authorization must be: Bearer, and the token of the bridge"
            raise Refused(401, reason, ("WWW-Authenticate", "Bearer"))
        await exchange.hand_to(self._app, {"client": peer}, self.limits.frame, self._bodies)


class AgentHttpSettings(AgentPolicy, frozen=True, kw_only=True):
    """The settings of an `AgentHttpTransport`."""

    token: str = ""
    """The token that clients need."""
    tokens: Mapping[str, str] | None = None
    """Several tokens, each with the name of its owner."""
    limits: Limits = DEFAULT_LIMITS
    """The limits: `connections`, `per_address`, `handshake`, `frame`, `total_memory` and `write`
    apply here."""
    tls: TlsFiles | SSLContext | None = None
    """The files to make TLS from, or a context; in a URL the paths `ca`, `cert` and `key`."""
    insecure: bool = False
    """Permit a server without TLS at an address that other machines can reach."""
    hosts: Sequence[str] = ()
    """Names of the server, in addition to its addresses and the names of its machine; `*` permits
    all."""
    origins: Sequence[str] = ()
    """Pages that may use the server, for example `https://robot.example`, besides those that come
    from its own address; `*` permits all."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: As for `AgentPolicy`, or a token is not valid text.
        """
        super().__post_init__()
        check_token(self.token)


class AgentHttpTransport(AgentTransport):
    """A server of HTTP, with or without TLS, for any number of agents. It runs on asyncio only.

    Each client needs a token, so that no other user of the machine can move a robot.
    """

    settings_type: ClassVar[type[TransportSettings]] = AgentHttpSettings
    schemes: ClassVar[tuple[str, str]]
    """The scheme without TLS, and the one with it."""
    default_port: ClassVar[int]

    def __init__(
        self,
        host: str = HOST,
        port: int | None = None,
        **settings: Unpack[AgentHttpKeywords],
    ) -> None:
        """Take an address, and the rules for what an agent may do.

        Args:
            host: The host to listen at.
            port: The port, None for the default one; 0 is a free one, which the URL shows that
                `serve` gives.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: The port or the patience is out of range, a pattern is empty, or a token is
                not valid text.
        """
        made = AgentHttpSettings.of(self, settings)
        super().__init__(made)
        port = self.default_port if port is None else port
        if not 0 <= port <= MAX_PORT:
            raise ValueError(f"port must be between 0 and {MAX_PORT}, not {port}")
        tokens = dict(made.tokens or {})
        if made.token:
            tokens[made.token] = "agent"
        self._access = AccessPolicy(tokens) if tokens else None
        self.host = host
        """The host to listen at."""
        self._port = port
        self._tls = made.tls
        self._insecure = made.insecure
        self.hosts = tuple(made.hosts)
        self._origins = tuple(made.origins)
        self.limits = made.limits
        """The bounds of the server."""

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the host and the port in a URL.

        Raises:
            ValueError: It has a user or a path, or the port is invalid.
        """
        host = host_only(parts) or HOST
        return {"host": host, "port": parts.port}

    @property
    def url(self) -> str:
        scheme = self.schemes[bool(self._tls)]
        return f"{scheme}://{self._netloc(self._port)}"

    def _netloc(self, port: int) -> str:
        return f"[{self.host}]:{port}" if ":" in self.host else f"{self.host}:{port}"

    @asynccontextmanager
    async def serve_app(self, app: App, path: str, *public: str) -> AsyncGenerator[str, None]:
        """Serve an application during the block, which gets the URL of the path in it.

        The `public` paths may be read without a token.

        Raises:
            TransportError: The address cannot be used.
        """
        access = self._checked_access()
        tls, limits = self._tls, self.limits
        admitted = rules(
            self.host, "/", hosts=self.hosts, origins=self._origins, has_tls=tls is not None
        )
        scheme = "https" if tls else "http"
        application = AgentApplication(app, admitted, access, limits, public)
        server = HttpServer(application, "/", scheme)
        listener, port = await listen_at(
            self.host, self._port, self.url, tls, limits, SPEAKS_TLS, SEND_BUFFER
        )
        async with Background() as tasks, server.accepting(listener, tasks, self.url):
            yield f"{scheme}://{self._netloc(port)}{path}"

    def _checked_access(self) -> AccessPolicy:
        """Return the tokens, if the address can be used with them.

        Raises:
            TransportError: It cannot.
        """
        check_is_safe(self.url, self.host, self.schemes[True], self._tls or self._insecure)
        if self._access is None:
            raise TransportError(
                f"{self.url} needs a token, since an agent moves things: append ?token=... to the"
                f" URL, or give tokens={{...}} in code"
            )
        if asyncio_task() is None:
            raise TransportError(
                f"{self.url} needs asyncio: the SDK of its protocol does not run on trio"
            )
        return self._access


class RequestError(Exception):
    """An error for a request that the SDK does not get."""

    def __init__(self, code: int, text: str, request_id: object = None) -> None:
        super().__init__(text)
        self.code = code
        self.request_id = request_id if isinstance(request_id, str | int) else None


class DocumentApp:
    """An application of an SDK, in whose scope `state["documents"]` is what `take` returns."""

    def __init__(self, app: App, take: Take, error_status: int) -> None:
        self._app = app
        self._take = take
        self._error_status = error_status

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["method"] == "POST":
            body: bytes = (await receive())["body"]
            try:
                rest, documents = await in_turn(len(body), lambda _: split(body, self._take))
            except RequestError as exc:
                error = {"code": exc.code, "message": excerpt(str(exc))}
                answer = {"jsonrpc": "2.0", "id": exc.request_id, "error": error}
                await JSONResponse(answer, self._error_status)(scope, receive, send)
                return
            scope["state"]["documents"] = documents
            others = [one for one in scope["headers"] if one[0].lower() != LENGTH]
            scope["headers"] = [*others, (LENGTH, str(len(rest)).encode())]
            receive = _after(rest, receive)
        await self._app(scope, receive, send)


def split(body: bytes, take: Take) -> tuple[bytes, Any]:
    """Return what is left of a request, and its documents; None if it is not an object.

    Raises:
        RequestError: It is not JSON, or has much more than its documents.
    """
    try:
        return _split(read_json(body), take)
    except ValueError as exc:
        raise RequestError(PARSE_ERROR, f"the request is not JSON: {exc}") from exc
    except RecursionError as exc:
        raise RequestError(PARSE_ERROR, "the request nests too deep") from exc


def _split(request: Any, take: Take) -> tuple[bytes, Any]:
    documents = take(request) if is_map(request) else None
    rest = msgspec.json.encode(request)
    if len(rest) > LARGEST_REST:
        request_id = request.get("id") if is_map(request) else None
        text = f"the request has {len(rest)} bytes beside its goal; {LARGEST_REST} are the limit"
        raise RequestError(INVALID_REQUEST, text, request_id)
    return rest, documents


def _after(body: bytes, receive: Receive) -> Receive:
    """Return a function that receives a body, and then what `receive` does."""
    pieces = [{"type": "http.request", "body": body}]

    async def received() -> Message:
        return pieces.pop() if pieces else await receive()

    return received
