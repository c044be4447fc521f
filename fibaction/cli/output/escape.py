"""Escaping of text that came from elsewhere, so that it cannot control the terminal.

A server may send any text: for example one that clears the screen, or that looks like a line of
this command.
"""

from __future__ import annotations

import json

from fibaction._runtime.text import excerpt, printable, with_escapes

__all__ = ["clean", "clean_json", "clean_lines", "excerpt", "printable"]

MAX_LINE = 2000
"""Characters of a line with a sentence. Names are cut sooner, by `excerpt`."""


def clean(text: str) -> str:
    """Return the text on one printable line of at most `MAX_LINE` characters."""
    return excerpt(text, MAX_LINE)


def clean_lines(text: str) -> str:
    """Return the text with each of its lines printable, at full length."""
    return "\n".join(map(printable, text.split("\n")))


def clean_json(text: str) -> str:
    """Return the JSON text with unprintable characters escaped as JSON does it, of the same value.

    JSON itself requires that for the first 32 characters only.
    """
    return with_escapes(text, lambda character: json.dumps(character)[1:-1])
