"""Design, section 4, "Executing": every executor ends in its status, and the reason is told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import anyio
import pytest

from fibaction import Action, ActionServer, GoalAborted, GoalHandle, GoalStatus
from fibaction.testing.contract.executors import (
    ABORTED,
    FIBONACCI,
    OF_GENERATORS,
    Feedback,
    Form,
    Goal,
    Items,
    Result,
    as_function,
    fibonacci,
    raises_after_feedback,
)
from fibaction.testing.contract.matching import End
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio


@pytest.mark.promise("STATUS-4", "EXECUTE-5", "EXECUTE-7", "RESULT-1", "ERROR-2")
@pytest.mark.parametrize(
    ("executor", "reason", "part"), ABORTED, ids=[case[0].__name__ for case in ABORTED]
)
async def test_an_executor_that_goes_wrong_is_aborted_with_the_reason(
    reach: Reach,
    form: Form,
    executor: Callable[[GoalHandle[Goal]], Items],
    reason: str,
    part: list[int] | None,
) -> None:
    if form is as_function and executor.__name__ in OF_GENERATORS:
        pytest.skip("a function cannot break this rule of generators")
    async with reach(ActionServer(FIBONACCI, form(executor))) as client:
        goal = await client.send_goal(Goal(1))
        outcome = await goal.outcome()
        result = None if part is None else Result(part)
        assert outcome == End(GoalStatus.ABORTED, result, reason)
        with pytest.raises(GoalAborted) as caught:
            await goal.result()
        assert caught.value.reason == reason
        assert caught.value.result == result
        assert caught.value.goal_id == goal.goal_id
        assert str(caught.value) == f"goal {goal.goal_id} was aborted: {reason}"


@pytest.mark.promise("EXECUTE-6")
async def test_an_exception_leaves_its_traceback_in_the_log(
    reach: Reach, form: Form, caplog: pytest.LogCaptureFixture
) -> None:
    async with reach(ActionServer(FIBONACCI, form(raises_after_feedback))) as client:
        await (await client.send_goal(Goal(1))).outcome()
    assert "Traceback" in caplog.text
    assert "raise ValueError(" in caplog.text


@pytest.mark.promise("EXECUTE-8")
async def test_the_generator_is_always_closed(reach: Reach) -> None:
    closed = []

    async def tidy(goal: GoalHandle[Goal]) -> Items:
        try:
            yield cast("Feedback", "wrong")
        finally:
            await anyio.lowlevel.checkpoint()
            closed.append(goal.request.order)

    async with reach(ActionServer(FIBONACCI, tidy)) as client:
        for order in range(3):
            await (await client.send_goal(Goal(order))).outcome()
    assert closed == [0, 1, 2]


@pytest.mark.turns
@pytest.mark.promise("EXECUTE-3")
async def test_an_executor_that_never_awaits_starves_no_other_and_can_be_canceled(
    reach: Reach,
    form: Form,
) -> None:
    yields = 0

    async def never_awaits(goal: GoalHandle[Goal]) -> Items:
        nonlocal yields
        for yields in range(goal.request.order):
            yield Feedback([yields])
        yield Result([yields])

    server = ActionServer(FIBONACCI, form(never_awaits), feedback="latest")
    other = ActionServer(_renamed(), fibonacci)
    async with reach.connection(server, other) as connection:
        client = connection.client(FIBONACCI)
        whole = await client.send_goal(Goal(100_000))
        endless = await client.send_goal(Goal(10**12))
        beside = await connection.client(other.action).call(Goal(5))
        answer = await endless.cancel()
        canceled = await endless.outcome()
        assert (await whole.result()) == Result([99_999])
    assert beside == Result([0, 1, 1, 2, 3, 5])
    assert answer.accepted
    assert canceled.status is GoalStatus.CANCELED


def encoded(sequence: list[int]) -> bytes:
    return FIBONACCI.result.encode(Result(sequence))


def _renamed() -> Any:
    return Action("other", goal=Goal, feedback=Feedback, result=Result)


@pytest.mark.promise("EXECUTE-4")
async def test_feedback_that_is_mutated_after_its_yield_stays_as_it_was(
    reach: Reach, form: Form
) -> None:
    async def mutates(goal: GoalHandle[Goal]) -> Items:
        feedback = Feedback([0])
        for number in range(goal.request.order):
            feedback.partial_sequence[0] = number
            yield feedback
            feedback.partial_sequence[0] = -1
        yield Result([])

    async with reach(ActionServer(FIBONACCI, form(mutates))) as client:
        mine = await client.send_goal(Goal(5))
        assert [item.partial_sequence async for item in mine.feedback] == [[n] for n in range(5)]


@pytest.mark.promise("EXECUTE-4")
async def test_a_result_that_is_mutated_after_its_yield_stays_as_it_was(reach: Reach) -> None:
    async def mutates(goal: GoalHandle[Goal]) -> Items:
        result = Result([7])
        yield result
        result.sequence.append(8)

    async with reach(ActionServer(FIBONACCI, mutates)) as client:
        assert await client.call(Goal(5)) == Result([7])


@pytest.mark.promise("EXECUTE-9")
async def test_a_timeout_around_a_yield_reaches_the_executor(reach: Reach, form: Form) -> None:
    async def impatient(goal: GoalHandle[Goal]) -> Items:
        with anyio.move_on_after(0.01) as patience:
            while True:
                yield Feedback([1])
        assert patience.cancelled_caught
        yield Result([2])

    server = ActionServer(FIBONACCI, form(impatient), feedback_window=1, stall_timeout=60)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1))
        # Nobody reads, so the executor waits at its yield; its own timeout must get through.
        assert await client.endpoint.get_result(goal.goal_id) == End(
            GoalStatus.SUCCEEDED, encoded([2])
        )


@pytest.mark.promise("EXECUTE-1", "ACCEPT-9")
async def test_the_executor_knows_its_goal(reach: Reach, form: Form) -> None:
    seen: dict[str, Any] = {}

    async def looks(goal: GoalHandle[Goal]) -> Items:
        seen.update(
            goal_id=goal.goal_id,
            stamp=goal.stamp,
            status=goal.status,
            request=goal.request,
            cancel_requested=goal.cancel_requested,
            text=repr(goal),
        )
        yield Result([])

    async with reach(ActionServer(FIBONACCI, form(looks))) as client:
        goal = await client.send_goal(Goal(4))
        await goal.result()
    assert seen == {
        "goal_id": goal.goal_id,
        "stamp": goal.stamp,
        "status": GoalStatus.EXECUTING,
        "request": Goal(4),
        "cancel_requested": False,
        "text": f"<GoalHandle {goal.goal_id} EXECUTING>",
    }


@pytest.mark.load
@pytest.mark.promise("GOAL-1", "GOAL-3", "GOAL-4", "STOP-9")
async def test_hundreds_of_goals_at_once_all_end_once_though_a_third_is_canceled(
    reach: Reach,
) -> None:
    ends: dict[bytes, list[str]] = {}

    async def works(goal: GoalHandle[Goal]) -> Items:
        mine = ends.setdefault(goal.goal_id, [])
        try:
            for number in range(5):
                yield Feedback([number])
                await anyio.lowlevel.checkpoint()
            if goal.request.order % 9 == 0:
                await anyio.sleep_forever()
        finally:
            mine.append("ended")
        yield Result([goal.request.order])

    statuses: list[GoalStatus] = []

    async def one(number: int) -> None:
        goal = await client.send_goal(Goal(number))
        if number % 3 == 0:
            for _ in range(number % 11):
                await anyio.lowlevel.checkpoint()
            await goal.cancel()
        outcome = await goal.outcome()
        if outcome.status is GoalStatus.SUCCEEDED:
            assert outcome.result == Result([number])
        statuses.append(outcome.status)

    async with reach(ActionServer(FIBONACCI, works)) as client:
        async with anyio.create_task_group() as tasks:
            for number in range(300):
                tasks.start_soon(one, number)
    assert len(statuses) == 300
    assert set(statuses) == {GoalStatus.SUCCEEDED, GoalStatus.CANCELED}
    assert statuses.count(GoalStatus.CANCELED) >= 34  # these wait for it; others race against it
    # A goal that was canceled before its executor started has never run.
    assert all(end == ["ended"] for end in ends.values())
