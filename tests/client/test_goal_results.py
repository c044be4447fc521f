"""`fibaction.client.client`: the results of goals in a list."""

from __future__ import annotations

import pytest

from fibaction import ActionServer, GoalID, GoalInfo, GoalStatus, Outcome
from fibaction.border.abc import ForwardingEndpoint
from fibaction.client.client import with_result
from fibaction.words.goals import UNKNOWN_OUTCOME
from tests.support.fibonacci import FIBONACCI, Result, fibonacci

pytestmark = pytest.mark.anyio

INFO = GoalInfo(GoalID(bytes([1] * 16)), 1, GoalStatus.ABORTED, reason="cut")


class Answering(ForwardingEndpoint):
    """An endpoint that gives one outcome."""

    def __init__(self, outcome: Outcome[bytes]) -> None:
        super().__init__(ActionServer(FIBONACCI, fibonacci))
        self.outcome = outcome

    async def get_result(self, goal_id: GoalID) -> Outcome[bytes]:
        assert goal_id == INFO.goal_id
        return self.outcome


async def result_of(outcome: Outcome[bytes]) -> tuple[object, str]:
    found = await with_result(Answering(outcome), FIBONACCI.result, INFO)
    return found.result, found.reason


async def test_a_goal_has_its_result_and_its_whole_reason() -> None:
    payload = FIBONACCI.result.encode(Result([1]))
    assert await result_of(Outcome(GoalStatus.ABORTED, payload, "uncut")) == (Result([1]), "uncut")
    assert await result_of(Outcome(GoalStatus.ABORTED, None, "uncut")) == (None, "uncut")


async def test_a_goal_that_is_forgotten_meanwhile_stays_as_it_is() -> None:
    assert await result_of(UNKNOWN_OUTCOME) == (None, "cut")


async def test_a_result_that_cannot_be_read_is_left_out_and_the_reason_says_so() -> None:
    result, reason = await result_of(Outcome(GoalStatus.ABORTED, b"\xc1", "stuck"))
    assert result is None
    assert reason.startswith("stuck; its result cannot be read: ")


async def test_an_active_goal_is_not_asked_for() -> None:
    active = GoalInfo(GoalID(bytes([2] * 16)), 1, GoalStatus.EXECUTING)
    assert await with_result(Answering(UNKNOWN_OUTCOME), FIBONACCI.result, active) is active
