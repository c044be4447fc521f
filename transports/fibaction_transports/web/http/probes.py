"""`Probes`: the paths for operators: `/healthz`, `/readyz`, and `/metrics` where it is wanted."""

from __future__ import annotations

from collections.abc import Callable

from fibaction.border.http_access import Refused
from fibaction.observe.metrics import Metrics
from fibaction_transports._http.exchange import Exchange

ALIVE = ("/healthz", "/readyz")
"""The paths that say that the server answers. They need no token, as the probes of an orchestrator
have none."""


class Probes:
    """The answers to the programs of an operator."""

    def __init__(self, metrics: Metrics | None, admit: Callable[[Exchange], object]) -> None:
        """Answer `/metrics` with these, to a client that `admit` lets in."""
        self._metrics = metrics
        self._admit = admit

    async def answer(self, exchange: Exchange) -> bool:
        """Answer the request, and return True, if it is about one of the paths.

        Raises:
            Refused: The client lacks a token for the metrics, or does not only read.
        """
        is_metrics = exchange.path == "/metrics" and self._metrics is not None
        if not is_metrics and exchange.path not in ALIVE:
            return False
        if exchange.method not in ("GET", "HEAD"):
            raise Refused(405, f"{exchange.path} is read only", ("Allow", "GET, HEAD"))
        if not is_metrics:
            await exchange.answer(200, b"ok\n", kind="text/plain; charset=utf-8")
        else:
            assert self._metrics is not None
            self._admit(exchange)
            kind, text = self._metrics.answer(exchange.headers.get("accept", ""))
            await exchange.answer(200, text, ("Vary", "Accept"), kind=kind)
        return True
