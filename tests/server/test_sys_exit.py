"""`sys.exit()` in code of the user, as `argparse` in a library calls it: it ends its goal alone."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    FunctionAction,
    GoalHandle,
    GoalRejected,
    Schedule,
    action,
)
from fibaction.border.watchers import Watcher
from fibaction.words.errors import GoalAborted
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result

pytestmark = pytest.mark.anyio

EXITED = r"sys\.exit\(2\) was called"


async def exits_in_a_generator(goal: GoalHandle[Goal]) -> Items:
    if goal.request.order:
        sys.exit(2)
    yield Feedback([1])
    yield Result([])


async def exits_after_a_wait(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    await anyio.lowlevel.checkpoint()
    if goal.request.order:
        sys.exit(2)
    yield Result([])


async def exits_as_it_is_canceled(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    if goal.request.order:
        try:
            await anyio.sleep_forever()
        finally:
            sys.exit(2)
    yield Result([])


@action("fibonacci")
async def exits_in_a_function(goal: Goal) -> Result:
    if goal.order:
        sys.exit(2)
    return Result([])


@action("fibonacci")
def exits_in_a_thread(goal: Goal) -> Result:
    if goal.order:
        sys.exit(2)
    return Result([])


def server_of(executor: Any) -> ActionServer[Any, Any, Any]:
    if isinstance(executor, FunctionAction):
        return ActionServer(executor)
    return ActionServer(FIBONACCI, executor)


@pytest.mark.promise("EXECUTE-10")
@pytest.mark.parametrize(
    "executor",
    [
        exits_in_a_generator,
        exits_after_a_wait,
        exits_as_it_is_canceled,
        exits_in_a_function,
        exits_in_a_thread,
    ],
)
async def test_an_executor_that_exits_ends_its_own_goal_alone(
    executor: Any, caplog: pytest.LogCaptureFixture
) -> None:
    async with server_of(executor) as server:
        client = ActionClient(server, FIBONACCI)
        goal = await client.send_goal(Goal(1))
        if executor is exits_as_it_is_canceled:
            await anext(aiter(goal.feedback))
            await goal.cancel()
        with pytest.raises(GoalAborted, match=EXITED):
            await goal.result()
        assert await client.call(Goal(0)) == Result([])
    assert "sys.exit(2) was called" in caplog.text


class Exits(Watcher):
    """A watcher that exits at each goal."""

    def offered(self, *what: Any) -> None:
        sys.exit(2)


def exits(*what: Any) -> Any:
    sys.exit(2)


async def exits_async(*what: Any) -> None:
    sys.exit(2)


@pytest.mark.parametrize(
    "settings",
    [
        {"on_goal": exits},
        {"on_goal": exits_async},
        {"schedule": Schedule(key=exits)},
    ],
)
async def test_a_function_that_is_asked_about_a_goal_and_exits_rejects_it(
    settings: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    async with ActionServer(FIBONACCI, exits_in_a_generator, **settings) as server:
        client = ActionClient(server, FIBONACCI)
        for _ in range(2):
            with pytest.raises(GoalRejected, match=f"failed: {EXITED}"):
                await client.call(Goal(0))


async def test_a_watcher_that_exits_changes_nothing(caplog: pytest.LogCaptureFixture) -> None:
    async with ActionServer(FIBONACCI, exits_in_a_generator, watchers=[Exits()]) as server:
        client = ActionClient(server, FIBONACCI)
        assert await client.call(Goal(0)) == Result([])
    assert "Exits.offered failed, and goals continue" in caplog.text


@dataclass
class Checked:
    """A goal whose class exits where its value is wrong."""

    meters: int

    def __post_init__(self) -> None:
        if self.meters < 0:
            sys.exit("meters is negative")


async def test_a_type_that_exits_has_its_goal_rejected(caplog: pytest.LogCaptureFixture) -> None:
    drive = Action("drive", goal=Checked, feedback=int, result=int)
    backwards = Checked(1)
    backwards.meters = -1

    async def executor(goal: GoalHandle[Checked]) -> AsyncIterator[int]:
        yield goal.request.meters

    async with ActionServer(drive, executor) as server:
        client = ActionClient(server, drive)
        with pytest.raises(GoalRejected, match=r"sys\.exit\('meters is negative'\) was called"):
            await client.call(backwards)
