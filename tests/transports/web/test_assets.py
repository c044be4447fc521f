"""`fibaction_transports.web.http.plain_paths`: the files, and the headers that they come with."""

from __future__ import annotations

import gzip
import re
from html.parser import HTMLParser
from importlib.resources import files
from importlib.resources.abc import Traversable

import pytest

from fibaction_transports.web.http.plain_paths import (
    CLIENT,
    MEDIA_TYPES,
    PAGE_POLICY,
    all_assets,
    as_served,
)
from tests.transports.web.http_client import fetch, served

pytestmark = pytest.mark.anyio

MOST_BYTES = 100_000
"""What a browser gets of the console, compressed."""
MOST_BYTES_OF_API_PAGE = 9_000


async def test_the_console_is_at_the_root_with_a_strict_policy() -> None:
    async with served() as url:
        answer = await fetch(url, "GET", "/", accept="text/html")
        docs = await fetch(url, "GET", "/docs")
    assert (answer.status, docs.status) == (200, 200)
    assert docs.headers["content-security-policy"] == PAGE_POLICY
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert answer.headers["content-security-policy"] == PAGE_POLICY
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.body.startswith(b"<!doctype html>")


async def test_each_file_arrives_whole_with_its_type_and_a_tag() -> None:
    async with served() as url:
        for path, asset in all_assets().items():
            answer = await fetch(url, "GET", path)
            head = await fetch(url, "HEAD", path)
            again = await fetch(url, "GET", path, if_none_match=f'W/{answer.headers["etag"]}, "x"')
            assert (answer.status, answer.body) == (200, asset.body)
            assert answer.headers["content-type"] == asset.media_type
            assert answer.headers["cache-control"] == "no-cache"
            assert (head.status, head.body) == (200, b"")
            assert head.headers["content-length"] == str(len(asset.body))
            assert (again.status, again.body) == (304, b"")
            assert again.headers["etag"] == answer.headers["etag"] == asset.tag


NO_FILES = (
    "/console/../__init__.py /console/..%2f__init__.py /console//etc/passwd /console/ /console"
    " /console/index.html /fibaction.js/ /_assets.py"
)


async def test_a_path_that_is_not_a_files_is_not_found() -> None:
    async with served() as url:
        for path in NO_FILES.split():
            assert (await fetch(url, "GET", path)).status == 404, path


async def test_files_need_no_token_are_only_read_and_other_hosts_do_not_get_them() -> None:
    async with served(tokens={"secret": "ann"}) as url:
        answer = await fetch(url, "DELETE", "/")
        assert (answer.status, answer.headers["allow"]) == (405, "GET, HEAD, OPTIONS")
        assert (await fetch(url, "GET", "/")).status == 200
        assert (await fetch(url, "GET", "/actions")).status == 401
        assert (await fetch(url, "GET", "/", host="evil.example")).status == 421
        assert (await fetch(url, "GET", "/", origin="http://evil.example")).status == 403


async def test_a_server_may_be_without_the_console() -> None:
    async with served(where="http://127.0.0.1:0?console=false") as url:
        assert (await fetch(url, "GET", "/")).status == 404
        assert (await fetch(url, "GET", "/console/style.css")).status == 404
        assert (await fetch(url, "GET", "/docs")).status == 404
        assert (await fetch(url, "GET", "/fibaction.js")).status == 200


async def test_below_a_path_the_page_is_found_with_and_without_a_slash() -> None:
    async with served(where="http://127.0.0.1:0/robot") as below:
        url = below.removesuffix("/robot")
        there = await fetch(url, "GET", "/robot")
        assert (there.status, there.headers["location"]) == (308, "/robot/")
        assert (await fetch(url, "GET", "/robot/")).body == all_assets()["/"].body
        assert (await fetch(url, "GET", "/robot/fibaction.js")).status == 200


class References(HTMLParser):
    """The addresses in a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name in ("src", "href")]


def test_every_file_that_the_page_and_its_modules_name_is_served_at_a_relative_address() -> None:
    for path, script in (("/", "console/main.js"), ("/docs", "docs/main.js")):
        page = References()
        page.feed(all_assets()[path].body.decode())
        names = {name for name in page.found if not name.startswith("#")}
        assert script in names
        served = names - {"openapi.json", "./"}  # which are not files
        assert {f"/{name}" for name in served} <= set(all_assets())
    for path, asset in all_assets().items():
        if path.startswith(("/console/", "/docs/")) and path.endswith(".js"):
            folder = path.rpartition("/")[0]
            for name in re.findall(r'from "(.*)";', asset.body.decode()):
                wanted = name[2:] if name.startswith("..") else f"{folder}/{name[2:]}"
                assert wanted in all_assets(), f"{path} imports {name}"


@pytest.mark.parametrize(
    ("folder", "path", "page", "most"),
    [
        ("console", "/console/", "/", MOST_BYTES),
        ("api_page", "/docs/", "/docs", MOST_BYTES_OF_API_PAGE),
    ],
)
def test_all_files_of_a_page_are_served_and_small(
    folder: str, path: str, page: str, most: int
) -> None:
    names = {one.name for one in (files("fibaction_transports.web") / folder).iterdir()}
    assert {f".{name.rpartition('.')[2]}" for name in names} <= set(MEDIA_TYPES)
    served = {
        name: len(gzip.compress(asset.body))
        for name, asset in all_assets().items()
        if name == page or name.startswith(path)
    }
    assert len(served) == len(names)
    assert sum(served.values()) <= most


SOURCES = [
    (f"/{path}/{one.name}", one)
    for path, folder in (("console", "console"), ("docs", "api_page"))
    for one in (files("fibaction_transports.web") / folder).iterdir()
    if one.name.endswith((".css", ".js"))
]


def test_comments_that_are_lines_are_left_out_and_the_others_stay() -> None:
    source = b"""/** One. */
/**
 * Two ** lines * / of it.
 */
const url = "http://x"; // at the end of a line
  // a line of it
  /* another */ const star = "/* no comment */";
  /** Before a method. */
  go() {}
"""
    left = b"""



const url = "http://x"; // at the end of a line

/* another */ const star = "/* no comment */";

go() {}
"""
    assert as_served(source) == left


@pytest.mark.parametrize(("path", "file"), SOURCES)
def test_each_line_of_a_page_is_as_in_its_file_or_was_a_comment(
    path: str, file: Traversable
) -> None:
    lines = [line.strip() for line in file.read_text().split("\n")]
    served = all_assets()[path].body.decode().split("\n")
    assert len(served) == len(lines)
    gone = [line for line, now in zip(lines, served, strict=True) if line != now]
    assert all(line.startswith(("/*", "*", "//")) for line in gone)


@pytest.mark.parametrize(("path", "file"), SOURCES)
def test_no_text_of_a_page_has_several_lines(path: str, file: Traversable) -> None:
    lines = file.read_text().split("\n")
    assert [line for line in lines if line.count("`") % 2] == []


def test_the_client_for_javascript_is_served_with_its_comments() -> None:
    for name in CLIENT:
        whole = files("fibaction_transports.web") / "javascript" / name
        assert all_assets()[f"/{name}"].body == whole.read_bytes()
