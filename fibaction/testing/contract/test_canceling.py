"""Design, section 4, "Canceling"."""

from __future__ import annotations

from typing import Any, cast

import anyio
import pytest

from fibaction import (
    ActionServer,
    CancelAnswer,
    CancelCode,
    CancelRejected,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalStatus,
    Outcome,
    connect,
    serve,
)
from fibaction.testing.contract.executors import (
    FIBONACCI,
    Feedback,
    Form,
    Goal,
    Items,
    Result,
    Steps,
    Undecided,
    next_with,
)
from fibaction.testing.contract.matching import End
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio


@pytest.mark.promise("CANCEL-5", "CANCEL-9", "RESULT-1", "ERROR-2")
async def test_a_cancel_is_raised_at_an_await_and_the_part_that_is_done_is_kept(
    reach: Reach,
    form: Form,
) -> None:
    waits = anyio.Event()

    async def partial(goal: GoalHandle[Goal]) -> Items:
        yield Feedback([1])
        waits.set()  # before that, it is raised at the `yield`
        try:
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            assert goal.status is GoalStatus.CANCELING
            assert goal.cancel_requested
            raise GoalCanceled("asked to", result=Result([1])) from None
        yield Result([])

    async with reach(ActionServer(FIBONACCI, form(partial))) as client:
        async with client.send_goal(Goal(1)) as goal:
            async for _ in goal.feedback:
                await waits.wait()
                answer = await goal.cancel()
            with pytest.raises(GoalCanceled) as caught:
                await goal.result()
            outcome = await goal.outcome()
    assert answer.return_code is CancelCode.NONE
    assert [(info.goal_id, info.status) for info in answer.goals_canceling] == [
        (goal.goal_id, GoalStatus.CANCELING)
    ]
    assert outcome == End(GoalStatus.CANCELED, Result([1]), "asked to")
    assert caught.value.result == Result([1])
    assert caught.value.goal_id == goal.goal_id


@pytest.mark.promise("EXECUTE-3", "CANCEL-5")
async def test_a_cancel_is_raised_at_a_yield(reach: Reach, form: Form) -> None:
    where = []

    async def only_yields(goal: GoalHandle[Goal]) -> Items:
        number = 0
        while True:
            number += 1
            try:
                yield Feedback([number])
            except anyio.get_cancelled_exc_class():
                where.append(number)
                raise GoalCanceled(result=Result([number])) from None

    server = ActionServer(FIBONACCI, form(only_yields), feedback_window=1)
    async with reach(server) as client, client.send_goal(Goal(1)) as goal:
        async for item in goal.feedback:
            if item.partial_sequence == [3]:
                await goal.cancel()
        outcome = await goal.outcome()
    assert outcome == End(GoalStatus.CANCELED, Result(where))
    assert where[0] >= 3


@pytest.mark.promise("CANCEL-6")
async def test_clean_up_may_await_because_the_cancellation_arrives_once(
    reach: Reach, form: Form
) -> None:
    async def retreats(goal: GoalHandle[Goal]) -> Items:
        done: list[int] = []
        try:
            yield Feedback([0])
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            for step in range(3):
                await anyio.lowlevel.checkpoint()
                done.append(step)
                yield Feedback(done)
            raise GoalCanceled(result=Result(done)) from None

    async with reach(ActionServer(FIBONACCI, form(retreats))) as client:
        async with client.send_goal(Goal(1)) as goal:
            feedback = []
            async for item in goal.feedback:
                feedback.append(item.partial_sequence)
                if len(feedback) == 1:
                    await goal.cancel()
            outcome = await goal.outcome()
    assert feedback == [[0], [0], [0, 1], [0, 1, 2]]
    assert outcome == End(GoalStatus.CANCELED, Result([0, 1, 2]))


@pytest.mark.promise("CANCEL-12")
async def test_clean_up_that_raises_is_aborted_with_the_reason(reach: Reach, form: Form) -> None:
    async def breaks(goal: GoalHandle[Goal]) -> Items:
        try:
            yield Feedback([1])
            await anyio.sleep_forever()
        finally:
            raise RuntimeError("the brake failed")

    async with reach(ActionServer(FIBONACCI, form(breaks))) as client:
        async with client.send_goal(Goal(1)) as goal:
            async for _ in goal.feedback:
                await goal.cancel()
            assert await goal.outcome() == End(
                GoalStatus.ABORTED, None, "RuntimeError: the brake failed"
            )


async def waits(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    await anyio.sleep_forever()


async def delegates(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(anyio.sleep_forever)
        tasks.start_soon(anyio.sleep_forever)
    yield Result([])


async def swallows_the_cancellation(goal: GoalHandle[Goal]) -> Items:
    try:
        yield Feedback([1])
        await anyio.sleep_forever()
    except anyio.get_cancelled_exc_class():
        pass
    await anyio.lowlevel.checkpoint()
    yield Feedback([2])
    yield Result([3])


async def aborts_in_its_clean_up(goal: GoalHandle[Goal]) -> Items:
    try:
        yield Feedback([1])
        await anyio.sleep_forever()
    except anyio.get_cancelled_exc_class():
        raise GoalAborted("the brake failed", result=Result([1])) from None


@pytest.mark.promise("CANCEL-2", "CANCEL-6", "CANCEL-7", "CANCEL-9", "CANCEL-11", "CANCEL-12")
@pytest.mark.parametrize(
    ("executor", "ends"),
    [
        (waits, [End(GoalStatus.CANCELED)]),
        (delegates, [End(GoalStatus.CANCELED)]),
        (swallows_the_cancellation, [End(GoalStatus.SUCCEEDED, Result([3]))]),
        (
            aborts_in_its_clean_up,
            # ROS does not carry the reason.
            [End(GoalStatus.ABORTED, Result([1]), text) for text in ("the brake failed", "")],
        ),
    ],
    ids=["waits", "task group", "swallows", "aborts"],
)
async def test_what_an_executor_makes_of_its_cancellation_is_the_end(
    reach: Reach, form: Form, executor: Any, ends: list[End]
) -> None:
    async with reach(ActionServer(FIBONACCI, form(executor))) as client:
        async with client.send_goal(Goal(1)) as goal:
            async for item in goal.feedback:
                if item == Feedback([1]):
                    assert (await goal.cancel()).accepted
            assert await goal.outcome() in ends
            if executor is aborts_in_its_clean_up:
                with pytest.raises(GoalAborted) as caught:
                    await goal.result()
                assert caught.value.goal_id == goal.goal_id
                assert caught.value.result == Result([1])


@pytest.mark.promise("CANCEL-10")
async def test_a_result_that_was_yielded_before_the_cancel_is_not_lost(reach: Reach) -> None:
    yielded = anyio.Event()

    async def lingers(goal: GoalHandle[Goal]) -> Items:
        yield Result([1])
        yielded.set()
        await anyio.sleep_forever()

    async with reach(ActionServer(FIBONACCI, lingers)) as client:
        goal = await client.send_goal(Goal(1))
        await yielded.wait()
        await goal.cancel()
        assert await goal.outcome() == End(GoalStatus.CANCELED, Result([1]))


@pytest.mark.promise("CANCEL-8", "CANCEL-9")
async def test_a_cooperative_executor_is_not_interrupted_but_asked(
    reach: Reach, form: Form
) -> None:
    begun, looked = anyio.Event(), anyio.Event()

    async def looks(goal: GoalHandle[Goal]) -> Items:
        begun.set()
        await looked.wait()
        if goal.cancel_requested:
            raise GoalCanceled(result=Result([1]))
        yield Result([2])

    server = ActionServer(FIBONACCI, form(looks), interrupt_on_cancel=False)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1))
        await begun.wait()
        assert (await goal.cancel()).accepted
        looked.set()
        assert await goal.outcome() == End(GoalStatus.CANCELED, Result([1]))


@pytest.mark.promise("CANCEL-1", "RESULT-2")
async def test_a_goal_can_be_canceled_by_a_client_that_did_not_send_it(reach: Reach) -> None:
    with anyio.fail_after(reach.patience):
        async with (
            serve(ActionServer(FIBONACCI, Steps()), reach.address()) as (url,),
            connect(url, FIBONACCI) as sender,
            connect(url, FIBONACCI) as other,
        ):
            await sender.wait_for_server()
            goal = await sender.send_goal(Goal(1))
            await other.wait_for_server()
            assert (await (await other.attach(goal.goal_id)).cancel()).accepted
            assert (await goal.outcome()).status is GoalStatus.CANCELED
            again = await other.attach(goal.goal_id)
            assert await again.outcome() == await goal.outcome()


@pytest.mark.promise("CANCEL-21")
async def test_a_goal_that_is_still_decided_upon_is_canceled_by_its_id_once_it_is_accepted(
    reach: Reach,
) -> None:
    on_goal = Undecided()
    async with reach(ActionServer(FIBONACCI, Steps(), on_goal=on_goal)) as client:
        goal_id = GoalID.random()
        outcomes: list[Outcome[Result]] = []
        codes: list[CancelCode] = []

        async def send() -> None:
            goal = await client.send_goal(Goal(1), goal_id=goal_id)
            outcomes.append(await goal.outcome())

        async def cancel() -> None:
            codes.append((await client.cancel_goals(goal_id)).return_code)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(send)
            await on_goal.asked.wait()
            tasks.start_soon(cancel)
            await anyio.wait_all_tasks_blocked()
            assert (codes, outcomes) == ([], [])
            on_goal.decide.set()
    assert codes == [CancelCode.NONE]
    assert outcomes == [End(GoalStatus.CANCELED)]


@pytest.mark.promise("CANCEL-3", "CANCEL-16")
@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
async def test_a_rejected_cancel_leaves_the_goal_running(reach: Reach, asynchronous: bool) -> None:
    executor = Steps()

    def refuse(goal: GoalHandle[Goal]) -> None:
        raise CancelRejected(f"order {goal.request.order} is almost done")

    async def refuse_later(goal: GoalHandle[Goal]) -> None:
        await anyio.lowlevel.checkpoint()
        refuse(goal)

    server = ActionServer(FIBONACCI, executor, on_cancel=refuse_later if asynchronous else refuse)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(9))
        answer = await goal.cancel()
        assert answer.return_code is CancelCode.REJECTED
        assert answer.goals_canceling == ()
        assert answer.reason == "order 9 is almost done"
        assert goal.status.is_active
        executor.go.set()
        assert await goal.result() == Result([9])


@pytest.mark.promise("CANCEL-4")
@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (KeyError("x"), "on_cancel failed: KeyError: 'x'"),
        (
            False,
            (
                "on_cancel failed: TypeError: on_cancel returned False:"
                " return None to accept, raise CancelRejected(reason) to reject"
            ),
        ),
    ],
)
async def test_a_cancel_callback_that_fails_rejects(
    reach: Reach, answer: object, reason: str
) -> None:
    def on_cancel(goal: GoalHandle[Goal]) -> None:
        if isinstance(answer, Exception):
            raise answer
        return cast("None", answer)

    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor, on_cancel=on_cancel)) as client:
        goal = await client.send_goal(Goal(9))
        refused = await goal.cancel()
        assert (refused.return_code, refused.reason) == (CancelCode.REJECTED, reason)
        executor.go.set()
        await goal.result()


@pytest.mark.promise("CANCEL-4", "CANCEL-16")
async def test_a_cancel_callback_that_fails_leaves_its_traceback_in_the_log(
    reach: Reach, caplog: pytest.LogCaptureFixture
) -> None:
    def on_cancel(goal: GoalHandle[Goal]) -> None:
        raise KeyError("unlucky")

    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor, on_cancel=on_cancel)) as client:
        goal = await client.send_goal(Goal(9))
        assert (await goal.cancel()).return_code is CancelCode.REJECTED
        executor.go.set()
        assert await goal.result() == Result([9])
    assert "Traceback" in caplog.text
    assert 'raise KeyError("unlucky")' in caplog.text


@pytest.mark.promise("CANCEL-16", "CANCEL-19")
async def test_canceling_twice_is_as_good_as_once(reach: Reach) -> None:
    asked: list[GoalHandle[Goal]] = []

    async def slow_to_stop(goal: GoalHandle[Goal]) -> Items:
        try:
            yield Feedback([1])
            await anyio.sleep_forever()
        finally:
            await stop.wait()

    stop = anyio.Event()
    server = ActionServer(FIBONACCI, slow_to_stop, on_cancel=asked.append)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1))
        async for _ in goal.feedback:
            break
        first, second = await goal.cancel(), await goal.cancel()
        assert first == second
        assert first.accepted
        assert len(asked) == 1
        stop.set()
        assert (await goal.outcome()).status is GoalStatus.CANCELED
        assert (await goal.cancel()).return_code is CancelCode.GOAL_TERMINATED


@pytest.mark.promise("ACCEPT-9", "CANCEL-14", "CANCEL-16")
async def test_the_cancel_rules_of_ros_choose_by_id_by_time_and_all(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, Steps())) as client:
        goals = [await client.send_goal(Goal(number)) for number in range(6)]
        stamps = [goal.stamp for goal in goals]
        assert stamps == sorted(set(stamps))

        by_time = await client.cancel_goals(before=stamps[1])
        assert [info.goal_id for info in by_time.goals_canceling] == [
            goal.goal_id for goal in goals[:2]
        ]
        assert by_time.return_code is CancelCode.NONE
        for goal in goals[:2]:
            assert (await goal.outcome()).status is GoalStatus.CANCELED

        both = await client.cancel_goals(goals[5].goal_id, before=stamps[2])
        assert {info.goal_id for info in both.goals_canceling} == {
            goals[2].goal_id,
            goals[5].goal_id,
        }
        for goal in (goals[2], goals[5]):
            assert (await goal.outcome()).status is GoalStatus.CANCELED

        unknown = await client.cancel_goals(GoalID.random(), before=stamps[2])
        assert (unknown.return_code, unknown.goals_canceling) == (CancelCode.NONE, ())

        everything = await client.cancel_goals()
        assert {info.goal_id for info in everything.goals_canceling} == {
            goals[3].goal_id,
            goals[4].goal_id,
        }
        for goal in goals[3:5]:
            assert (await goal.outcome()).status is GoalStatus.CANCELED

        nothing = await client.cancel_goals()
        assert (nothing.return_code, nothing.goals_canceling) == (CancelCode.NONE, ())


@pytest.mark.promise("CANCEL-16", "CANCEL-17")
async def test_cancel_all_tells_the_truth_when_some_reject(reach: Reach) -> None:
    def on_cancel(goal: GoalHandle[Goal]) -> None:
        if goal.request.order % 2:
            raise CancelRejected("odd goals stay")

    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor, on_cancel=on_cancel)) as client:
        goals = [await client.send_goal(Goal(number)) for number in range(6)]
        answer = await client.cancel_goals()
        assert answer.return_code is CancelCode.NONE
        assert [info.goal_id for info in answer.goals_canceling] == [
            goal.goal_id for goal in goals[::2]
        ]
        assert answer.reason == "odd goals stay"
        executor.go.set()
        statuses = [(await goal.outcome()).status for goal in goals]
    assert statuses == [GoalStatus.CANCELED, GoalStatus.SUCCEEDED] * 3


@pytest.mark.promise("CANCEL-18")
async def test_one_slow_cancel_decision_keeps_no_other_goal_going(reach: Reach) -> None:
    decide = anyio.Event()

    async def on_cancel(goal: GoalHandle[Goal]) -> None:
        if goal.request.order == 0:
            await decide.wait()

    async with reach(ActionServer(FIBONACCI, Steps(), on_cancel=on_cancel)) as client:
        goals = [await client.send_goal(Goal(number)) for number in range(3)]
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(client.cancel_goals)
            for goal in goals[1:]:
                assert (await goal.outcome()).status is GoalStatus.CANCELED
            assert goals[0].status is not GoalStatus.CANCELED
            decide.set()
        assert (await goals[0].outcome()).status is GoalStatus.CANCELED


@pytest.mark.promise("CANCEL-15", "CANCEL-17")
async def test_a_goal_that_is_accepted_after_the_request_is_not_canceled_by_it(
    reach: Reach,
) -> None:
    on_cancel = Undecided()
    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor, on_cancel=on_cancel)) as client:
        before = await client.send_goal(Goal(1))
        answers: list[CancelAnswer] = []

        async def cancel() -> None:
            answers.append(await client.cancel_goals())

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(cancel)
            await on_cancel.asked.wait()
            after = await client.send_goal(Goal(2))
            on_cancel.decide.set()
        assert (await before.outcome()).status is GoalStatus.CANCELED
        executor.go.set()
        assert await after.result() == Result([2])
    assert [info.goal_id for info in answers[0].goals_canceling] == [before.goal_id]


@pytest.mark.promise("CANCEL-20")
async def test_a_goal_that_ends_while_its_cancel_is_decided_has_ended(reach: Reach) -> None:
    on_cancel = Undecided()
    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor, on_cancel=on_cancel)) as client:
        goal = await client.send_goal(Goal(4))
        codes: list[CancelCode] = []

        async def cancel() -> None:
            codes.append((await goal.cancel()).return_code)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(cancel)
            await on_cancel.asked.wait()
            executor.go.set()
            assert await goal.result() == Result([4])
            on_cancel.decide.set()
    assert codes == [CancelCode.GOAL_TERMINATED]


@pytest.mark.promise("CANCEL-22")
async def test_leaving_the_block_early_cancels_the_goal(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, Steps())) as client:
        async with client.send_goal(Goal(1)) as goal:
            async for _ in goal.feedback:
                break
        assert (await goal.outcome()).status is GoalStatus.CANCELED

        with anyio.CancelScope() as scope:
            async with client.send_goal(Goal(1)) as second:
                scope.cancel()
                await second.result()
        assert scope.cancelled_caught
        assert (await second.outcome()).status is GoalStatus.CANCELED

        with await client.endpoint.status() as statuses:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(client.call, Goal(1))
                await next_with(statuses, GoalStatus.EXECUTING)
                tasks.cancel_scope.cancel()
            await next_with(statuses, GoalStatus.CANCELING)


@pytest.mark.promise("ERROR-3")
async def test_the_callers_own_exception_arrives_as_itself(reach: Reach) -> None:
    error = KeyError("mine")
    with pytest.raises(KeyError) as caught:
        async with reach(ActionServer(FIBONACCI, Steps())) as client:
            async with client.send_goal(Goal(1)) as goal:
                async for _ in goal.feedback:
                    raise error
    assert caught.value is error


@pytest.mark.promise("CANCEL-22")
async def test_leaving_the_block_of_a_goal_whose_cancel_is_rejected_is_logged(
    reach: Reach, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(goal: GoalHandle[Goal]) -> None:
        raise CancelRejected("too late")

    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor, on_cancel=refuse)) as client:
        async with client.send_goal(Goal(1)) as goal:
            pass
        assert "was left, but runs on: too late" in caplog.text
        executor.go.set()
        assert await goal.result() == Result([1])
