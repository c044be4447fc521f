"""Text that came from elsewhere cannot control the terminal: what is not printable is escaped.

A server may say anything, also what would clear a screen, or look like a line of this command.
"""

from __future__ import annotations

import logging


def clean(text: str) -> str:
    """The text on one line, with everything that is not printable escaped. What was cleaned stays
    as it is when it is cleaned again.
    """
    return "".join(c if c.isprintable() else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    number = ord(character)
    if number <= 0xFF:
        return f"\\x{number:02x}"
    return f"\\u{number:04x}" if number <= 0xFFFF else f"\\U{number:08x}"


class CleanFormatter(logging.Formatter):
    """Writes each record of fibaction's on one clean line, since it may have a peer's words in it.

    What the user's own code logs stays as it is, and so do tracebacks.
    """

    def formatMessage(self, record: logging.LogRecord) -> str:
        text = super().formatMessage(record)
        return clean(text) if record.name.startswith("fibaction") else text
