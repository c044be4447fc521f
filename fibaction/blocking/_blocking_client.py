"""`BlockingConnection` and `BlockingClient`: a connection and its clients, for plain calls."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar, Unpack, overload

from fibaction._api import ClientConnection
from fibaction.blocking._blocking_goal import BlockingGoal
from fibaction.blocking._loop_thread import LoopThread
from fibaction.client.client import ActionClient
from fibaction.client.goal import ClientGoal, SendingGoal
from fibaction.client.options import BlockingCallOptions, GoalOptions
from fibaction.types.action import Action, ActionInfo, FeedbackT, GoalT, ResultT
from fibaction.types.arguments import Arguments, CalledAction, HasAction, P, TakesNone, TakesOne
from fibaction.words.goals import ActionPeers, CancelAnswer, GoalID, GoalInfo, WorkerInfo

if TYPE_CHECKING:
    from fibaction.server.functions.function_action import FunctionAction

OneT = TypeVar("OneT")


class BlockingClient(Generic[GoalT, FeedbackT, ResultT]):
    """A client of one action, whose methods wait. Several threads may use it at once.

    For example:

        with connect("tcp://127.0.0.1:7400", DRIVE) as client:
            print(client.call(3, on_feedback=print))
    """

    def __init__(self, loop: LoopThread, client: ActionClient[GoalT, FeedbackT, ResultT]) -> None:
        self._loop = loop
        self._client = client
        self.action = client.action

    # For type checkers: as for `ActionClient`.

    @overload
    def call(
        self: BlockingClient[Arguments[P], FeedbackT, ResultT], /, *args: P.args, **kwargs: P.kwargs
    ) -> ResultT: ...
    @overload
    def call(
        self: BlockingClient[Arguments[[]], FeedbackT, ResultT],
        /,
        **options: Unpack[BlockingCallOptions[FeedbackT]],
    ) -> ResultT: ...
    @overload
    def call(
        self: HasAction[TakesNone[FeedbackT, ResultT]],
        /,
        **options: Unpack[BlockingCallOptions[FeedbackT]],
    ) -> ResultT: ...
    @overload
    def call(
        self: HasAction[TakesOne[OneT, FeedbackT, ResultT]],
        first: OneT,
        /,
        **options: Unpack[BlockingCallOptions[FeedbackT]],
    ) -> ResultT: ...
    @overload
    def call(
        self: HasAction[CalledAction[None, FeedbackT, ResultT]],
        goal: None = None,
        /,
        **options: Unpack[BlockingCallOptions[FeedbackT]],
    ) -> ResultT: ...
    @overload
    def call(
        self, goal: GoalT, /, **options: Unpack[BlockingCallOptions[FeedbackT]]
    ) -> ResultT: ...
    def call(self, /, *args: Any, **given: Any) -> Any:
        """Send a goal, and return its result.

        `on_feedback` is called with each feedback, in this thread. Its exception cancels the goal,
        and so does Ctrl-C. `timeout`, `retry` and `labels` are those of `ActionClient.call`.

        Raises:
            ActionError, TypeError, ValueError: As for `ActionClient.call`.
        """
        client: ActionClient[Any, FeedbackT, ResultT] = self._client
        on_feedback = given.pop("on_feedback", None)
        if on_feedback is None:
            return self._loop.run(lambda: client.call(*args, **given))

        async def call(hand_over: Callable[[FeedbackT], Awaitable[None]]) -> ResultT:
            return await client.call(*args, on_feedback=hand_over, **given)

        return self._loop.run_with_callback(call, on_feedback)

    @overload
    def send_goal(
        self: BlockingClient[Arguments[P], FeedbackT, ResultT], /, *args: P.args, **kwargs: P.kwargs
    ) -> BlockingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self: BlockingClient[Arguments[[]], FeedbackT, ResultT], /, **options: Unpack[GoalOptions]
    ) -> BlockingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self: HasAction[TakesNone[FeedbackT, ResultT]], /, **options: Unpack[GoalOptions]
    ) -> BlockingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self: HasAction[TakesOne[OneT, FeedbackT, ResultT]],
        first: OneT,
        /,
        **options: Unpack[GoalOptions],
    ) -> BlockingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self: HasAction[CalledAction[None, FeedbackT, ResultT]],
        goal: None = None,
        /,
        **options: Unpack[GoalOptions],
    ) -> BlockingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self, goal: GoalT, /, **options: Unpack[GoalOptions]
    ) -> BlockingGoal[FeedbackT, ResultT]: ...
    def send_goal(self, /, *args: Any, **given: Any) -> BlockingGoal[Any, Any]:
        """Send a goal, and return it: **`with send_goal` cancels, `goal.detach()` prevents it.**

        It returns as soon as the server has accepted the goal. `with client.send_goal(...) as goal`
        cancels the goal at the end of the block, if it has not ended, unless `goal.detach()` was
        called. Without a block, the goal continues after the end of the block of `connect`, as in
        asyncio; but Ctrl-C in the main thread before the next call of the client cancels it.
        `goal_id`, `timeout` and `labels` are those of `ActionClient.send_goal`.

        Raises:
            ActionError, TypeError, ValueError: As for `ActionClient.send_goal`.
        """
        client: ActionClient[Any, FeedbackT, ResultT] = self._client

        async def send() -> tuple[ClientGoal[FeedbackT, ResultT], SendingGoal[FeedbackT, ResultT]]:
            sending = client.send_goal(*args, **given)
            return await sending.__aenter__(), sending

        return BlockingGoal(self._loop, *self._loop.run(send))

    def attach(
        self, goal_id: GoalID | str, *, after: int | None = None, attempt: int = 1
    ) -> BlockingGoal[FeedbackT, ResultT]:
        """Follow a goal that any client sent. The end of a block does not cancel it.

        Raises:
            ActionError, TypeError: As for `ActionClient.attach`.
        """
        goal = self._loop.run(lambda: self._client.attach(goal_id, after=after, attempt=attempt))
        return BlockingGoal(self._loop, goal, None)

    def cancel_goals(
        self, goal_id: GoalID | str | None = None, *, before: int | None = None
    ) -> CancelAnswer:
        """Ask the server to cancel goals of any clients: see `ActionClient.cancel_goals`.

        Raises:
            ActionError, TypeError: As for `ActionClient.cancel_goals`.
        """
        return self._loop.run(lambda: self._client.cancel_goals(goal_id, before=before))

    def goals(self, *, results: bool = False) -> list[GoalInfo]:
        """Return every goal that the server knows: those that have ended, then the active ones.

        With `results`, fetch the result of each goal that has ended, too, by one request each.

        Raises:
            ActionError: As for `ActionClient.goals`.
        """
        return self._loop.run(lambda: self._client.goals(results=results))

    def wait_for_server(self, timeout: float | None = None) -> None:
        """Wait until the action is served.

        Raises:
            ServerNotFound: It was not served within `timeout` seconds (None: no limit).
            TransportError: The connection ended for good, or the server does not answer.
        """
        self._loop.run(lambda: self._client.wait_for_server(timeout))

    def __repr__(self) -> str:
        return f"<BlockingClient of {self.action!r}>"


class BlockingConnection:
    """An open connection, whose methods wait: the source of clients of all its actions."""

    def __init__(self, loop: LoopThread, connection: ClientConnection) -> None:
        self._loop = loop
        self._connection = connection

    @overload
    def client(
        self, action: FunctionAction[P, FeedbackT, ResultT, Any]
    ) -> BlockingClient[Arguments[P], FeedbackT, ResultT]: ...
    @overload
    def client(
        self, action: Action[GoalT, FeedbackT, ResultT]
    ) -> BlockingClient[GoalT, FeedbackT, ResultT]: ...
    def client(self, action: Action[Any, Any, Any]) -> BlockingClient[Any, Any, Any]:
        """Return a client of one action over this connection."""

        async def client() -> ActionClient[Any, Any, Any]:
            return self._connection.client(action)

        return BlockingClient(self._loop, self._loop.run(client))

    def actions(self) -> list[ActionInfo]:
        """Return the actions that can be reached now: see `Connection.actions`."""
        return self._loop.run(self._connection.actions)

    def peers(self, action: str) -> ActionPeers:
        """Return the servers and the clients of an action: see `Connection.peers`."""
        return self._loop.run(lambda: self._connection.peers(action))

    def workers(self) -> list[WorkerInfo]:
        """Return the workers of the fleet: see `Connection.workers`."""
        return self._loop.run(self._connection.workers)

    def __repr__(self) -> str:
        return f"<BlockingConnection of {self._connection!r}>"


def client_or_connection(
    loop: LoopThread, connection: ClientConnection, action: Action[Any, Any, Any] | None
) -> BlockingConnection | BlockingClient[Any, Any, Any]:
    """Return the connection itself, or a client of the action if there is one."""
    opened = BlockingConnection(loop, connection)
    return opened if action is None else opened.client(action)
