"""`ServedRecording`: the file of a recording at `/recording`, which the console shows."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike

import anyio

from fibaction.border.http_access import Refused
from fibaction_transports._http.exchange import Exchange

PATH = "/recording"
KIND = "application/jsonl"
PIECE = 2**16


class ServedRecording:
    """The answers about one recording, or about none."""

    def __init__(
        self, file: str | PathLike[str] | None, admit: Callable[[Exchange], object]
    ) -> None:
        """Answer with this file, if it is not None, to a client that `admit` lets in."""
        self._file = file
        self._admit = admit

    async def answer(self, exchange: Exchange) -> bool:
        """Answer the request, and return True, if it is about the recording.

        Raises:
            Refused: The client lacks a token, does not only read, or the file cannot be read.
        """
        if self._file is None or exchange.path != PATH:
            return False
        if exchange.method not in ("GET", "HEAD"):
            raise Refused(405, f"{PATH} is read only", ("Allow", "GET, HEAD"))
        self._admit(exchange)
        try:
            file = await anyio.open_file(self._file, "rb")
        except OSError as exc:
            raise Refused(404, f"the recording cannot be read: {exc.strerror}") from exc
        async with file:
            exchange.begin_stream(200, KIND)
            piece = b"" if exchange.method == "HEAD" else await file.read(PIECE)
            while piece:
                await exchange.write(piece)
                piece = await file.read(PIECE)
            await exchange.end()
        return True
