"""Escaping of text that came from elsewhere, so that it cannot control the terminal.

A server may send any text: for example one that clears the screen, or that looks like a line of
this command.
"""

from __future__ import annotations

import json
from collections.abc import Callable


def clean(text: str) -> str:
    """Return the text on one line, with everything that is not printable escaped.

    Cleaning a clean text again does not change it.
    """
    return _printable(text, _escaped)


def clean_lines(text: str) -> str:
    """Return the text with each of its lines cleaned."""
    return "\n".join(map(clean, text.split("\n")))


def clean_json(text: str) -> str:
    """Return the JSON text with unprintable characters escaped as JSON does it, of the same value.

    JSON itself requires that for the first 32 characters only.
    """
    return _printable(text, lambda character: json.dumps(character)[1:-1])


def _printable(text: str, escaped: Callable[[str], str]) -> str:
    if text.isprintable():  # a fast test, and nearly always true
        return text
    return "".join(c if c.isprintable() else escaped(c) for c in text)


def _escaped(character: str) -> str:
    """Escape as YAML does between double quotes, since values are printed so."""
    number = ord(character)
    if number <= 0xFF:
        return f"\\x{number:02x}"
    return f"\\u{number:04x}" if number <= 0xFFFF else f"\\U{number:08x}"
