"""Text that came from elsewhere cannot control the terminal: what is not printable is escaped.

A server may say anything, also what would clear a screen, or look like a line of this command.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from typing import Any


def clean(text: str) -> str:
    """The text on one line, with everything that is not printable escaped. What was cleaned stays
    as it is when it is cleaned again.
    """
    return _printable(text, _escaped)


def clean_lines(text: str) -> str:
    """The text on its lines, each of them cleaned."""
    return "\n".join(map(clean, text.split("\n")))


def clean_json(text: str) -> str:
    """The JSON text, with what is not printable in its strings escaped as JSON does it, so that it
    says the same. JSON itself only wants that of the first 32 characters.
    """
    return _printable(text, lambda character: json.dumps(character)[1:-1])


def _printable(text: str, escaped: Callable[[str], str]) -> str:
    if text.isprintable():  # which is quickly said, and nearly always so
        return text
    return "".join(c if c.isprintable() else escaped(c) for c in text)


def _escaped(character: str) -> str:
    """As in YAML between double quotes, since values are printed so."""
    number = ord(character)
    if number <= 0xFF:
        return f"\\x{number:02x}"
    return f"\\u{number:04x}" if number <= 0xFFFF else f"\\U{number:08x}"


class CleanFormatter(logging.Formatter):
    """Writes each record of fibaction's on one clean line, since it may have a peer's words in it.

    What the user's own code logs stays as it is. A traceback keeps its lines, whoever logs it, and
    is cleaned: what an executor raises may be about what a client has sent.
    """

    def formatMessage(self, record: logging.LogRecord) -> str:
        text = super().formatMessage(record)
        return clean(text) if record.name.startswith("fibaction") else text

    def formatException(self, ei: Any) -> str:
        return clean_lines(super().formatException(ei))
