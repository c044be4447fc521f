"""Errors: each arrives as itself, with its text and its attributes; and those of a connection that
is left.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionError,
    ActionServer,
    AuthenticationFailed,
    CancelAnswer,
    ConnectionLost,
    Endpoint,
    GoalCanceled,
    GoalID,
    GoalRejected,
    GoalStatus,
    InvalidMessage,
    InvalidURL,
    LimitReached,
    ProtocolError,
    ServerFailed,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)
from fibaction.border.abc import GoalRequest, GoalStream, StatusStream
from fibaction.testing.contract.executors import FIBONACCI, Feedback, Goal, Result, Steps
from fibaction.testing.contract.reach import Reach
from fibaction.types.action import ActionInfo
from fibaction.wire.errors import NUMBERS

pytestmark = pytest.mark.anyio

GOAL_ID = GoalID(bytes(range(16)))

ERRORS: list[ActionError] = [
    UnknownGoal(GOAL_ID),
    ProtocolError("feedback of action 'arm' is not of its type"),
    InvalidMessage("the message has 2000 bytes, and the server accepts 1000"),
    TransportError("the types of action 'arm' cannot be used"),
    InvalidURL("'robot' is not a URL"),
    ServerNotFound("no server at tcp://robot:7400"),
    ConnectionLost("the connection to tcp://robot:7400 was lost: \N{ROBOT FACE}"),
    AuthenticationFailed("this client may not send"),
    LimitReached("too much at once"),
    ServerFailed("the server failed: ValueError"),
]
REQUESTS: dict[str, Callable[[Endpoint], Coroutine[Any, Any, Any]]] = {
    "send_goal": lambda endpoint: endpoint.send_goal(GOAL_ID, b"{}"),
    "feedback": lambda endpoint: endpoint.feedback(GOAL_ID),
    "cancel_goals": lambda endpoint: endpoint.cancel_goals(GOAL_ID),
    "status": lambda endpoint: endpoint.status(),
}

CASES = [
    (error, name)
    for error in ERRORS
    for name in REQUESTS
    if name != "status" or not isinstance(error, UnknownGoal)  # a status is not about one goal
]


class Failing(Endpoint):
    """An endpoint whose every method raises one error."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    @property
    def info(self) -> ActionInfo:
        return FIBONACCI.info

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        raise self._error

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False, attempt: int = 1
    ) -> GoalStream:
        raise self._error

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        raise self._error

    async def status(self) -> StatusStream:
        raise self._error

    async def wait_for_server(self) -> None:
        raise self._error


async def raised(reach: Reach, error: ActionError, request: str) -> ActionError:
    async with reach.connection(Failing(error)) as connection:
        with pytest.raises(ActionError) as caught:
            await REQUESTS[request](connection.endpoint(FIBONACCI))
    return caught.value


@pytest.mark.promise("ERROR-4")
async def test_every_error_of_the_table_is_shown_here() -> None:
    assert {type(error) for error in ERRORS} == set(NUMBERS)


@pytest.mark.promise("ERROR-4")
@pytest.mark.parametrize(
    ("error", "request_name"),
    CASES,
    ids=[f"{type(error).__name__}-{name}" for error, name in CASES],
)
async def test_an_error_of_an_endpoint_arrives_as_itself(
    reach: Reach, error: ActionError, request_name: str
) -> None:
    arrived = await raised(reach, error, request_name)
    assert type(arrived) is type(error)
    assert str(arrived) == str(error)
    assert vars(arrived) == vars(error)


@pytest.mark.promise("ERROR-4")
async def test_a_rejection_of_an_endpoint_arrives_with_its_reason_and_goal(reach: Reach) -> None:
    arrived = await raised(reach, GoalRejected("too far", goal_id=GOAL_ID), "send_goal")
    assert type(arrived) is GoalRejected
    assert (arrived.reason, arrived.goal_id) == ("too far", GOAL_ID)
    assert str(arrived) == f"goal {GOAL_ID} was rejected: too far"


class LowBattery(TransportError):
    """An error of an endpoint that only its author knows."""


@pytest.mark.promise("ERROR-4")
async def test_an_error_that_only_the_server_knows_arrives_as_its_nearest_base(
    reach: Reach,
) -> None:
    arrived = await raised(reach, LowBattery("charge the robot"), "cancel_goals")
    assert isinstance(arrived, TransportError)
    assert type(arrived) in (TransportError, LowBattery)  # LowBattery within one process
    assert str(arrived) == "charge the robot"


Client = ActionClient[Goal, Feedback, Result]


async def calls(client: Client) -> None:
    await client.call(Goal(1))


async def calls_with_feedback(client: Client) -> None:
    await client.call(Goal(1), on_feedback=print)


async def follows_in_a_block(client: Client) -> None:
    async with client.send_goal(Goal(1)) as goal:
        async for _ in goal.feedback:
            pass
        await goal.result()


@pytest.mark.promise("CANCEL-22")
@pytest.mark.parametrize("use", [calls, calls_with_feedback, follows_in_a_block])
async def test_leaving_a_connection_cancels_the_goals_of_its_blocks_in_other_tasks(
    reach: Reach, use: Callable[[Client], Awaitable[None]], caplog: pytest.LogCaptureFixture
) -> None:
    held = Steps()
    clients: list[Client] = []
    has_client = anyio.Event()

    async def use_it() -> None:
        await has_client.wait()
        with pytest.raises((ConnectionLost, GoalCanceled)):
            await use(clients[0])

    with anyio.fail_after(10):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(use_it)
            await anyio.wait_all_tasks_blocked()
            async with reach(ActionServer(FIBONACCI, held)) as client:
                clients.append(client)
                has_client.set()
                await held.began.wait()
    assert held.ended_as == [GoalStatus.CANCELING]
    assert "could not be canceled" not in caplog.text


@pytest.mark.promise("LOSS-2")
async def test_what_is_followed_over_a_connection_ends_with_it(reach: Reach) -> None:
    held = Steps()
    async with reach(ActionServer(FIBONACCI, held)) as client:
        goal = await client.send_goal(Goal(1))
        statuses = await client.endpoint.status()
        await statuses.listed()
        await held.began.wait()
    for wait in (goal.outcome, statuses.receive, client.goals):
        with anyio.fail_after(30), pytest.raises(ConnectionLost, match="was closed here"):
            for _ in range(10):  # after what had arrived
                await wait()
    assert held.ended_as == [GoalStatus.EXECUTING], "an awaited goal goes on until the server stops"
