"""Check of the links of a built site: broken links, and files loaded from other sites."""

from __future__ import annotations

import os
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class _Page(HTMLParser):
    """The anchors of a page, and the links and sources in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[tuple[int, str, str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if value is None:
                continue
            if name == "id" or (tag == "a" and name == "name"):
                self.anchors.add(value)
            elif name in ("href", "src"):
                self.links.append((self.getpos()[0], tag, value))


def problems(site: Path) -> list[str]:
    """Return the faults in the links of the HTML pages of a site, a line for each."""
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    return [
        f"{path.relative_to(site)}:{line}: {link!r} {wrong}"
        for path, page in pages.items()
        for line, tag, link in page.links
        if (wrong := _wrong(site, pages, path, tag, link))
    ]


def _wrong(site: Path, pages: dict[Path, _Page], path: Path, tag: str, link: str) -> str:
    url = urlsplit(link)
    if url.scheme or url.netloc:
        loaded = tag != "a" and url.scheme != "data"
        return "is loaded from elsewhere" if loaded else ""
    target = path
    if url.path:
        base = site if url.path.startswith("/") else path.parent
        target = Path(os.path.normpath(base / unquote(url.path).lstrip("/")))
        if target.is_dir():
            target /= "index.html"
    if not target.is_file():
        return "leads to no file"
    anchor = unquote(url.fragment)
    if anchor and target in pages and anchor not in pages[target].anchors:
        return f"leads to no place in {target.relative_to(site)}"
    return ""
