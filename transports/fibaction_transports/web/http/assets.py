"""`Assets`: the static files that a web server has: its pages, and the client for JavaScript.

The pages are the console, at the root, and that of the REST interface, at `/docs`. They come
without the comments and the indents of their sources; `tests/transports/web/test_assets.py` bounds
what a browser gets.

They are resources of this package, read once by a process. Only the names that were found then are
served, so a path that climbs out of the folder is one of the many that do not exist.

The files need no token: they are the same for everyone, and know nothing of the server. The page
asks for the token, or finds it in the fragment of its address, and uses it for its connection.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import PurePosixPath

from fibaction.border.http_access import Refused
from fibaction.border.peer_text import excerpt
from fibaction_transports._http.exchange import Exchange
from fibaction_transports.web.http.page_source import COMMENTED, as_served

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
ASSET_METHODS = ("GET", "HEAD")
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
        """The `ETag`: another one for each content."""
        return f'"{blake2b(self.body, digest_size=12).hexdigest()}"'

    @property
    def headers(self) -> tuple[tuple[str, str], ...]:
        """The headers of the answer, in addition to those of every answer."""
        headers: tuple[tuple[str, str], ...] = (
            ("ETag", self.tag),
            ("Cache-Control", "no-cache"),  # a browser asks whether its copy is up to date
        )
        if self.media_type == MEDIA_TYPES[".html"]:
            headers += (
                ("Content-Security-Policy", PAGE_POLICY),
                ("Referrer-Policy", "no-referrer"),
            )
        return headers


class Assets:
    """The files of one server, by their paths."""

    def __init__(self, *, console: bool) -> None:
        """Take the client for JavaScript, and the pages if they are wanted."""
        self._by_path = {
            path: asset
            for path, asset in all_assets().items()
            if console or path.removeprefix("/") in CLIENT
        }

    @property
    def has_page(self) -> bool:
        """True if the console is served."""
        return PAGE in self._by_path

    def find(self, exchange: Exchange) -> Asset | None:
        """Return the file that a request is about; None if it is not about a file.

        Raises:
            Refused: A file is only read.
        """
        asset = self._by_path.get(exchange.path)
        if asset is not None and exchange.method not in ASSET_METHODS:
            allowed = ", ".join(ASSET_METHODS)
            raise Refused(
                405,
                f"{exchange.path} has the methods {allowed}, and not {excerpt(exchange.method)}",
                ("Allow", allowed),
            )
        return asset


async def answer_with(asset: Asset, exchange: Exchange) -> None:
    """Answer a request with a file, or say that the client's copy of it is up to date."""
    known = exchange.headers.get("if-none-match", "").replace("W/", "")
    if asset.tag in (tag.strip() for tag in known.split(",")):
        await exchange.answer(304, b"", *asset.headers)
    else:
        await exchange.answer(200, asset.body, *asset.headers, kind=asset.media_type)


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
    is_of_page = path.endswith(COMMENTED) and path.removeprefix("/") not in CLIENT
    return as_served(body) if is_of_page else body
