"""`connect`: the block of a connection, with its thread; and `call`, for one goal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, NoReturn, Unpack, overload

import fibaction._api
from fibaction._api import CalledAction, ClientConnection, check_is_action
from fibaction.blocking._blocking_client import (
    BlockingClient,
    BlockingConnection,
    client_or_connection,
)
from fibaction.blocking._loop_thread import LoopBlock
from fibaction.border.abc import Transport
from fibaction.border.urls import transport_for
from fibaction.client.goal_span import GoalTracer
from fibaction.client.retry import Retry
from fibaction.types.action import NO_VALUE, Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import TransportError

if TYPE_CHECKING:
    from fibaction_transports.keywords import ConnectKeywords


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
    of the block, or Ctrl-C in it, cancels the goals that have not ended, and ends the thread.
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
    check_is_action(action, "connect")
    return _OpenBlock(transport, action, tracing)


class _OpenBlock(LoopBlock[ClientConnection, Any]):
    """The block of `connect`."""

    def __init__(
        self,
        transport: Transport,
        action: Action[Any, Any, Any] | None,
        tracing: GoalTracer | None,
    ) -> None:
        super().__init__(
            lambda: fibaction._api.connect(transport, tracing=tracing),
            lambda loop, connection: client_or_connection(loop, connection, action),
        )

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(
            f"connect() has no attribute {name!r}: it is a block, so write"
            f" `with connect(...) as client`, and use the client"
        )


@overload
def call(
    where: str | Transport,
    action: CalledAction[None, FeedbackT, ResultT],
    goal: None = None,
    *,
    on_feedback: Callable[[FeedbackT], object] | None = None,
    timeout: float | None = None,
    retry: Retry | None = None,
    labels: Mapping[str, str] | None = None,
    **settings: Unpack[ConnectKeywords],
) -> ResultT: ...


@overload
def call(
    where: str | Transport,
    action: CalledAction[GoalT, FeedbackT, ResultT],
    goal: GoalT,
    *,
    on_feedback: Callable[[FeedbackT], object] | None = None,
    timeout: float | None = None,
    retry: Retry | None = None,
    labels: Mapping[str, str] | None = None,
    **settings: Unpack[ConnectKeywords],
) -> ResultT: ...


def call(
    where: str | Transport,
    action: Any,
    goal: Any = NO_VALUE,
    *,
    on_feedback: Callable[[Any], object] | None = None,
    timeout: float | None = None,
    retry: Retry | None = None,
    labels: Mapping[str, str] | None = None,
    **settings: Unpack[ConnectKeywords],
) -> Any:
    """Connect to a URL, or by a transport, send one goal, and return its result.

        print(call("tcp://127.0.0.1:7400", drive, 3, on_feedback=print))

    Ctrl-C cancels the goal. `on_feedback`, `timeout`, `retry` and `labels` are those of
    `BlockingClient.call`, and `settings` those of `connect`.

    Raises:
        ActionError, TypeError, ValueError, RuntimeError: As for `connect`, and for
            `BlockingClient.call`.
    """
    check_is_action(action, "call")
    with connect(where, action, **settings) as client:
        return client.call(
            goal, on_feedback=on_feedback, timeout=timeout, retry=retry, labels=labels
        )
