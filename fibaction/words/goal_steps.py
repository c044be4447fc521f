"""`GoalStep`: one step of a goal, with which its executor sends another goal, its child.

Theory of operation
-------------------

The ID of a child is made of the ID of its parent, the name of the child's action and the name of
the step. So each attempt at the parent sends the same child, and a server that knows it lets the
attempt follow it.

A child is left when its block ends before the child has. If the parent continues in another attempt
(`is_kept`), the child is left alone; otherwise it is canceled. The parent may still end in this
attempt: its executor may yield a result anyway, and a cancel may arrive while it cleans up.
So the cancels of children that are left alone are kept until the executor is gone (`settle`).

This module depends on neither clients nor servers, which both use it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Protocol, TypeAlias

from fibaction.words.goals import GoalID, Parent, child_id

Cancel: TypeAlias = Callable[[], Awaitable[None]]
"""A function that cancels a child."""


class SteppedGoal(Protocol):
    """A goal whose executor sends children, in one attempt."""

    goal_id: GoalID
    attempt: int

    @property
    def is_kept(self) -> bool:
        """True if this attempt is interrupted, and the goal continues in another one."""
        ...


class GoalSteps:
    """The steps of one attempt at a goal."""

    __slots__ = ("_left", "goal", "taken")

    def __init__(self, goal: SteppedGoal) -> None:
        self.goal = goal
        self.taken: set[GoalID] = set()
        """The children that were sent in this attempt, and that run or have ended."""
        self._left: list[Cancel] = []

    def leave(self, cancel: Cancel) -> None:
        """Leave a child to the next attempt, and keep the function that cancels it."""
        self._left.append(cancel)

    async def settle(self, *, is_over: bool) -> None:
        """Cancel the children that were left, if the goal does not continue: its executor `is_over`
        with an ending of its own, or a cancel has arrived.
        """
        if is_over or not self.goal.is_kept:
            for cancel in self._left:
                await cancel()


class GoalStep:
    """One step of a goal: see `GoalHandle.step`."""

    __slots__ = ("_steps", "name", "wait_for_end")

    def __init__(self, steps: GoalSteps, name: str, *, wait_for_end: bool) -> None:
        self._steps = steps
        self.name = name
        """The name of the step, which no other step of the goal has."""
        self.wait_for_end = wait_for_end
        """True if the end of a child that is canceled is waited for."""

    @property
    def parent(self) -> Parent:
        """The goal whose step it is, with the name of the step."""
        return Parent(self._steps.goal.goal_id, self.name)

    @property
    def is_first(self) -> bool:
        """True in the first attempt at the goal: the child was never sent before."""
        return self._steps.goal.attempt == 1

    @property
    def is_kept(self) -> bool:
        """True if a child that is left now is left to the next attempt."""
        return self._steps.goal.is_kept

    def child_id(self, action: str) -> GoalID:
        """Return the ID of the child, a goal of that action."""
        return child_id(self._steps.goal.goal_id, action, self.name)

    def take(self, child: GoalID) -> None:
        """Note that a child is sent.

        Raises:
            ValueError: It was sent in this attempt before, and runs or has ended.
        """
        if child in self._steps.taken:
            raise ValueError(
                f"the step {self.name!r} of goal {self.parent.goal_id} was taken before: give each"
                f" step a name of its own, such as {self.name + ' 2'!r}"
            )
        self._steps.taken.add(child)

    def give_back(self, child: GoalID) -> None:
        """Note that the end of a child is not known: it may be sent again, and is followed then."""
        self._steps.taken.discard(child)

    def leave(self, cancel: Cancel) -> None:
        """Leave the child to the next attempt: see `GoalSteps.leave`."""
        self._steps.leave(cancel)
