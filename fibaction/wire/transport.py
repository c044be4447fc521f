"""The bases of every transport over the wire protocol.

A `WireTransport` says how to open and to accept lines; the rest is here and in the modules below:
settings and their checks, URLs with settings after `?`, TLS files, `serve` and `connect`. A
subclass has

- `settings_type`, a struct of its settings, if it has more than those of the wire protocol,
- a constructor with its address, and with settings by keyword,
- `address_of`, the address in a URL as arguments of the constructor,
- `url`, the address as a URL,
- `open_line`, which connects,
- `accept_lines`, which listens, and hands each line to the `WireServer`.

`ConfiguredTransport` is the part with the settings and the URL, for a transport that connects in
another way.

`docs/howto/write_a_transport.md` writes one; `fibaction_transports.tcp` has two, and `web` one.
"""

from __future__ import annotations

import ssl
from abc import abstractmethod
from collections.abc import AsyncGenerator, Generator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar
from urllib.parse import SplitResult

import msgspec

from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.border.settings import TransportSettings, read_settings
from fibaction.border.urls import invalid_url, split_url
from fibaction.wire.channel import Line
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import TransportError

if TYPE_CHECKING:
    from fibaction.wire.wire_server import WireServer

T = TypeVar("T", bound="ConfiguredTransport")


class TlsFiles(msgspec.Struct, frozen=True):
    """Paths of PEM files to make TLS from."""

    ca: str | None = None
    """The authorities to trust; None trusts those of the system. A server with `ca` asks its
    clients for certificates."""
    cert: str | None = None
    """The certificate of this side; a server must have one, and a client may."""
    key: str | None = None
    """The key of the certificate, if it is in another file."""

    def client(self) -> ssl.SSLContext:
        """Make the context of a client, which checks the server's certificate and its host.

        Raises:
            TransportError: The files cannot be used.
        """
        with self._translated():
            context = ssl.create_default_context(cafile=self.ca)
            if self.cert is not None:
                context.load_cert_chain(self.cert, self.key)
            return context

    def server(self) -> ssl.SSLContext:
        """Make the context of a server.

        Raises:
            TransportError: The files cannot be used, or there is no certificate.
        """
        if self.cert is None:
            raise TransportError("a TLS server needs a certificate: give cert=, and key=")
        with self._translated():
            context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=self.ca)
            context.load_cert_chain(self.cert, self.key)
            if self.ca is not None:
                context.verify_mode = ssl.CERT_REQUIRED
            return context

    @contextmanager
    def _translated(self) -> Generator[None, None, None]:
        try:
            yield
        except (OSError, ValueError) as exc:
            files = ", ".join(name for name in (self.ca, self.cert, self.key) if name)
            raise TransportError(f"cannot load TLS files {files}: {exc}") from exc


class ConfiguredTransport(Transport):
    """A transport with a struct of settings, and with a URL that may have them."""

    settings_type: ClassVar[type[TransportSettings]]
    """The settings of the subclass: the keyword arguments of its constructor."""
    tls_schemes: ClassVar[tuple[str, ...]] = ()
    """Schemes of URLs that have `ca`, `cert` and `key`, which become the argument `tls`."""

    # The parts of a subclass

    @classmethod
    @abstractmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the arguments of the constructor for the address in a URL.

        Raises:
            ValueError: The address is invalid; the text says how.
        """

    @property
    @abstractmethod
    def url(self) -> str:
        """The address as a URL, without settings."""

    # The part that all have in common

    @classmethod
    def from_url(cls: type[T], url: str, **settings: Any) -> T:
        """Make the transport from a URL, with settings after `?`; `settings` count for more.

        Raises:
            InvalidURL: The address or a setting in the URL is invalid; the text says which.
            TypeError: There is no such setting.
        """
        parts, query = split_url(url)
        files = TlsFiles.__struct_fields__ if parts.scheme in cls.tls_schemes else ()
        found = read_settings(url, query, cls.settings_type, files)
        if files:
            found["tls"] = TlsFiles(**{name: found.pop(name, None) for name in files})
        with invalid_url(url):
            return cls(**cls.address_of(parts), **{**found, **settings})


class WireTransport(ConfiguredTransport):
    """A transport over lines of the wire protocol."""

    settings_type: ClassVar[type[TransportSettings]] = WireSettings

    def __init__(self, settings: WireSettings) -> None:
        """Take the settings of both halves; each reads its own."""
        self.settings = settings

    @abstractmethod
    async def open_line(self) -> Line:
        """Connect to the server.

        Raises:
            ServerNotFound: The server is not there. It is tried again.
            ConnectionLost: The connection ended at once. It is tried again.
            AuthenticationFailed, InvalidURL: Trying again would not help.
        """

    @abstractmethod
    def accept_lines(self, server: WireServer) -> AbstractAsyncContextManager[str]:
        """Listen while the block lasts, and hand each line to `server.serve` or `server.start`.

        The block is of the URL under which clients find the server.

        Raises:
            TransportError: The address cannot be used.
        """

    @asynccontextmanager
    async def serve(self, *endpoints: Endpoint) -> AsyncGenerator[str, None]:
        """See `Transport.serve`."""
        from fibaction.wire.wire_server import open_server  # here, since clients do not need it

        served = {endpoint.info.name: endpoint for endpoint in endpoints}
        if len(served) < len(endpoints):
            raise TransportError("two of the endpoints serve actions of the same name")
        async with (
            open_server(served, self.settings) as server,
            self.accept_lines(server) as url,
        ):
            yield url

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`."""
        from fibaction.wire.client.connection import open_connection  # servers do not need it

        async with open_connection(self.open_line, self.url, self.settings) as connection:
            yield connection


def host_only(parts: SplitResult) -> str:
    """Return the host of a URL that may have a host and a port, and no user or path.

    Raises:
        ValueError: It has more; the text says what.
    """
    host = without_user(parts)
    if parts.path not in ("", "/"):
        raise _surplus(parts, "path")
    return host


def without_user(parts: SplitResult) -> str:
    """Return the host of a URL that may have a host, a port and a path, and no user.

    Raises:
        ValueError: It has a user.
    """
    if "@" in parts.netloc:
        raise _surplus(parts, "user")
    return parts.hostname or ""


def _surplus(parts: SplitResult, what: str) -> ValueError:
    return ValueError(
        f"it has a {what}, and the URL of a server is like"
        f" {parts.scheme}://host:port, with settings after ? such as token="
    )
