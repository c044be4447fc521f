"""`PlainPaths`: the paths that are only read: the files of the pages, those for operators, the list
of servers at `/servers`, and their topics at `/topics`.

The pages are the console, at the root, and that of the REST interface, at `/docs`. They come
without the comments and the indents of their sources; `tests/transports/web/test_assets.py`
bounds what a browser gets. They are resources of this package, read once by a process. Only the
names that were found then are served, so a path that climbs out of the folder is one of the many
that do not exist. They need no token: they are the same for everyone, and know nothing of the
server. A page asks for the token, or finds it in the fragment of its address, and uses it for its
connection.

`/healthz` and `/readyz` say that the server answers; they need no token, as the probes of an
orchestrator have none. While the servers of its actions are away, a bridge is alive and not ready;
`/readyz/arm` is about the actions of the namespace `arm` only.
`/metrics` and `/recording` are there if the server has some, for clients that are let in.
The console shows the recording.

A topic is a stream of MessagePack, each piece after its length in four bytes, the highest first:
the name of the type and the JSON Schema of the messages, then the messages. A client that is slow
gets the newest messages.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Mapping
from contextlib import aclosing
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files
from importlib.resources.abc import Traversable
from os import PathLike
from pathlib import PurePosixPath
from typing import TypeAlias

import anyio
import msgspec

from fibaction.border.abc import Endpoint
from fibaction.border.http_access import Refused
from fibaction.observe.metrics import Metrics
from fibaction.observe.sources import Sources
from fibaction.words.errors import TransportError
from fibaction_transports._http.exchange import Exchange, tag_of
from fibaction_transports._http.problems import RETRY

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The Content-Security-Policy of the page: everything comes from the server of the page."""
MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".ts": "text/plain; charset=utf-8",
}
"""The files that are served, by their suffixes."""
PAGE = "/"
API_PAGE = "/docs"
CLIENT = ("fibaction.js", "fibaction.d.ts", "package.json")
"""The package for JavaScript, as its names are at the server."""


@dataclass(frozen=True)
class Asset:
    """One file."""

    body: bytes
    media_type: str

    @property
    def tag(self) -> str:
        """The `ETag`."""
        return tag_of(self.body)

    @property
    def headers(self) -> tuple[tuple[str, str], ...]:
        """The headers of the answer, in addition to those of every answer."""
        if self.media_type != MEDIA_TYPES[".html"]:
            return ()
        return ("Content-Security-Policy", PAGE_POLICY), ("Referrer-Policy", "no-referrer")


@cache
def all_assets() -> dict[str, Asset]:
    """Return all files, by their paths."""
    web = files("fibaction_transports.web")
    found: dict[str, Traversable] = {
        PAGE: web / "console" / "index.html",
        API_PAGE: web / "api_page" / "index.html",
    }
    found |= {f"/{name}": web / "javascript" / name for name in CLIENT}
    for path, folder in (("/console", "console"), (API_PAGE, "api_page")):
        files_in = (web / folder).iterdir()
        found |= {f"{path}/{one.name}": one for one in files_in if one.name != "index.html"}
    return {
        path: Asset(_body_of(path, one), MEDIA_TYPES[suffix])
        for path, one in found.items()
        if (suffix := PurePosixPath(one.name).suffix) in MEDIA_TYPES
    }


def _body_of(path: str, file: Traversable) -> bytes:
    """Return what is served of a file: all of it if it is of the client for JavaScript."""
    body = file.read_bytes()
    is_of_page = path.endswith((".css", ".js")) and path.removeprefix("/") not in CLIENT
    return as_served(body) if is_of_page else body


_COMMENT = re.compile(rb"^[ \t]*(?:/\*(?:[^*]|\*(?!/))*\*/[ \t]*|//[^\n]*)$", re.MULTILINE)
_INDENT = re.compile(rb"^[ \t]+", re.MULTILINE)


def as_served(source: bytes) -> bytes:
    """Return the source of a script or of a style sheet without its comments and indents, which are
    for its authors.

    Only comments that are whole lines are left out, and the lines stay, empty, so that an error in
    a browser has the line of the file. Nothing is parsed, so a page has no texts of several lines.
    """
    return _INDENT.sub(b"", _COMMENT.sub(lambda found: b"\n" * found[0].count(b"\n"), source))


ALIVE, READY = "/healthz", "/readyz"
METRICS = "/metrics"
RECORDING = "/recording"
RECORDING_TYPE = "application/jsonl"
READ_ONLY = "GET, HEAD, OPTIONS"
"""The methods of these paths, in the form of the header `Allow`."""
PIECE = 2**16
"""Bytes of a recording that are read at once."""
SERVERS, TOPICS = "/servers", "/topics"
TOPIC_TYPE = "application/x-fibaction-topic"
Read: TypeAlias = Callable[[Exchange], Awaitable[None]]
"""Answers a request that reads."""


class PlainPaths:
    """The answers of one server at these paths."""

    def __init__(
        self,
        admit: Callable[[Exchange], object],
        endpoints: Mapping[str, Endpoint],
        *,
        console: bool,
        metrics: Metrics | None,
        recording: str | PathLike[str] | None,
        sources: Sources | None,
    ) -> None:
        """Have the client for JavaScript, and the pages, metrics, a recording and servers where
        they are wanted; `admit` lets in a client, or raises `Refused`.
        """
        self._admit = admit
        self._endpoints = endpoints
        self._metrics = metrics
        self._recording = recording
        self._sources = sources
        self._assets = {
            path: asset
            for path, asset in all_assets().items()
            if console or path.removeprefix("/") in CLIENT
        }

    def has(self, path: str) -> bool:
        """Return whether there is something to read at a path."""
        return self._reader_of(path) is not None

    async def answer(self, exchange: Exchange) -> bool:
        """Answer the request, and return True, if it is about one of the paths.

        Raises:
            Refused: The client lacks a token, or does not only read; or the recording cannot be
                read.
        """
        read = self._reader_of(exchange.path)
        if read is None:
            return False
        if exchange.method not in ("GET", "HEAD"):
            raise Refused(405, f"{exchange.path} is read only", ("Allow", READ_ONLY))
        await read(exchange)
        return True

    def _reader_of(self, path: str) -> Read | None:
        """Return what answers a request that reads a path; None if nothing is there."""
        if path == "" and PAGE in self._assets:
            return _answer_elsewhere
        if path in self._assets:
            return partial(_answer_with, self._assets[path])
        for probe in (ALIVE, READY):
            scope = path.removeprefix(f"{probe}/")
            if path == probe or (scope != path and self._reached(scope)):
                return partial(self._answer_probe, "" if path == probe else scope, probe)
        if path == METRICS and self._metrics is not None:
            return partial(self._answer_metrics, self._metrics)
        if path == RECORDING and self._recording is not None:
            return partial(self._answer_recording, self._recording)
        if path == SERVERS:
            return self._answer_servers
        if path == TOPICS:
            return self._answer_topics
        if path.startswith(f"{TOPICS}/") and self._sources is not None:
            return partial(self._answer_topic, self._sources, path.removeprefix(f"{TOPICS}/"))
        return None

    def _reached(self, scope: str) -> list[bool]:
        """Return whether what has a name can be reached: a server, the actions of a namespace, or
        one action; all servers, or else all actions, if it is empty.
        """
        servers = {} if self._sources is None else self._sources.reached()
        if servers and scope in ("", *servers):
            return list(servers.values()) if scope == "" else [servers[scope]]
        return [
            one.absence is None
            for name, one in self._endpoints.items()
            if not scope or f"{name.strip('/')}/".startswith(f"{scope}/")
        ]

    async def _answer_probe(self, scope: str, probe: str, exchange: Exchange) -> None:
        # Without the names and the reasons, since anyone may ask.
        there, text = self._reached(scope), "ok"
        if not all(there):
            text = f"{there.count(False)} of {len(there)} servers are away"
        status = 200 if all(there) or probe == ALIVE else 503
        retry = () if status == 200 else (RETRY,)
        await exchange.answer(
            status, f"{text}\n".encode(), *retry, kind="text/plain; charset=utf-8"
        )

    async def _answer_metrics(self, metrics: Metrics, exchange: Exchange) -> None:
        self._admit(exchange)
        kind, text = metrics.answer(exchange.headers.get("accept", ""))
        await exchange.answer(200, text, ("Vary", "Accept"), kind=kind)

    async def _answer_recording(self, path: str | PathLike[str], exchange: Exchange) -> None:
        self._admit(exchange)
        try:
            file = await anyio.open_file(path, "rb")
        except OSError as exc:
            raise Refused(404, f"the recording cannot be read: {exc.strerror}") from exc
        async with file:
            exchange.begin_stream(200, RECORDING_TYPE)
            while exchange.method != "HEAD" and (piece := await file.read(PIECE)):
                await exchange.write(piece)
            await exchange.end()

    async def _answer_servers(self, exchange: Exchange) -> None:
        self._admit(exchange)
        infos = [] if self._sources is None else await self._sources.infos()
        await exchange.answer(200, msgspec.json.encode(infos))

    async def _answer_topics(self, exchange: Exchange) -> None:
        self._admit(exchange)
        topics = {} if self._sources is None else self._sources.topics()
        await exchange.answer(200, msgspec.json.encode(topics))

    async def _answer_topic(self, sources: Sources, topic: str, exchange: Exchange) -> None:
        self._admit(exchange)
        refusal = ""
        async with exchange.until_gone(), aclosing(sources.messages(topic)) as pieces:
            try:
                async for piece in pieces:
                    if not exchange.has_begun:
                        exchange.begin_stream(200, TOPIC_TYPE)
                    await exchange.write(len(piece).to_bytes(4, "big") + piece)
            except TransportError as exc:
                refusal = str(exc)
        if exchange.has_begun:
            await exchange.end()
        elif refusal:
            raise Refused(404, refusal)


async def _answer_elsewhere(exchange: Exchange) -> None:
    # The addresses in the page are relative to its own.
    await exchange.answer(308, b"", ("Location", f"{exchange.root}/"))


async def _answer_with(asset: Asset, exchange: Exchange) -> None:
    await exchange.answer_unless_known(asset.body, asset.tag, *asset.headers, kind=asset.media_type)
