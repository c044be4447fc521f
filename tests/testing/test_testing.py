"""`fibaction.testing`: the helpers for tests, tested."""

from __future__ import annotations

from typing import Any, cast

import anyio
import msgspec
import pytest

from fibaction import (
    ActionClient,
    CancelCode,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
    GoalStatus,
    ProtocolError,
    action,
)
from fibaction.server.execution.executor import Executor
from fibaction.testing import ScriptedServer, run_executor
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.matching import End

pytestmark = pytest.mark.asyncio


async def counts(goal: GoalHandle[Goal]) -> Items:
    number = 0
    try:
        while True:
            number += 1
            yield Feedback([number])
    except anyio.get_cancelled_exc_class():
        raise GoalCanceled(result=Result([number])) from None


async def test_an_executor_is_run_to_its_end() -> None:
    trial = await run_executor(FIBONACCI, fibonacci, Goal(3))
    assert trial.outcome == End(GoalStatus.SUCCEEDED, Result([0, 1, 1, 2]))
    assert trial.feedback == [Feedback([0, 1, 1]), Feedback([0, 1, 1, 2])]


@pytest.mark.parametrize("after", [1, 2, 100])
async def test_an_executor_is_canceled_exactly_at_that_feedback(after: int) -> None:
    trial = await run_executor(FIBONACCI, counts, Goal(0), cancel_after=after)
    assert trial.outcome == End(GoalStatus.CANCELED, Result([after]))
    assert trial.feedback == [Feedback([number]) for number in range(1, after + 1)]


async def test_an_executor_that_is_canceled_before_it_starts_does_not() -> None:
    async def must_not_run(goal: GoalHandle[Goal]) -> Items:
        raise AssertionError("it ran")
        yield Feedback([])

    trial = await run_executor(FIBONACCI, must_not_run, Goal(0), cancel_after=0)
    assert trial.outcome == End(GoalStatus.CANCELED)
    assert trial.feedback == []


async def test_a_cooperative_executor_is_asked() -> None:
    async def looks(goal: GoalHandle[Goal]) -> Items:
        number = 0
        while not goal.cancel_requested:
            number += 1
            yield Feedback([number])
        raise GoalCanceled(result=Result([number]))

    trial = await run_executor(FIBONACCI, looks, Goal(0), cancel_after=4, interrupt_on_cancel=False)
    assert trial.outcome == End(GoalStatus.CANCELED, Result([4]))


async def test_an_executor_that_takes_too_long_is_ended() -> None:
    async def waits(goal: GoalHandle[Goal]) -> Items:
        await anyio.sleep_forever()
        yield Result([])

    with pytest.raises(TimeoutError) as caught:
        await run_executor(FIBONACCI, waits, Goal(0), timeout=0.01)
    assert str(caught.value) == "the goal of action 'fibonacci' has not ended within 0.01 s"


NEAR: Any = "near"  # which no type checker lets pass


async def feels_its_way(goal: GoalHandle[Goal]) -> Items:
    yield Feedback(NEAR)
    yield Result([])


async def ends_somewhere(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    yield Result(NEAR)


async def gives_up(goal: GoalHandle[Goal]) -> Items:
    raise GoalAborted("stuck", result=Result(NEAR))
    yield Feedback([])


@pytest.mark.parametrize(
    ("executor", "what", "field"),
    [
        (feels_its_way, "feedback", "partial_sequence"),
        (ends_somewhere, "the result", "sequence"),
        (gives_up, "the result", "sequence"),
    ],
)
async def test_an_executor_that_fills_in_what_is_of_another_type_is_found_out(
    executor: Executor[Goal, Feedback, Result], what: str, field: str
) -> None:
    with pytest.raises(ProtocolError) as caught:
        await run_executor(FIBONACCI, executor, Goal(0))
    assert str(caught.value) == (
        f"the executor is wrong: {what} of action 'fibonacci' is not of its type, as its server"
        f" sent it: Expected `array`, got `str` - at `$.{field}`"
    )


async def test_a_scripted_server_plays_one_script_after_the_other_and_repeats_the_last() -> None:
    async with ScriptedServer(
        FIBONACCI,
        [Feedback([1]), Result([2])],
        [GoalRejected("busy")],
        [GoalAborted("stuck", result=Result([3]))],
    ) as server:
        client = ActionClient(server, FIBONACCI)
        assert await client.call(Goal(1)) == Result([2])
        with pytest.raises(GoalRejected, match="busy"):
            await client.call(Goal(2))
        for order in (3, 4):
            with pytest.raises(GoalAborted, match="stuck"):
                await client.call(Goal(order))
        assert server.received == [Goal(1), Goal(2), Goal(3), Goal(4)]


async def test_a_script_that_waits_for_an_event_holds_the_goal() -> None:
    go = anyio.Event()
    async with ScriptedServer(FIBONACCI, [go, Result([1])], []) as server:
        client = ActionClient(server, FIBONACCI)
        first = await client.send_goal(Goal(1))
        empty = await client.send_goal(Goal(2))
        assert (await empty.outcome()).status is GoalStatus.ABORTED
        assert first.status is GoalStatus.EXECUTING
        go.set()
        assert await first.result() == Result([1])
        assert (await first.cancel()).return_code is CancelCode.GOAL_TERMINATED


async def test_a_scripted_server_needs_a_script() -> None:
    with pytest.raises(ValueError, match="needs at least one script"):
        ScriptedServer(FIBONACCI)


async def test_what_is_no_action_is_told_with_what_makes_one() -> None:
    wrong: Any = len
    with pytest.raises(TypeError, match=r"takes an action, not .*: make one with @action"):
        await run_executor(wrong, 1)


async def test_a_function_is_run_with_its_arguments() -> None:
    @action
    async def double(number: int, *, by: int = 2) -> int:
        return number * by

    assert (await run_executor(double, 2)).outcome.result == 4
    assert (await run_executor(double, number=2, by=3)).outcome.result == 6
    with pytest.raises(TypeError, match="has no executor: write ActionServer"):
        await run_executor(cast("Any", FIBONACCI), Goal(1))


class Task(msgspec.Struct):
    x: int

    def __call__(self) -> int:
        return self.x


async def test_a_goal_that_can_be_called_is_the_goal_of_a_function() -> None:
    @action
    async def run(goal: Task) -> int:
        return goal()

    assert (await run_executor(run, Task(3))).outcome.result == 3
