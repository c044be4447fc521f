"""The static files that a web server has: its pages, and the client for JavaScript.

The pages are the console, at the root, and that of the REST interface, at `/docs`. They come
without the comments and the indents of their sources; `tests/transports/web/test_assets.py` bounds
what a browser gets.

They are resources of this package, read once by a process. Only the names that were found then are
served, so a path that climbs out of the folder is one of the many that do not exist.

The files need no token: they are the same for everyone, and know nothing of the server. The page
asks for the token, or finds it in the fragment of its address, and uses it for its connection.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import PurePosixPath

from fibaction_transports._http.exchange import tag_of

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
