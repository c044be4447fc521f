"""Every error of an endpoint arrives as itself, with its text and its attributes."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from fibaction import (
    ActionError,
    AuthenticationFailed,
    CancelAnswer,
    ConnectionLost,
    Endpoint,
    GoalID,
    GoalRejected,
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
from fibaction.testing.contract.executors import FIBONACCI
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
