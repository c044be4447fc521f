"""The bases of every transport over the wire protocol.

A `WireTransport` says how to open and to accept lines; the rest is here and in the modules below:
settings and their checks, URLs with settings after `?`, TLS files, `serve` and `connect`. A
subclass has

- a constructor with its address, which passes `**settings` on,
- `address_of`, the address in a URL as arguments of the constructor,
- `url`, the address as a URL,
- `open_line`, which connects,
- `accept_lines`, which listens, and hands each line to the `WireServer`.

`ConfiguredTransport` is the part with the settings and the URL, for a transport whose lines are
only a part of how it connects.

`docs/howto/write_a_transport.md` writes one; `fibaction_transports.tcp` has two, and `web` one.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import AsyncGenerator, Callable, Generator, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, Unpack
from urllib.parse import SplitResult, parse_qsl, urlsplit

from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.border.urls import check_settings, unknown_setting, without_settings
from fibaction.wire.channel import Line
from fibaction.wire.client.connection import open_connection
from fibaction.wire.settings import WireKeywords, client_settings, server_settings
from fibaction.wire.tls_files import TlsFiles
from fibaction.words.errors import InvalidURL, TransportError

if TYPE_CHECKING:
    from fibaction.wire.wire_server import WireServer

T = TypeVar("T", bound="ConfiguredTransport")
FromText = Callable[[str], Any]
"""Makes the value of a setting from the text in a URL; raises ValueError or KeyError."""

boolean: FromText = {"true": True, "false": False}.__getitem__
"""Reads `true` and `false`."""
_FROM_TEXT: dict[str, FromText] = {
    "token": str,
    "heartbeat": float,
    "reconnect": boolean,
    "reconnect_timeout": float,
    "window": int,
    "orphans": str,
    "grace": float,
}
_TLS_FILES = ("ca", "cert", "key")
_IN_CODE = ("tokens", "authorize", "limits")
"""Settings that a URL cannot have: it ends up in logs, and is only text."""


class ConfiguredTransport(Transport):
    """A transport with the settings of the wire protocol, and with a URL."""

    wire_settings: ClassVar[tuple[str, ...]] = tuple(WireKeywords.__annotations__)
    """Names of the keyword arguments of `WireKeywords` that the subclass has."""
    own_settings: ClassVar[tuple[str, ...]] = ()
    """Names of keyword arguments that the subclass has in addition to those of `WireKeywords`."""
    own_url_settings: ClassVar[Mapping[str, FromText]] = {}
    """Settings that the subclass has after the `?` of a URL, each with its reader."""
    tls_schemes: ClassVar[tuple[str, ...]] = ()
    """Schemes of URLs that have `ca`, `cert` and `key`, which become the argument `tls`."""

    def __init__(self, **settings: Unpack[WireKeywords]) -> None:
        """Take the settings of both halves; each uses its own.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, `orphans` is another word, or a token is not
                valid text.
        """
        known = (*self.wire_settings, *self.own_settings)
        check_settings(type(self).__name__, settings, known)
        self.client_settings = client_settings(settings)
        self.server_settings = server_settings(settings)

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
        parts, query = _split(url)
        files = _TLS_FILES if parts.scheme in cls.tls_schemes else ()
        shared = {name: _FROM_TEXT[name] for name in _FROM_TEXT if name in cls.wire_settings}
        readers = {**shared, **cls.own_url_settings}
        readers.update((name, str) for name in files)
        found = _settings_in(url, query, readers)
        if files:
            found["tls"] = TlsFiles(**{name: found.pop(name, None) for name in files})
        with _translated(url):
            return cls(**cls.address_of(parts), **{**found, **settings})


class WireTransport(ConfiguredTransport):
    """A transport over lines of the wire protocol."""

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
            open_server(served, self.server_settings) as server,
            self.accept_lines(server) as url,
        ):
            yield url

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        """See `Transport.connect`."""
        async with open_connection(self.open_line, self.url, self.client_settings) as connection:
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


def _split(url: str) -> tuple[SplitResult, dict[str, str]]:
    """Split a URL into its parts, and the settings after its `?`, as text."""
    with _translated(url):
        parts = urlsplit(url)
    if "#" in url:
        raise InvalidURL(
            f"{without_settings(url)} has a part behind #, which has no meaning here: write %23 if"
            f" the # belongs to a path or a token"
        )
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    settings = dict(pairs)
    if len(settings) < len(pairs):
        raise InvalidURL(f"{without_settings(url)}: setting given twice")
    return parts, settings


def _settings_in(
    url: str, query: Mapping[str, str], readers: Mapping[str, FromText]
) -> dict[str, Any]:
    """Return the settings in a URL, read from their texts."""
    settings: dict[str, Any] = {}
    for name, text in query.items():
        if name in _IN_CODE:
            raise InvalidURL(
                f"{without_settings(url)} cannot have the setting {name!r}: it is given in code,"
                f" as in serve(..., {name}=...), and not in a URL, which ends up in logs"
            )
        if name not in readers:
            raise InvalidURL(unknown_setting(without_settings(url), name, readers))
        try:
            settings[name] = readers[name](text)
        except (ValueError, KeyError):
            raise InvalidURL(
                f"{without_settings(url)}: the setting {name!r} cannot be {text!r}"
            ) from None
    return settings


@contextmanager
def _translated(url: str) -> Generator[None, None, None]:
    """Turn an invalid value into an invalid URL."""
    try:
        yield
    except ValueError as exc:
        raise InvalidURL(f"{without_settings(url)}: {exc}") from exc
