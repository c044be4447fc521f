"""The streams of MCP over stdin and stdout, whose reader can be canceled.

The reader of the SDK waits for a line in a thread, and cannot be canceled meanwhile: a signal would
end the program only when the client sends something.
"""

from __future__ import annotations

import json
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any, cast

from anyio import AsyncFile, to_thread
from mcp.server.stdio import stdio_server

HALF_CHARACTER = "\\ud"
"""The begin of an escape in JSON text that may be half of a character."""


class _Lines:
    """The lines of stdin. After a cancellation, a thread may still wait for one."""

    def __init__(self) -> None:
        self._read = sys.stdin.buffer.readline

    def __aiter__(self) -> _Lines:
        return self

    async def __anext__(self) -> str:
        line: bytes = await to_thread.run_sync(self._read, abandon_on_cancel=True)
        if not line:
            raise StopAsyncIteration
        text = line.decode(errors="replace")
        return _with_whole_characters(text) if HALF_CHARACTER in text.lower() else text


def _with_whole_characters(line: str) -> str:
    """Return a message without escapes of lone surrogates: the SDK would drop it, and the client
    would wait for its answer.
    """
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return line
    return json.dumps(message, ensure_ascii=False).encode(errors="replace").decode()


@asynccontextmanager
async def stdio_streams() -> AsyncGenerator[tuple[Any, Any], None]:
    """Give the streams of messages and of answers.

    Meanwhile, what else is written to stdout goes to stderr, so that it does not disturb.

    Raises:
        RuntimeError: Something else serves over stdout already.
    """
    async with stdio_server(stdin=cast("AsyncFile[str]", _Lines())) as streams:
        yield streams
