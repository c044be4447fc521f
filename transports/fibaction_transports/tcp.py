"""`tcp://host:port`, `tls://host:port` and `unix:///path`: actions across processes."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack
from urllib.parse import SplitResult, unquote

import anyio
from anyio.abc import Listener

from fibaction.border.event_loop import asyncio_task
from fibaction.wire.channel import Line, StreamChannel
from fibaction.wire.frames import FrameReader
from fibaction.wire.settings import WireSettings
from fibaction.wire.transport import TlsFiles, host_only
from fibaction.words.errors import TransportError
from fibaction_transports._socket_lines import on_asyncio
from fibaction_transports._socket_lines.stream_transport import (
    HostSettings,
    HostTransport,
    StreamTransport,
    port_in,
)

if TYPE_CHECKING:
    from fibaction_transports.keywords import HostKeywords, WireKeywords


__all__ = ["TcpTransport", "TlsFiles", "UnixTransport"]

HOST, PORT = "127.0.0.1", 7400
"""The default address: on this machine only."""


class TcpTransport(HostTransport):
    """TCP, with or without TLS."""

    tls_schemes = ("tls",)

    def __init__(
        self,
        host: str = HOST,
        port: int = PORT,
        **settings: Unpack[HostKeywords],
    ) -> None:
        """Take an address and settings.

        Args:
            host: The host to connect to, or to listen at.
            port: The port; a server at port 0 gets a free one, which its URL shows.
            settings: See the table of settings.

        Raises:
            TypeError: There is no such setting.
            ValueError: A number is out of range, `orphans` is another word, or a token is not
                valid text.
        """
        super().__init__(host, port, HostSettings.of(self, settings))

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the host and the port in a URL."""
        host = host_only(parts) or HOST
        return {"host": host, "port": port_in(parts, PORT)}


class UnixTransport(StreamTransport):
    """A Unix domain socket: processes of one machine, with the permissions of a file."""

    def __init__(self, path: str | os.PathLike[str], **settings: Unpack[WireKeywords]) -> None:
        """Take the path of the socket, and settings: see the table of settings.

        Raises:
            TypeError, ValueError: As for `TcpTransport`.
            TransportError: This system has no such sockets for Python, as Windows.
        """
        if not hasattr(socket, "AF_UNIX"):
            raise TransportError(
                f"unix://{path} needs a system with Unix domain sockets, and Python has none on"
                f" this one: use tcp://127.0.0.1:7400"
            )
        super().__init__(WireSettings.of(self, settings))
        self._path = Path(path)
        self._socket: tuple[int, int] | None = None  # the file that this server listens at

    @classmethod
    def address_of(cls, parts: SplitResult) -> dict[str, Any]:
        """Return the path in a URL."""
        path = unquote(parts.path)
        if parts.netloc or len(path) < 2 or "\0" in path:
            raise ValueError("the URL of a socket is like unix:///run/robot.sock")
        return {"path": path}

    @property
    def url(self) -> str:
        """The address as a URL, without settings."""
        return f"unix://{self._path}"

    async def _connect(self) -> Line:
        reader = FrameReader(self.settings.max_frame)
        if asyncio_task() is not None:
            return await on_asyncio.dial_unix(self._path, reader, self.url)
        return StreamChannel(await anyio.connect_unix(self._path), self.url, reader)

    async def _listen(self) -> tuple[Listener[Any], str]:
        if await self._is_served():
            raise TransportError(f"address already in use: {self.url}")
        try:
            listener = await anyio.create_unix_listener(self._path, mode=0o600)
        except (OSError, ValueError) as exc:  # for example a file that is not a socket
            text = getattr(exc, "strerror", None) or exc
            raise TransportError(f"cannot listen at {self.url}: {text}") from exc
        self._socket = _identity(self._path)
        return listener, self.url

    async def _is_served(self) -> bool:
        """Return whether a server listens at the path; a file of one that is gone is replaced."""
        try:
            if not stat.S_ISSOCK(self._path.stat().st_mode):
                return False
            await (await anyio.connect_unix(self._path)).aclose()
        except OSError:
            return False
        return True

    def _unlisten(self) -> None:
        # The file may have been removed, and be another server's by now. As long as this server
        # listens, no other file is given the number of its own.
        if _identity(self._path) == self._socket:
            self._path.unlink(missing_ok=True)


def _identity(path: Path) -> tuple[int, int] | None:
    """Return the identity of a file, independent of its name; None if there is no file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
