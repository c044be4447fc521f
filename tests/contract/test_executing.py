"""Design, section 4, "Executing": every executor ends in its status, and the reason is told."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from typing import Any, cast

import anyio
import pytest

from fibaction import (
    ActionServer,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalStatus,
    Outcome,
)
from tests.contract.conftest import Reach
from tests.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

pytestmark = pytest.mark.anyio

Items = AsyncGenerator[Feedback | Result, None]


async def ends_without_a_result(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])


async def yields_after_the_result(goal: GoalHandle[Goal]) -> Items:
    yield Result([1])
    yield Feedback([2])


async def yields_two_results(goal: GoalHandle[Goal]) -> Items:
    yield Result([1])
    yield Result([2])


async def yields_a_wrong_type(goal: GoalHandle[Goal]) -> Items:
    yield cast("Feedback", {"partial_sequence": [1]})


async def yields_what_cannot_be_encoded(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([cast("int", object())])


async def raises_before_the_first_yield(goal: GoalHandle[Goal]) -> Items:
    raise ValueError("no such arm")
    yield Result([])


async def raises_after_feedback(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    raise ValueError("the arm is stuck")


async def raises_after_the_result(goal: GoalHandle[Goal]) -> Items:
    yield Result([1])
    raise ValueError("the gripper does not open")


async def raises_in_a_task_group(goal: GoalHandle[Goal]) -> Items:
    async with anyio.create_task_group():
        raise ValueError("inside")
    yield Result([])


async def raises_twice_in_a_task_group(goal: GoalHandle[Goal]) -> Items:
    raise ExceptionGroup("two things", [ValueError("a"), KeyError("b")])
    yield Result([])


async def raises_while_it_is_closed(goal: GoalHandle[Goal]) -> Items:
    try:
        yield cast("Feedback", None)
    finally:
        raise ValueError("in finally")


async def ignores_that_it_is_closed(goal: GoalHandle[Goal]) -> Items:
    try:
        yield cast("Feedback", None)
    finally:
        yield Feedback([1])


async def aborts_with_a_part(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    raise GoalAborted("the object is too heavy", result=Result([1]))


async def aborts_in_a_task_group(goal: GoalHandle[Goal]) -> Items:
    async with anyio.create_task_group():
        raise GoalAborted("the object is too heavy", result=Result([1]))
    yield Result([])


async def aborts_with_a_wrong_part(goal: GoalHandle[Goal]) -> Items:
    raise GoalAborted("the object is too heavy", result=[1])
    yield Result([])


async def aborts_with_what_cannot_be_encoded(goal: GoalHandle[Goal]) -> Items:
    raise GoalAborted("the object is too heavy", result=Result([2**70]))
    yield Result([])


async def says_canceled_though_nobody_asked(goal: GoalHandle[Goal]) -> Items:
    raise GoalCanceled(result=Result([1]))
    yield Result([])


def is_no_generator(goal: GoalHandle[Goal]) -> Items:
    async def forgot_to_yield() -> Result:
        return Result([])

    return cast("Items", forgot_to_yield())


def raises_instead_of_making_one(goal: GoalHandle[Goal]) -> Items:
    raise ValueError("at once")


WRONG = "the executor is wrong: "
UNENCODABLE = "Encoding objects of type object is unsupported"

ABORTED: list[tuple[Callable[[GoalHandle[Goal]], Items], str, list[int] | None]] = [
    (ends_without_a_result, WRONG + "it ended without yielding a result", None),
    (yields_after_the_result, WRONG + "it yielded a Feedback after its result", [1]),
    (yields_two_results, WRONG + "it yielded a Result after its result", [1]),
    (
        yields_a_wrong_type,
        WRONG + "it yielded a dict, which is neither feedback nor a result",
        None,
    ),
    (yields_what_cannot_be_encoded, f"TypeError: {UNENCODABLE}", None),
    (raises_before_the_first_yield, "ValueError: no such arm", None),
    (raises_after_feedback, "ValueError: the arm is stuck", None),
    (raises_after_the_result, "ValueError: the gripper does not open", [1]),
    (raises_in_a_task_group, "ValueError: inside", None),
    (raises_twice_in_a_task_group, "ExceptionGroup: two things (2 sub-exceptions)", None),
    (raises_while_it_is_closed, "ValueError: in finally", None),
    (ignores_that_it_is_closed, "RuntimeError: async generator ignored GeneratorExit", None),
    (aborts_with_a_part, "the object is too heavy", [1]),
    (aborts_in_a_task_group, "the object is too heavy", [1]),
    (
        aborts_with_a_wrong_part,
        WRONG + "it raised GoalAborted with a list as its result",
        None,
    ),
    (
        aborts_with_what_cannot_be_encoded,
        "OverflowError: can't serialize ints < -2**63 or > 2**64 - 1",
        None,
    ),
    (
        says_canceled_though_nobody_asked,
        "the executor ended as canceled, but nobody had asked for that",
        [1],
    ),
    (is_no_generator, WRONG + "it is no async generator: it returned a coroutine", None),
    (raises_instead_of_making_one, "ValueError: at once", None),
]


@pytest.mark.parametrize(
    ("executor", "reason", "part"), ABORTED, ids=[case[0].__name__ for case in ABORTED]
)
async def test_an_executor_that_goes_wrong_is_aborted_with_the_reason(
    reach: Reach,
    executor: Callable[[GoalHandle[Goal]], Items],
    reason: str,
    part: list[int] | None,
) -> None:
    async with reach(ActionServer(FIBONACCI, executor)) as client:
        goal = await client.send_goal(Goal(1))
        outcome = await goal.outcome()
        result = None if part is None else Result(part)
        assert outcome == Outcome(GoalStatus.ABORTED, result, reason)
        with pytest.raises(GoalAborted) as caught:
            await goal.result()
        assert caught.value.reason == reason
        assert caught.value.result == result
        assert caught.value.goal_id == goal.goal_id
        assert str(caught.value) == f"goal {goal.goal_id} was aborted: {reason}"


async def test_an_exception_leaves_its_traceback_in_the_log(
    reach: Reach, caplog: pytest.LogCaptureFixture
) -> None:
    async with reach(ActionServer(FIBONACCI, raises_after_feedback)) as client:
        await (await client.send_goal(Goal(1))).outcome()
    assert "Traceback" in caplog.text
    assert "raise ValueError(" in caplog.text


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


async def test_an_executor_that_never_awaits_starves_nobody_and_can_be_canceled(
    reach: Reach,
) -> None:
    yields = 0

    async def never_awaits(goal: GoalHandle[Goal]) -> Items:
        nonlocal yields
        for yields in range(goal.request.order):
            yield Feedback([yields])
        yield Result([yields])

    server = ActionServer(FIBONACCI, never_awaits, feedback="latest")
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
    from fibaction import Action

    return Action("other", goal=Goal, feedback=Feedback, result=Result)


async def test_feedback_that_is_mutated_after_its_yield_stays_as_it_was(reach: Reach) -> None:
    async def mutates(goal: GoalHandle[Goal]) -> Items:
        feedback = Feedback([0])
        for number in range(goal.request.order):
            feedback.partial_sequence[0] = number
            yield feedback
            feedback.partial_sequence[0] = -1
        result = Result([7])
        yield result
        result.sequence.append(8)

    async with reach(ActionServer(FIBONACCI, mutates)) as client:
        mine = await client.send_goal(Goal(5))
        assert [item.partial_sequence async for item in mine.feedback] == [[n] for n in range(5)]
        assert await mine.result() == Result([7])


async def test_a_timeout_around_a_yield_reaches_the_executor(reach: Reach) -> None:
    async def impatient(goal: GoalHandle[Goal]) -> Items:
        with anyio.move_on_after(0.01) as patience:
            while True:
                yield Feedback([1])
        assert patience.cancelled_caught
        yield Result([2])

    server = ActionServer(FIBONACCI, impatient, feedback_window=1, stall_timeout=60)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1))
        # Nobody reads, so the executor waits at its yield; its own timeout must get through.
        assert await client.endpoint.get_result(goal.goal_id) == Outcome(
            GoalStatus.SUCCEEDED, encoded([2])
        )


async def test_the_executor_knows_its_goal(reach: Reach) -> None:
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

    async with reach(ActionServer(FIBONACCI, looks)) as client:
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


async def test_a_thousand_goals_at_once_all_end_once_though_a_third_is_canceled(
    reach: Reach,
) -> None:
    ends: dict[bytes, list[str]] = {}

    async def works(goal: GoalHandle[Goal]) -> Items:
        mine = ends.setdefault(goal.goal_id, [])
        try:
            for number in range(5):
                yield Feedback([number])
                await anyio.lowlevel.checkpoint()
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
            for number in range(1000):
                tasks.start_soon(one, number)
    assert len(statuses) == 1000
    assert set(statuses) == {GoalStatus.SUCCEEDED, GoalStatus.CANCELED}
    assert statuses.count(GoalStatus.CANCELED) > 50
    # A goal that was canceled before its executor started has never run.
    assert all(end == ["ended"] for end in ends.values())
