"""Design, section 4, "Results" and "Stopping", and the status of all goals."""

from __future__ import annotations

import math

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
    GoalStatus,
    Outcome,
    ServerNotFound,
    TransportError,
    UnknownGoal,
    connect,
    serve,
)
from fibaction.border.abc import StatusStream
from fibaction.testing.contract.executors import (
    FIBONACCI,
    Feedback,
    Form,
    Goal,
    Items,
    Result,
    Steps,
    fibonacci,
    next_with,
)
from fibaction.testing.contract.matching import End
from fibaction.testing.contract.reach import Reach, running

pytestmark = pytest.mark.anyio


@pytest.mark.promise("RESULT-2")
async def test_a_result_can_be_fetched_by_any_client_any_number_of_times(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, fibonacci)) as client:
        goal = await client.send_goal(Goal(2))
        assert await goal.result() == await goal.result() == Result([0, 1, 1])
        for _ in range(3):
            other = await client.attach(goal.goal_id)
            assert await other.result() == Result([0, 1, 1])
            assert [item async for item in other.feedback] == []
            raw = await client.endpoint.get_result(goal.goal_id)
            assert raw.status is GoalStatus.SUCCEEDED


@pytest.mark.promise("STATUS-10")
async def test_a_list_of_goals_tells_their_begins_and_ends_and_the_reasons(reach: Reach) -> None:
    async def failing(goal: GoalHandle[Goal]) -> Items:
        yield Feedback([goal.request.order])
        if goal.request.order > 1:
            raise GoalAborted("too far " * 50)
        await anyio.sleep_forever()

    async with reach(ActionServer(FIBONACCI, failing)) as client:
        aborted = await client.send_goal(Goal(2))
        await aborted.outcome()
        async with client.send_goal(Goal(1)) as active:
            await anext(aiter(active.feedback))
            ended, running = await client.goals()
    assert ended.began_at is not None
    assert ended.ended_at is not None
    assert ended.stamp <= ended.began_at <= ended.ended_at <= running.stamp
    assert (ended.reason[:8], len(ended.reason)) == ("too far ", 200)
    assert running.began_at is not None
    assert running.stamp <= running.began_at
    assert (running.ended_at, running.reason) == (None, "")


@pytest.mark.promise("RESULT-2")
async def test_a_list_of_goals_has_their_results_if_they_are_asked_for(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, fibonacci)) as client:
        for order in (1, 2):
            await client.call(Goal(order))
        assert [info.result for info in await client.goals()] == [None, None]
        infos = await client.goals(results=True)
        assert [info.result for info in infos] == [Result([0, 1]), Result([0, 1, 1])]


@pytest.mark.promise("STATUS-5", "STATUS-8", "RESULT-3", "RESULT-8")
async def test_a_result_is_forgotten_when_its_time_is_over(reach: Reach) -> None:
    server = ActionServer(FIBONACCI, fibonacci, result_timeout=0.05)
    async with reach(server) as client:
        with await client.endpoint.status() as statuses:
            goal = await client.send_goal(Goal(2))
            await next_with(statuses, GoalStatus.SUCCEEDED)
            assert (await next_with(statuses, GoalStatus.UNKNOWN)).goal_id == goal.goal_id
        with pytest.raises(UnknownGoal):
            await client.attach(goal.goal_id)
        # Its own client still gets it: it has been waiting since the goal was accepted.
        assert await goal.result() == Result([0, 1, 1])


@pytest.mark.promise("RESULT-5", "RESULT-8")
async def test_without_a_result_timeout_the_waiting_clients_are_answered_all_the_same(
    reach: Reach,
) -> None:
    steps = Steps()
    async with reach(ActionServer(FIBONACCI, steps, result_timeout=0)) as client:
        goal = await client.send_goal(Goal(5))
        follower = await client.attach(goal.goal_id)
        results: list[Result] = []

        async def wait() -> None:
            results.append(await follower.result())

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            await anyio.wait_all_tasks_blocked()
            steps.go.set()
        assert results == [await goal.result()] == [Result([5])]
        with pytest.raises(UnknownGoal):
            await client.attach(goal.goal_id)


@pytest.mark.promise("RESULT-6")
async def test_a_result_is_kept_for_ever_if_asked_to(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, fibonacci, result_timeout=math.inf)) as client:
        goals = [await client.send_goal(Goal(number)) for number in range(3)]
        for goal in goals:
            await goal.outcome()
        for number, goal in enumerate(goals):
            assert len((await (await client.attach(goal.goal_id)).result()).sequence) == number + 1


@pytest.mark.promise("RESULT-7")
async def test_no_more_results_are_kept_than_asked_for(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, fibonacci, max_results=3)) as client:
        goals = []
        for number in range(5):
            goals.append(await client.send_goal(Goal(number)))
            await goals[-1].outcome()
        for goal in goals[:2]:
            with pytest.raises(UnknownGoal):
                await client.attach(goal.goal_id)
        for goal in goals[2:]:
            assert (await (await client.attach(goal.goal_id)).outcome()).status is (
                GoalStatus.SUCCEEDED
            )


@pytest.mark.promise("GOAL-4", "RESULT-8")
async def test_an_attached_client_of_a_goal_that_is_forgotten_meanwhile_is_told(
    reach: Reach,
) -> None:
    steps = Steps()
    async with reach(ActionServer(FIBONACCI, steps, result_timeout=0)) as client:
        goal = await client.send_goal(Goal(5))
        follower = await client.attach(goal.goal_id)
        with await client.endpoint.status() as statuses:
            steps.go.set()
            await next_with(statuses, GoalStatus.UNKNOWN)
        # Over ROS the result may come behind that, and whoever attaches until then has it, too.
        for told in (goal, follower):
            assert await told.outcome() == End(GoalStatus.SUCCEEDED, Result([5]))
        with pytest.raises(UnknownGoal):
            await client.attach(goal.goal_id)


@pytest.mark.promise("STATUS-3", "STATUS-7")
async def test_every_change_of_a_status_is_told_in_order_along_legal_edges(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, Steps())) as client:
        before = await client.send_goal(Goal(1))
        with await client.endpoint.status() as statuses:
            first = await statuses.receive()
            assert first is not None
            assert first.goal_id == before.goal_id
            assert first.stamp == before.stamp
            goal = await client.send_goal(Goal(2))
            seen = [await next_of(statuses, goal.goal_id) for _ in range(2)]
            await goal.cancel()
            seen += [await next_of(statuses, goal.goal_id) for _ in range(2)]
            assert statuses.dropped == 0
    assert seen == [
        GoalStatus.ACCEPTED,
        GoalStatus.EXECUTING,
        GoalStatus.CANCELING,
        GoalStatus.CANCELED,
    ]


@pytest.mark.promise("STATUS-7")
async def test_followers_of_the_statuses_come_and_go_by_themselves(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, Steps())) as client:
        with await client.endpoint.status() as first:
            goal = await client.send_goal(Goal(1))
            with await client.endpoint.status() as second:
                await next_of(second, goal.goal_id)
            with await client.endpoint.status() as third:
                assert [info.goal_id for info in await client.goals()] == [goal.goal_id]
                await goal.cancel()
                for statuses in (first, third):
                    while await next_of(statuses, goal.goal_id) is not GoalStatus.CANCELED:
                        pass


async def next_of(statuses: StatusStream, goal_id: bytes) -> GoalStatus:
    while (info := await statuses.receive()) is not None:
        if info.goal_id == goal_id:
            return info.status
    raise AssertionError("the statuses have ended")


@pytest.mark.promise(
    "GOAL-3", "GOAL-4", "STATUS-4", "STOP-1", "STOP-2", "STOP-3", "STOP-7", "STOP-8", "STOP-9"
)
async def test_stopping_ends_every_goal_as_aborted_and_answers_every_client(reach: Reach) -> None:
    outcomes: list[Outcome[Result]] = []
    rejected: list[str] = []
    under_way: list[int] = []
    all_under_way, never = anyio.Event(), anyio.Event()

    def is_under_way(goal: Goal) -> None:
        under_way.append(goal.order)
        if len(under_way) == 3:
            all_under_way.set()

    async def on_goal(goal: Goal) -> None:
        if goal.order == 99:
            is_under_way(goal)
            await never.wait()

    async def partial(goal: GoalHandle[Goal]) -> Items:
        yield Feedback([1])
        is_under_way(goal.request)
        try:
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            assert goal.cancel_requested
            await anyio.lowlevel.checkpoint()
            raise GoalCanceled(result=Result([1])) from None
        yield Result([])

    async def wait(client: ActionClient[Goal, Feedback, Result], order: int) -> None:
        try:
            goal = await client.send_goal(Goal(order))
        except GoalRejected as exc:
            rejected.append(exc.reason)
        else:
            feedback = [item async for item in goal.feedback]
            assert feedback == [Feedback([1])]
            outcomes.append(await goal.outcome())

    with anyio.fail_after(reach.patience):
        server = ActionServer(FIBONACCI, partial, on_goal=on_goal)
        async with anyio.create_task_group() as tasks, reach(server) as client:
            await client.cancel_goals()  # some clients connect with their first request
            before = running()
            for order in (1, 2, 99):
                tasks.start_soon(wait, client, order)
            await all_under_way.wait()
            tasks_of_this_test = running() - before
            await server.stop()
            with anyio.fail_after(30):
                while running() & tasks_of_this_test:
                    await anyio.lowlevel.checkpoint()
            with pytest.raises(TransportError):
                await client.send_goal(Goal(3))
    assert outcomes == [End(GoalStatus.ABORTED, Result([1]), "server stopped")] * 2
    assert rejected == ["the server is stopping"]


@pytest.mark.promise("STOP-1", "STOP-2")
async def test_a_goal_that_is_sent_while_the_server_stops_is_rejected(reach: Reach) -> None:
    stopping, go = anyio.Event(), anyio.Event()

    async def tidies_up(goal: GoalHandle[Goal]) -> Items:
        try:
            yield Feedback([1])
            await anyio.sleep_forever()
        finally:
            stopping.set()
            await go.wait()

    server = ActionServer(FIBONACCI, tidies_up)
    async with reach(server) as client, anyio.create_task_group() as tasks:
        goal = await client.send_goal(Goal(1))
        await anext(goal.feedback)
        tasks.start_soon(server.stop)
        await stopping.wait()
        with pytest.raises(GoalRejected, match="the server is stopping"):
            await client.send_goal(Goal(2))
        go.set()
        with pytest.raises(GoalAborted, match="server stopped"):
            await goal.result()


@pytest.mark.promise("STOP-6")
async def test_an_executor_that_does_not_stop_in_time_is_killed(
    reach: Reach, form: Form, caplog: pytest.LogCaptureFixture
) -> None:
    killed = []

    async def hangs(goal: GoalHandle[Goal]) -> Items:
        try:
            yield Feedback([1])
            await anyio.sleep_forever()
        finally:
            try:
                await anyio.sleep_forever()
            finally:
                killed.append(goal.request.order)

    server = ActionServer(FIBONACCI, form(hangs), shutdown_timeout=0.01)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1))
        await anext(goal.feedback)
        await server.stop()
        with anyio.fail_after(30):
            while not killed:
                await anyio.lowlevel.checkpoint()
        assert await goal.outcome() == End(GoalStatus.ABORTED, None, "server stopped")
    assert killed == [1]
    assert "did not stop in time (0.01 s)" in caplog.text


@pytest.mark.promise("GOAL-3", "STATUS-4", "STOP-6")
async def test_a_result_that_comes_after_the_time_to_stop_changes_nothing(
    reach: Reach, form: Form
) -> None:
    killed = anyio.Event()

    async def too_late(goal: GoalHandle[Goal]) -> Items:
        try:
            yield Feedback([1])
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            try:
                await anyio.sleep_forever()
            except anyio.get_cancelled_exc_class():
                killed.set()
        yield Result([1])

    server = ActionServer(FIBONACCI, form(too_late), shutdown_timeout=0.01)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1))
        await anext(goal.feedback)
        await server.stop()
        with anyio.fail_after(30):
            await killed.wait()
        with pytest.raises(GoalAborted) as caught:
            await goal.result()
        assert caught.value.result is None


async def catches_every_cancellation() -> None:
    while True:
        try:
            await anyio.sleep(1)
        except BaseException:
            continue


async def is_shielded() -> None:
    with anyio.CancelScope(shield=True):
        await anyio.sleep_forever()


@pytest.mark.promise("STOP-6", "STOP-7", "STOP-11")
async def test_a_server_closes_without_executors_that_do_not_end_and_names_their_goals(
    reach: Reach, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction.server.execution.task_pool.GRACE", 0.05)

    # A stop that arrives at a `yield` ends the executor before it can refuse.
    refusing = [anyio.Event(), anyio.Event()]

    async def refuses(goal: GoalHandle[Goal]) -> Items:
        refusing[goal.request.order].set()
        await (is_shielded() if goal.request.order else catches_every_cancellation())
        yield Result([])

    server = ActionServer(FIBONACCI, refuses, shutdown_timeout=0.01)
    async with reach(server) as client:
        goals = [await client.send_goal(Goal(order)) for order in (0, 1)]
        for begun in refusing:
            await begun.wait()
        await server.stop()
        for goal in goals:
            assert (await goal.outcome()).status is GoalStatus.ABORTED
    for goal in goals:
        assert any(str(goal.goal_id) in text and "is abandoned" in text for text in caplog.messages)


@pytest.mark.promise("STOP-8")
async def test_a_server_that_has_stopped_is_not_found(reach: Reach) -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1))
        await goal.result()
        await server.stop()
        for call in (
            lambda: client.send_goal(Goal(2)),
            lambda: client.attach(goal.goal_id),
            goal.cancel,
            client.goals,
        ):
            with pytest.raises(ServerNotFound):
                await call()


@pytest.mark.promise("STOP-2", "STOP-4", "STOP-7")
async def test_a_success_that_comes_while_the_server_stops_is_a_success(
    reach: Reach, form: Form
) -> None:
    async def finishes(goal: GoalHandle[Goal]) -> Items:
        try:
            yield Feedback([1])
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            await anyio.lowlevel.checkpoint()
        yield Result([2])

    server = ActionServer(FIBONACCI, form(finishes))
    async with reach(server) as client:
        goal = await client.send_goal(Goal(1))
        await anext(goal.feedback)
        await server.stop()
        assert await goal.outcome() == End(GoalStatus.SUCCEEDED, Result([2]))


@pytest.mark.promise("STOP-1", "STOP-5", "STOP-7")
async def test_a_goal_that_is_canceling_when_the_server_stops_is_canceled(
    reach: Reach, form: Form
) -> None:
    tidying, go = anyio.Event(), anyio.Event()

    async def tidies_up(goal: GoalHandle[Goal]) -> Items:
        try:
            yield Feedback([1])
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            tidying.set()
            await go.wait()
            raise GoalCanceled(result=Result([1])) from None
        yield Result([])

    server = ActionServer(FIBONACCI, form(tidies_up))
    async with reach(server) as client, anyio.create_task_group() as tasks:
        goal = await client.send_goal(Goal(1))
        await anext(goal.feedback)
        assert (await goal.cancel()).accepted
        await tidying.wait()
        tasks.start_soon(server.stop)
        await anyio.wait_all_tasks_blocked()
        with pytest.raises(GoalRejected):
            await client.send_goal(Goal(2))
        go.set()
        assert await goal.outcome() == End(GoalStatus.CANCELED, Result([1]))


@pytest.mark.promise("REACH-2")
async def test_a_client_can_come_before_its_server_and_wait_for_it(reach: Reach) -> None:
    address = reach.address()
    with anyio.fail_after(reach.patience):
        async with connect(address, FIBONACCI) as client, anyio.create_task_group() as tasks:
            results: list[Result] = []

            async def wait() -> None:
                await client.wait_for_server()
                results.append(await client.call(Goal(1)))
                tasks.cancel_scope.cancel()

            tasks.start_soon(wait)
            await anyio.wait_all_tasks_blocked()
            assert results == []
            async with serve(ActionServer(FIBONACCI, fibonacci), address):
                await anyio.sleep_forever()
    assert results == [Result([0, 1])]
