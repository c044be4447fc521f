"""Text of a peer, made safe to log, to show and to keep.

A peer may send any text: for example one that clears the screen, that looks like a line of the log,
or that is as long as a message can be.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice

LENGTH = 200
"""Characters of a peer's text that are logged, or quoted in an error."""
REASON = 1000
"""Characters of a reason that are told and kept. A reason is data, so it is not escaped."""

LONGEST_COMPARED = 100
"""Characters of a name that is compared: the time grows with their square."""
MOST_COMPARED = 1000
"""Names among which a similar one is looked for."""


def excerpt(text: str, length: int = LENGTH) -> str:
    """Return the text on one line, cut to `length` characters, and printable.

    The excerpt of an excerpt is the same text.
    """
    # Escaping makes it longer, so what was escaped is cut again.
    return shortened(printable(shortened(text, length)), length)


def shortened(text: str, length: int = REASON) -> str:
    """Return the text, cut to `length` characters; it may still be several lines."""
    return text if len(text) <= length else text[: length - 1] + "…"


def sendable(text: str) -> str:
    """Return a text to send: cut, and with `?` in place of what cannot be sent as Unicode."""
    return shortened(text).encode("utf-8", "replace").decode()


def printable(text: str) -> str:
    """Return the text on one line, with everything that is not printable escaped.

    Doing it again does not change the text.
    """
    return with_escapes(text, _escaped)


def with_escapes(text: str, escaped: Callable[[str], str]) -> str:
    """Return the text with each character that is not printable replaced by its escape."""
    if text.isprintable():  # a fast test, and nearly always true
        return text
    return "".join(c if c.isprintable() else escaped(c) for c in text)


def _escaped(character: str) -> str:
    """Escape as YAML does between double quotes, since values are printed so."""
    number = ord(character)
    if number <= 0xFF:
        return f"\\x{number:02x}"
    return f"\\u{number:04x}" if number <= 0xFFFF else f"\\U{number:08x}"


def nearest(word: str, known: Iterable[str], longest: int = LONGEST_COMPARED) -> str:
    """Return the known word that is most similar; empty if none is similar.

    Words of more than `longest` characters are not compared.
    """
    from difflib import get_close_matches  # needed for errors only

    if len(word) > longest:
        return ""
    compared = islice((one for one in known if len(one) <= longest), MOST_COMPARED)
    return next(iter(get_close_matches(word, list(compared), 1)), "")
