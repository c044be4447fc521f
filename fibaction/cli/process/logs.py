"""The log of the command on stderr."""

from __future__ import annotations

import logging
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

from fibaction._runtime.log import traceback_text
from fibaction.cli.output.escape import clean
from fibaction.observe.log_records import GoalFilter, JsonFormatter


class CleanFormatter(logging.Formatter):
    """Writes each record of fibaction, and of its extensions, on one clean line, since it may
    contain text of a peer.

    Records of the user's own code are not changed. A traceback keeps its lines and is cleaned,
    whichever code logs it: an executor's exception may contain what a client has sent.
    """

    def formatMessage(self, record: logging.LogRecord) -> str:
        text = super().formatMessage(record)
        return clean(text) if record.name.startswith("fibaction") else text

    def formatException(self, ei: Any) -> str:
        return traceback_text(ei[1])


@contextmanager
def log_with_time(*, as_json: bool = False) -> Generator[None, None, None]:
    """Log to stderr with the time during the block; warnings, and with `log_events` more.

    With `as_json`, each record is a JSON object on one line, with the goal that it belongs to.
    """
    root, files = logging.getLogger(), logging.getLogger("watchfiles")
    before = root.handlers[:], root.level, files.level
    handler = logging.StreamHandler()
    handler.setFormatter(CleanFormatter("%(asctime)s %(message)s"))
    if as_json:
        handler.addFilter(GoalFilter())
        handler.setFormatter(JsonFormatter())
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    files.setLevel(logging.ERROR)  # its warnings repeat what the command says
    try:
        yield
    finally:
        root.handlers[:] = before[0]
        root.setLevel(before[1])
        files.setLevel(before[2])


def log_events() -> None:
    """Log from now on what happens, not only warnings."""
    logging.getLogger().setLevel(logging.INFO)


def log_connection() -> None:
    """Log when the connection is lost and when it is back.

    The user of a command that waits wants to know why nothing happens.
    """
    logging.getLogger("fibaction.wire").setLevel(logging.INFO)
