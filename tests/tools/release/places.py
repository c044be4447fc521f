"""The places that have the version of the project, and how each becomes that of a release."""

from __future__ import annotations

import re
from typing import NamedTuple

_VERSION = re.compile(r"(?P<series>(?:0|[1-9]\d*)\.(?:0|[1-9]\d*))\.(?:0|[1-9]\d*)")


class Place(NamedTuple):
    """A line of a file that has the version."""

    file: str
    line: str
    """Pattern of the line, with the version as its group `version`."""
    is_series: bool = False
    """Whether the line has the first two numbers of the version only."""


_PLACES = [
    Place("pyproject.toml", r'^version = "(?P<version>.+)"$'),
    Place("fibaction/_runtime/__init__.py", r'^RELEASE = "(?P<version>.+)"$'),
    Place("CITATION.cff", r"^version: (?P<version>.+)$"),
    Place("zensical.toml", r'^version = "(?P<version>.+)"$'),
    Place(
        "transports/fibaction_transports/web/javascript/package.json",
        r'^  "version": "(?P<version>.+)",$',
    ),
    Place("docs/cli.md", r"^fibaction (?P<version>\S+) here, version "),
    Place("docs/cli.md", r"^Version of fibaction: (?P<version>\S+)$"),
    Place("README.md", r"^This is version (?P<version>[\d.]+),", is_series=True),
    Place("SECURITY.md", r"^\| (?P<version>[\d.]+), and the newest commit \|", is_series=True),
]


def series_of(version: str) -> str:
    """Return the first two numbers of a version.

    Raises:
        ValueError: It is not three numbers with dots.
    """
    found = _VERSION.fullmatch(version)
    if found is None:
        raise ValueError(f"{version!r} is not a version: give three numbers, such as 0.1.0")
    return found["series"]


def files() -> set[str]:
    """Return the files that have the version."""
    return {place.file for place in _PLACES}


def versions_in(file: str, text: str) -> set[tuple[str, bool]]:
    """Return the versions in a file, each with whether it is its first two numbers only.

    Raises:
        ValueError: A place is not in it, or more than once.
    """
    return {
        (_found(place, text)["version"], place.is_series) for place in _PLACES if place.file == file
    }


def with_version(file: str, text: str, version: str) -> str:
    """Return the text of a file with this version in its places.

    Raises:
        ValueError: A place is not in it, or more than once.
    """
    series = series_of(version)
    for place in _PLACES:
        if place.file == file:
            begin, end = _found(place, text).span("version")
            text = text[:begin] + (series if place.is_series else version) + text[end:]
    return text


def _found(place: Place, text: str) -> re.Match[str]:
    found = [*re.finditer(place.line, text, re.MULTILINE)]
    if len(found) != 1:
        raise ValueError(f"{place.file} has {len(found)} lines {place.line!r}, and has to have one")
    return found[0]
