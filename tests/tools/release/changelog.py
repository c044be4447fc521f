"""The section of a release in the changelog."""

from __future__ import annotations

import re
from datetime import date

_NEW = "## [Unreleased]\n"
_SECTION = re.compile(r"^## \[(?P<name>.+?)\](?: - (?P<date>.+))?\n", re.MULTILINE)


def with_section(text: str, version: str, day: date) -> str:
    """Return the changelog in which what was new is the section of a version, with its date.

    Made again, on the day of the first try or later, it has the date of the last.

    Raises:
        ValueError: There is nothing new, or the version has a section already.
    """
    if text.count(_NEW) != 1:
        raise ValueError(f"CHANGELOG.md has to have the line {_NEW.strip()!r} once")
    head, _, tail = text.partition(_NEW)
    following = _SECTION.search(tail)
    new, old = (tail[: following.start()], tail[following.start() :]) if following else (tail, "")
    title = f"## [{version}] - {day.isoformat()}\n"
    names = [section["name"] for section in _SECTION.finditer(old)]
    if version not in names:
        if not new.strip():
            raise ValueError(f"CHANGELOG.md has nothing under {_NEW.strip()!r} to release")
        return f"{head}{_NEW}\n{title}{new}{old}"
    if new.strip() or names[0] != version:
        raise ValueError(f"CHANGELOG.md has a section of {version} already: take the next version")
    return head + _NEW + new + _SECTION.sub(title, old, count=1)


def date_of(text: str, version: str) -> str | None:
    """Return the date of a version's section; `None` if it has none."""
    found = (section for section in _SECTION.finditer(text) if section["name"] == version)
    return next((section["date"] for section in found), None)
