"""The values that servers and stores exchange."""

from __future__ import annotations

import pytest

from fibaction.states import GoalStatus
from tests.stores.made import a_goal


@pytest.mark.parametrize(
    ("status", "attempt", "told"),
    [
        (GoalStatus.ACCEPTED, 0, GoalStatus.ACCEPTED),
        (GoalStatus.ACCEPTED, 2, GoalStatus.EXECUTING),
        (GoalStatus.CANCELING, 1, GoalStatus.CANCELING),
        (GoalStatus.SUCCEEDED, 1, GoalStatus.SUCCEEDED),
    ],
)
def test_an_active_goal_that_has_begun_is_executing_for_clients(
    status: GoalStatus, attempt: int, told: GoalStatus
) -> None:
    goal = a_goal(1)
    goal.status, goal.attempt = status, attempt
    assert goal.told_status is told
