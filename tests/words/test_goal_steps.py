"""Steps of a goal: the IDs of children, and what becomes of those that were left."""

from __future__ import annotations

import pytest

from fibaction import GoalID
from fibaction.words.goal_steps import GoalStep, GoalSteps
from fibaction.words.goals import child_id


class Parent:
    def __init__(self, attempt: int = 1, *, is_kept: bool = False) -> None:
        self.goal_id = GoalID(bytes(range(16)))
        self.attempt = attempt
        self.is_kept = is_kept


def test_a_child_has_the_id_of_its_step_and_was_never_sent_before_the_first_attempt() -> None:
    step = GoalStep(GoalSteps(Parent()), "pick", wait_for_end=False)
    assert step.child_id("arm") == child_id(step.parent.goal_id, "arm", "pick")
    assert step.is_first
    assert not GoalStep(GoalSteps(Parent(2)), "pick", wait_for_end=False).is_first


def test_a_step_is_taken_once_until_it_is_given_back() -> None:
    step = GoalStep(GoalSteps(Parent()), "pick", wait_for_end=False)
    child = step.child_id("arm")
    step.take(child)
    with pytest.raises(ValueError, match="was taken before"):
        step.take(child)
    step.give_back(child)
    step.take(child)


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("is_kept", "is_over", "expected"), [(True, False, 0), (True, True, 1), (False, False, 1)]
)
async def test_a_child_that_was_left_is_canceled_unless_its_parent_goes_on(
    *, is_kept: bool, is_over: bool, expected: int
) -> None:
    canceled: list[str] = []

    async def cancel() -> None:
        canceled.append("child")

    steps = GoalSteps(Parent(is_kept=is_kept))
    step = GoalStep(steps, "pick", wait_for_end=False)
    assert step.is_kept is is_kept
    step.leave(cancel)
    await steps.settle(is_over=is_over)
    assert len(canceled) == expected
