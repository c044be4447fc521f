"""Escaping of text that came from elsewhere, so that it cannot control the terminal.

A server may send any text: for example one that clears the screen, or that looks like a line of
this command.
"""

from __future__ import annotations

import json

from fibaction._text import printable as clean
from fibaction._text import with_escapes

__all__ = ["clean", "clean_json", "clean_lines"]


def clean_lines(text: str) -> str:
    """Return the text with each of its lines cleaned."""
    return "\n".join(map(clean, text.split("\n")))


def clean_json(text: str) -> str:
    """Return the JSON text with unprintable characters escaped as JSON does it, of the same value.

    JSON itself requires that for the first 32 characters only.
    """
    return with_escapes(text, lambda character: json.dumps(character)[1:-1])
