"""`connect`: the block of a connection, with its thread."""

from __future__ import annotations

from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any, NoReturn, Unpack, overload

import fibaction._api
from fibaction._api import check_is_action
from fibaction.blocking._blocking_client import (
    BlockingClient,
    BlockingConnection,
    client_or_connection,
)
from fibaction.blocking._interrupts import Interrupts
from fibaction.blocking._loop_thread import LoopThread, check_is_no_loop
from fibaction.border.abc import Transport
from fibaction.border.urls import transport_for
from fibaction.client.goal_span import GoalTracer
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.wire.settings import ConnectKeywords
from fibaction.words.errors import TransportError


@overload
def connect(
    where: str | Transport,
    *,
    tracing: GoalTracer | None = None,
    **settings: Unpack[ConnectKeywords],
) -> AbstractContextManager[BlockingConnection]: ...


@overload
def connect(
    where: str | Transport,
    action: Action[GoalT, FeedbackT, ResultT],
    *,
    tracing: GoalTracer | None = None,
    **settings: Unpack[ConnectKeywords],
) -> AbstractContextManager[BlockingClient[GoalT, FeedbackT, ResultT]]: ...


def connect(
    where: str | Transport,
    action: Action[Any, Any, Any] | None = None,
    *,
    tracing: GoalTracer | None = None,
    **settings: Unpack[ConnectKeywords],
) -> AbstractContextManager[Any]:
    """Connect to a URL, or by a transport, for as long as the block lasts.

        with connect("tcp://127.0.0.1:7400", ACTION) as client:
            print(client.call(3))

    With an action, the block gets a `BlockingClient`, without one a `BlockingConnection`. The end
    of the block, also by Ctrl-C, cancels the goals that have not ended, and ends the thread.
    `tracing` and `settings` are those of `fibaction.connect`.

    Raises:
        TransportError: The URL cannot be used; the text says why.
        TypeError: The transport does not have such a setting, `where` is not an address, or
            `action` is not an `Action`.
        ServerNotFound: The server is not found, and the transport can tell at once.
        AuthenticationFailed: The server rejects this client.
        RuntimeError: An event loop runs in this thread, which the block would block.
    """
    transport = transport_for(where, **settings)
    if transport.shares_event_loop:
        raise TransportError(
            "fibaction.blocking cannot use inproc://, whose servers and clients share an event"
            " loop: use an address such as tcp://127.0.0.1:7400"
        )
    check_is_action(action)
    return _OpenBlock(transport, action, tracing)


class _OpenBlock:
    """The block of `connect`."""

    def __init__(
        self,
        transport: Transport,
        action: Action[Any, Any, Any] | None,
        tracing: GoalTracer | None,
    ) -> None:
        self._transport = transport
        self._tracing = tracing
        self._action = action
        self._interrupts = Interrupts(
            enter=_OpenBlock.__enter__.__code__, leave=_OpenBlock.__exit__.__code__
        )
        self._loop = LoopThread(self._interrupts)

    def __enter__(self) -> Any:
        check_is_no_loop()
        try:
            self._interrupts.install()
            with self._interrupts.held():
                self._loop.start()
                connecting = fibaction._api.connect(self._transport, tracing=self._tracing)
                connection = self._loop.enter(connecting)
            return client_or_connection(self._loop, connection, self._action)
        except BaseException:
            self._close()
            raise

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._close()

    def _close(self) -> None:
        self._interrupts.hold()
        try:
            self._loop.stop()
        finally:
            self._interrupts.restore()

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(
            f"connect() has no attribute {name!r}: it is a block, so write"
            f" `with connect(...) as client`, and use the client"
        )
