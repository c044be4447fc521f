"""A goal that agents follow: what is kept for them, and how long the goal waits for them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import anyio
import pytest

from fibaction.border.abc import FeedbackItem, GoalStream, GoalUpdate, Notifier
from fibaction.words.errors import ActionError, ConnectionLost
from fibaction.words.goals import GoalID, Outcome
from fibaction.words.statuses import GoalStatus
from fibaction_transports._agents import agent_goals
from fibaction_transports._agents.agent_goals import START, AgentGoal, Position

pytestmark = pytest.mark.asyncio
PATIENCE = 20.0


class Scripted(GoalStream):
    """A stream whose updates a test gives."""

    def __init__(self) -> None:
        self.goal_id = GoalID.random()
        self.stamp = 1
        self.latest = False
        self.cursor = 0
        self.reads = True
        self.news = Notifier()
        self.script: list[GoalUpdate | ActionError] = []
        self.taken = 0

    @property
    def status(self) -> GoalStatus:
        return GoalStatus.EXECUTING

    @property
    def dropped(self) -> int:
        return 0

    def give(self, *updates: GoalUpdate | ActionError) -> None:
        self.script.extend(updates)
        self.news.notify()

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        if not self.script:
            return ()
        self.taken += 1
        update = self.script.pop(0)
        if isinstance(update, ActionError):
            raise update
        return (update,)

    def known_outcome(self) -> Outcome[bytes] | None:
        return None

    def hold(self, wanted: bool) -> None:
        """Do nothing: nothing waits for it."""

    def fail(self, error: ActionError) -> None:
        """Do nothing: it is not asked to."""

    def close(self) -> None:
        self.reads = False


def feedback(first: int, last: int, attempt: int = 1) -> list[FeedbackItem]:
    return [FeedbackItem(number, b"abcd", attempt) for number in range(first, last + 1)]


END: Outcome[bytes] = Outcome(GoalStatus.SUCCEEDED, b"\x01")


def followed(most_kept: int = 100) -> tuple[Scripted, AgentGoal[Any]]:
    stream = Scripted()
    return stream, AgentGoal(cast("Any", None), stream, owner="", most_kept=most_kept)


async def numbers(goal: AgentGoal[Any], after: Position = START) -> list[Any]:
    return [
        entry.update.number if isinstance(entry.update, FeedbackItem) else entry.update.name
        async for entry in goal.updates(after)
    ]


@pytest.mark.parametrize(
    ("most_kept", "most_bytes", "kept"), [(5, 1000, [5, 6, 7, 8, 9]), (9, 8, [8, 9]), (9, 1, [9])]
)
async def test_the_last_updates_are_kept_in_number_and_in_bytes(
    monkeypatch: pytest.MonkeyPatch, most_kept: int, most_bytes: int, kept: list[int]
) -> None:
    monkeypatch.setattr(agent_goals, "MOST_BYTES", most_bytes)
    stream, goal = followed(most_kept)
    stream.give(*feedback(1, 9), END)
    await goal.follow()
    assert await numbers(goal) == kept
    assert goal.outcome is END
    assert not stream.reads


async def test_a_position_is_in_an_attempt() -> None:
    stream, goal = followed()
    stream.give(*feedback(1, 3), *feedback(1, 2, attempt=2), END)
    await goal.follow()
    assert await numbers(goal, (1, 2)) == [3, 1, 2]
    assert await numbers(goal, (2, 1)) == [2]
    assert await numbers(goal, (math.inf, 0)) == []


async def test_of_the_statuses_only_new_ones_are_told_to_who_comes_back() -> None:
    stream, goal = followed()
    stream.give(GoalStatus.EXECUTING, *feedback(1, 1), GoalStatus.CANCELING, *feedback(2, 2), END)
    await goal.follow()
    assert await numbers(goal) == [1, 2]
    everything = [entry.update async for entry in goal.updates(statuses=True)]
    assert everything[0] is GoalStatus.EXECUTING
    assert everything[2] is GoalStatus.CANCELING


async def test_a_goal_that_cannot_be_followed_any_more_has_an_error() -> None:
    stream, goal = followed()
    stream.give(*feedback(1, 1), ConnectionLost("the line is down"))
    await goal.follow()
    assert await numbers(goal) == [1]
    assert str(goal.error) == "the line is down"
    assert goal.outcome is None


@pytest.mark.parametrize(
    ("most_kept", "most_bytes", "goes"),
    [(4, agent_goals.MOST_BYTES, False), (100, 16, False), (4, agent_goals.MOST_BYTES, True)],
    ids=["messages behind", "bytes behind", "gone, and back"],
)
async def test_the_goal_waits_for_an_agent_that_is_behind_and_for_one_that_has_gone(
    monkeypatch: pytest.MonkeyPatch, most_kept: int, most_bytes: int, goes: bool
) -> None:
    monkeypatch.setattr(agent_goals, "MOST_BYTES", most_bytes)
    stream, goal = followed(most_kept)
    with anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            (first,) = feedback(1, 1)
            stream.give(first)
            tasks.start_soon(goal.follow)
            updates = goal.updates()
            assert (await anext(updates)).update is first
            if goes:
                await updates.aclose()
                updates = goal.updates((1, 1))
            stream.give(*feedback(2, 9), END)
            await anyio.wait_all_tasks_blocked()
            assert stream.taken == 4
            rest = [cast("Any", entry.update).number async for entry in updates]
            assert rest == [2, 3, 4, 5, 6, 7, 8, 9]


async def test_an_agent_that_does_not_come_back_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(agent_goals, "LONGEST_WAIT", 0.01)
    stream, goal = followed(4)
    with anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            stream.give(*feedback(1, 1))
            tasks.start_soon(goal.follow)
            updates = goal.updates()
            await anext(updates)
            stream.give(*feedback(2, 9), END)
            await goal.ended.wait()
            rest = [cast("Any", entry.update).number async for entry in updates]
            assert rest == [6, 7, 8, 9]
