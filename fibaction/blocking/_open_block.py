"""The blocks of `connect` and `serve`, each with its thread; and `call`, for one goal."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, suppress
from threading import Event
from typing import TYPE_CHECKING, Any, Concatenate, NoReturn, TypeVar, Unpack, overload

import fibaction._api
from fibaction._api import ClientConnection, Served, check_is_action, goal_and_connection
from fibaction.blocking._blocking_client import (
    BlockingClient,
    BlockingConnection,
    client_or_connection,
)
from fibaction.blocking._loop_thread import LoopBlock
from fibaction.border.abc import Transport
from fibaction.border.urls import transport_for
from fibaction.border.watchers import GoalTracer, Watcher
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.types.arguments import (
    Arguments,
    CalledAction,
    P,
    TakesArguments,
    TakesNone,
    TakesOne,
)
from fibaction.words.errors import TransportError

if TYPE_CHECKING:
    from fibaction.client.options import BlockingCallOptions
    from fibaction.server.functions.function_action import FunctionAction
    from fibaction_transports.keywords import ConnectKeywords, ServeKeywords

    class BlockingOneCallOptions(BlockingCallOptions[FeedbackT], ConnectKeywords, total=False):
        """The options of `call`, and the settings of `connect`."""


OneT = TypeVar("OneT")


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
    action: FunctionAction[P, FeedbackT, ResultT, Any],
    *,
    tracing: GoalTracer | None = None,
    **settings: Unpack[ConnectKeywords],
) -> AbstractContextManager[BlockingClient[Arguments[P], FeedbackT, ResultT]]: ...


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


# For type checkers: as for `fibaction.call`.


@overload
def call(
    where: str | Transport,
    action: TakesArguments[P, FeedbackT, ResultT],
    /,
    *args: P.args,
    **kwargs: P.kwargs,
) -> ResultT: ...


@overload
def call(
    where: str | Transport,
    action: TakesNone[FeedbackT, ResultT],
    /,
    **options: Unpack[BlockingOneCallOptions[FeedbackT]],
) -> ResultT: ...


@overload
def call(
    where: str | Transport,
    action: TakesOne[OneT, FeedbackT, ResultT],
    first: OneT,
    /,
    **options: Unpack[BlockingOneCallOptions[FeedbackT]],
) -> ResultT: ...


@overload
def call(
    where: str | Transport,
    action: FunctionAction[Concatenate[OneT, P], FeedbackT, ResultT, Any],
    first: OneT,
    /,
    **options: Unpack[BlockingOneCallOptions[FeedbackT]],
) -> ResultT: ...


@overload
def call(
    where: str | Transport,
    action: CalledAction[None, FeedbackT, ResultT],
    goal: None = None,
    /,
    **options: Unpack[BlockingOneCallOptions[FeedbackT]],
) -> ResultT: ...


@overload
def call(
    where: str | Transport,
    action: CalledAction[GoalT, FeedbackT, ResultT],
    goal: GoalT,
    /,
    **options: Unpack[BlockingOneCallOptions[FeedbackT]],
) -> ResultT: ...


def call(where: str | Transport, action: Any, /, *args: Any, **given: Any) -> Any:
    """Connect to a URL, or by a transport, send one goal, and return its result.

        print(call("tcp://127.0.0.1:7400", drive, 3, on_feedback=print))

    Ctrl-C cancels the goal. The goal and the options are given as to `BlockingClient.call`, and
    other names are settings of `connect`.

    Raises:
        ActionError, TypeError, ValueError, RuntimeError: As for `connect`, and for
            `BlockingClient.call`.
    """
    check_is_action(action, "call")
    goal, opening = goal_and_connection(connect, where, action, args, given)
    with opening as client:
        return client.call(goal, **given)


class BlockingServing(LoopBlock[tuple[str, ...], tuple[str, ...]]):
    """Servers at their addresses, to be run by `with`, or until Ctrl-C: see `serve`."""

    def forever(self) -> None:
        """Serve until Ctrl-C, and then stop the servers: their goals end, and clients are told.

        In another thread than the main one, this does not end.

        Raises:
            ActionError, TypeError, RuntimeError: As for the block of `serve`.
        """
        with suppress(KeyboardInterrupt), self:
            Event().wait()


def serve(
    endpoints: Served | Iterable[Served],
    *where: str | Transport,
    watchers: Iterable[Watcher] = (),
    **settings: Unpack[ServeKeywords],
) -> BlockingServing:
    """Serve functions and other endpoints for as long as a block lasts, or until Ctrl-C.

        with serve(drive, "tcp://127.0.0.1:7400"):
            ...

        serve(drive, "tcp://127.0.0.1:7400").forever()

    The servers run in an event loop of their own, in a thread that ends with the block; plain
    functions run in further threads. The block gets the URLs. The arguments are those of
    `fibaction.serve`.

    Raises:
        TransportError: An address cannot be used.
        TypeError: A transport does not have such a setting; or, at the beginning of the block, as
            for `fibaction.serve`.
        RuntimeError: At the beginning of the block: an event loop runs in this thread, which the
            block would block, or a server has been stopped.
    """
    transports = [transport_for(one, **settings) for one in where]
    if any(transport.shares_event_loop for transport in transports):
        raise TransportError(
            "fibaction.blocking cannot serve at inproc://, whose clients share the server's event"
            " loop: use an address such as tcp://127.0.0.1:7400"
        )
    # Only URLs take settings, and these have got them.
    return BlockingServing(
        lambda: fibaction._api.serve(endpoints, *transports, watchers=watchers),
        lambda _loop, urls: urls,
    )
