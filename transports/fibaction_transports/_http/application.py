"""`HttpApplication`: the part of an ASGI application that all servers have in common.

Theory of operation
-------------------

A server calls the application for each request, in a task of its own. It checks the `Host` and the
`Origin` of the request, and that there is room for it; then a subclass answers. What goes wrong is
told as a problem, whatever it is. Pages of `origins` get the headers of CORS.

The application lives as long as the block of `serve`, which is in another task than the requests.
At its end, `close` waits a moment for the streams of events to tell the ends of goals, and cancels
what is left. So nothing runs after the block.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator
from contextlib import contextmanager, suppress
from typing import ClassVar

import anyio
from anyio import CancelScope

from fibaction.border.abc import Notifier
from fibaction.border.http_access import HttpRules, Refused
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.schema.payload import PayloadError
from fibaction.wire.errors import failure_of
from fibaction.wire.frames import FrameMemory
from fibaction.wire.settings import Limits
from fibaction.wire.wire_server import LEAVE_TIMEOUT
from fibaction.words.errors import ActionError, AuthenticationFailed
from fibaction_transports._http.exchange import Exchange, Receive, Scope, Send
from fibaction_transports._http.problems import RETRY, Problem, problem_of

EVERY_METHOD = "GET, HEAD, POST, PUT, DELETE, OPTIONS"

logger = clean_logger("fibaction.web")


class HttpApplication(ABC):
    """Answers the requests of all clients of one server."""

    page_headers: ClassVar[str] = (
        "authorization, content-type, last-event-id, traceparent, tracestate, baggage, prefer,"
        " idempotency-key, if-none-match"
    )
    """The headers of a request that a page of `origins` may set."""
    shown_headers: ClassVar[str] = "location, link, etag, preference-applied"
    """The headers of an answer that such a page may read."""

    def __init__(self, rules: HttpRules, limits: Limits, memory: FrameMemory) -> None:
        """Let in what the rules permit; count large answers in the memory."""
        self.rules = rules
        self.limits = limits
        self._memory = memory
        self._requests: set[CancelScope] = set()
        self._changed = Notifier()
        self.is_closing = False
        """True if no more requests are answered."""

    @abstractmethod
    async def answer(self, exchange: Exchange) -> None:
        """Answer a request that the rules permit.

        Raises:
            Refused, ActionError, PayloadError: It cannot be answered, which its client is told.
        """

    def allowed(self, path: str) -> str:
        """Return the methods at a path, in the form of the header `Allow`; all if nothing is there,
        which is told to the request that follows.
        """
        return EVERY_METHOD

    async def close(self) -> None:
        """Answer no more requests; end those that have begun."""
        self.is_closing = True
        with CancelScope(shield=True):
            with anyio.move_on_after(LEAVE_TIMEOUT):
                while self._requests:
                    await self._changed.wait()
            await self._end(self._requests)

    async def _end(self, scopes: set[CancelScope]) -> None:
        while scopes:
            for scope in scopes:  # more may have come
                scope.cancel()
            await self._changed.wait()

    @contextmanager
    def _counted(self, scopes: set[CancelScope]) -> Generator[None, None, None]:
        """Have the block among those that `_end` cancels."""
        with CancelScope() as life:
            scopes.add(life)
            self._changed.notify()
            try:
                yield
            finally:
                scopes.discard(life)
                self._changed.notify()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request, as ASGI defines it."""
        with self._counted(self._requests):
            exchange = Exchange(scope, receive, send, self.limits.write, self._memory)
            try:
                await self._admit_and_answer(exchange)
            except Refused as exc:
                await self._tell(exchange, problem_of(exc))
            except (ActionError, PayloadError) as exc:
                is_wrong = isinstance(exc, PayloadError | AuthenticationFailed)
                await self._tell(exchange, problem_of(exc), is_wrong=is_wrong)
            except Exception as exc:
                # A bug of an endpoint or of fibaction. It concerns this client only.
                logger.error("%s: its request failed", exchange.peer, exc_info=exc)
                await self._tell(exchange, problem_of(failure_of(exc)), is_wrong=False)

    async def _admit_and_answer(self, exchange: Exchange) -> None:
        self.rules.check_sources(exchange.headers, has_tls=exchange.has_tls)
        if "origin" in exchange.headers:
            exchange.more_headers += [
                ("Access-Control-Allow-Origin", exchange.headers["origin"]),
                ("Access-Control-Expose-Headers", self.shown_headers),
                ("Vary", "Origin"),
            ]
        if self.is_closing:
            raise Refused(503, "the server is closing", RETRY)
        most = self.limits.connections
        if len(self._requests) > most:
            raise Refused(503, f"the server is full: it answers {most} requests", RETRY)
        if exchange.method == "OPTIONS":
            allowed = self.allowed(exchange.path)
            await exchange.answer(
                204,
                b"",
                ("Allow", allowed),
                ("Access-Control-Allow-Methods", allowed),
                ("Access-Control-Allow-Headers", self.page_headers),
                ("Access-Control-Max-Age", "600"),
            )
        else:
            await self.answer(exchange)

    async def _tell(self, exchange: Exchange, problem: Problem, *, is_wrong: bool = True) -> None:
        """Answer with a problem, if there is no answer yet; log it if the request is wrong."""
        if is_wrong:
            detail = excerpt(problem.detail)
            kind = {"kind": problem.status}
            logger.warning("%s: HTTP %d: %s", exchange.peer, problem.status, detail, extra=kind)
        if not exchange.has_begun:
            with suppress(ActionError):  # the client may have gone
                await exchange.tell(problem)
