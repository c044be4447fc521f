"""Design, section 4, "Accepting"."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any, cast

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionServer,
    CancelCode,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    RejectionCode,
    ServerNotFound,
    UnknownGoal,
    connect,
    serve,
)
from fibaction.testing.contract.executors import (
    FIBONACCI,
    Feedback,
    Goal,
    Result,
    Steps,
    Undecided,
    fibonacci,
)
from fibaction.testing.contract.matching import End
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio


def server(**options: Any) -> ActionServer[Goal, Feedback, Result]:
    return ActionServer(FIBONACCI, fibonacci, **options)


@pytest.mark.promise("GOAL-2", "ACCEPT-1", "EXECUTE-2", "FEEDBACK-1")
async def test_a_goal_is_accepted_streams_its_feedback_and_ends_with_its_result(
    reach: Reach,
) -> None:
    async with reach(server()) as client, client.send_goal(Goal(5)) as goal:
        feedback = [item.partial_sequence async for item in goal.feedback]
        result = await goal.result()
    assert feedback == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3], [0, 1, 1, 2, 3, 5]]
    assert result == Result([0, 1, 1, 2, 3, 5])
    assert goal.status is GoalStatus.SUCCEEDED
    assert goal.feedback_dropped == 0


@pytest.mark.promise("GOAL-2", "EXECUTE-2")
async def test_a_call_gives_the_result_and_hands_every_feedback_to_the_callback(
    reach: Reach,
) -> None:
    seen: list[Feedback] = []

    async def later(feedback: Feedback) -> None:
        await anyio.lowlevel.checkpoint()
        seen.append(feedback)

    async with reach(server()) as client:
        assert await client.call(Goal(3)) == Result([0, 1, 1, 2])
        assert await client.call(Goal(3), on_feedback=seen.append) == Result([0, 1, 1, 2])
        assert await client.call(Goal(3), on_feedback=later) == Result([0, 1, 1, 2])
    assert [len(item.partial_sequence) for item in seen] == [3, 4, 3, 4]


@pytest.mark.promise("ACCEPT-2", "ERROR-2")
@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
async def test_on_goal_sees_the_goal_and_its_reason_reaches_the_client(
    reach: Reach, asynchronous: bool
) -> None:
    seen: list[Goal] = []

    def decide(goal: Goal) -> None:
        seen.append(goal)
        if goal.order > 10:
            raise GoalRejected(f"order {goal.order} is too much")

    async def decide_later(goal: Goal) -> None:
        await anyio.lowlevel.checkpoint()
        decide(goal)

    async with reach(server(on_goal=decide_later if asynchronous else decide)) as client:
        await client.call(Goal(3))
        with pytest.raises(GoalRejected) as caught:
            await client.send_goal(Goal(11))
    assert seen == [Goal(3), Goal(11)]
    assert caught.value.reason == "order 11 is too much"
    assert str(caught.value) == f"goal {caught.value.goal_id} was rejected: order 11 is too much"


@pytest.mark.promise("ACCEPT-3")
@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        ({"order": "ten"}, 'goal.order must be a whole number, not "ten"'),
        ({"order": 1.0}, "goal.order: Expected `int`, got `float`"),
        ({}, "goal.order is missing"),
        ("10", 'goal must be a map of fields, not "10"'),
    ],
)
async def test_a_goal_of_the_wrong_type_is_rejected_and_the_reason_names_the_field(
    reach: Reach, goal: object, reason: str
) -> None:
    async with reach(server()) as client:
        with pytest.raises(GoalRejected) as caught:
            await client.send_goal(cast("Goal", goal))
        assert caught.value.reason == reason
        assert await client.call(Goal(2)) == Result([0, 1, 1])


@pytest.mark.promise("ACCEPT-3")
async def test_bytes_that_are_no_goal_are_rejected(reach: Reach) -> None:
    async with reach(server()) as client:
        for payload in (b"", b"\xc1", b"\x91" * 10_000, b"\xa1\xff", b"\x81\xa5order\x01\x02"):
            with pytest.raises(GoalRejected):
                await client.endpoint.send_goal(GoalID.random(), payload)
        assert await client.call(Goal(2)) == Result([0, 1, 1])


@pytest.mark.promise("ACCEPT-4")
@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
async def test_a_callback_that_fails_rejects_the_goal_and_the_server_goes_on(
    reach: Reach, asynchronous: bool, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(goal: Goal) -> None:
        if goal.order == 13:
            raise KeyError("unlucky")

    async def fail_later(goal: Goal) -> None:
        fail(goal)

    async with reach(server(on_goal=fail_later if asynchronous else fail)) as client:
        with pytest.raises(GoalRejected) as caught:
            await client.send_goal(Goal(13))
        assert caught.value.reason == "on_goal failed: KeyError: 'unlucky'"
        assert await client.call(Goal(2)) == Result([0, 1, 1])
    assert "Traceback" in caplog.text


@pytest.mark.promise("ACCEPT-4")
async def test_a_callback_that_returns_something_rejects_the_goal(reach: Reach) -> None:
    def decide(goal: Goal) -> None:
        return cast("None", goal.order < 5)  # as rclpy's users may write it

    async with reach(server(on_goal=decide)) as client:
        with pytest.raises(GoalRejected) as caught:
            await client.send_goal(Goal(3))
    assert caught.value.reason == (
        "on_goal failed: TypeError: on_goal returned True:"
        " return None to accept, raise GoalRejected(reason) to reject"
    )


@pytest.mark.promise("ACCEPT-5")
async def test_a_slow_decision_delays_no_other_goal(reach: Reach) -> None:
    decide = anyio.Event()

    async def on_goal(goal: Goal) -> None:
        if goal.order == 9:
            await decide.wait()

    async with reach(server(on_goal=on_goal)) as client, anyio.create_task_group() as tasks:
        outcomes: list[Result] = []

        async def send_the_slow_one() -> None:
            outcomes.append(await client.call(Goal(9)))

        tasks.start_soon(send_the_slow_one)
        await anyio.wait_all_tasks_blocked()
        assert await client.call(Goal(2)) == Result([0, 1, 1])
        assert outcomes == []
        decide.set()
    assert len(outcomes) == 1


@pytest.mark.promise("GOAL-1", "ACCEPT-6")
async def test_the_same_goal_sent_again_gets_the_same_answer_and_runs_once(reach: Reach) -> None:
    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor)) as client:
        goal_id = GoalID.random()
        first = await client.send_goal(Goal(2), goal_id=goal_id)
        again = await client.send_goal(Goal(2), goal_id=goal_id)
        executor.go.set()
        assert await first.result() == await again.result() == Result([2])
        assert first.stamp == again.stamp
        assert [item async for item in again.feedback] == [Feedback([1]), Feedback([2])]
        late = await client.send_goal(Goal(2), goal_id=goal_id)
        assert await late.result() == Result([2])
    assert executor.runs.total() == 1


@pytest.mark.promise("GOAL-1", "ACCEPT-6")
async def test_the_same_goal_sent_again_while_it_is_decided_waits_for_that(reach: Reach) -> None:
    executor = Steps(go=True)
    asked = 0
    decide = anyio.Event()

    async def on_goal(goal: Goal) -> None:
        nonlocal asked
        asked += 1
        await decide.wait()

    async with reach(ActionServer(FIBONACCI, executor, on_goal=on_goal)) as client:
        goal_id = GoalID.random()
        heard: list[tuple[list[Feedback], Result]] = []

        async def send() -> None:
            sent = await client.send_goal(Goal(2), goal_id=goal_id)
            heard.append(([item async for item in sent.feedback], await sent.result()))

        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(send)
            await anyio.wait_all_tasks_blocked()
            decide.set()
    assert heard == [([Feedback([1]), Feedback([2])], Result([2]))] * 3
    assert (asked, executor.runs.total()) == (1, 1)


@pytest.mark.promise("ACCEPT-6")
async def test_a_rejected_goal_sent_again_is_rejected_again_without_a_second_decision(
    reach: Reach,
) -> None:
    answers = iter([GoalRejected("busy")])

    def on_goal(goal: Goal) -> None:
        raise next(answers)

    async with reach(server(on_goal=on_goal)) as client:
        goal_id = GoalID.random()
        for _ in range(2):
            with pytest.raises(GoalRejected) as caught:
                await client.send_goal(Goal(7), goal_id=goal_id)
            assert caught.value.reason == "busy"


@pytest.mark.promise("ACCEPT-8", "RESULT-5")
async def test_an_id_is_free_again_when_its_goal_is_forgotten(reach: Reach) -> None:
    executor = Steps(go=True)
    async with reach(ActionServer(FIBONACCI, executor, result_timeout=0)) as client:
        goal_id = GoalID.random()
        for order in (7, 8):
            goal = await client.send_goal(Goal(order), goal_id=goal_id)
            assert await goal.result() == Result([order])
            assert (await client.endpoint.get_result(goal_id)).status is GoalStatus.UNKNOWN
    assert executor.runs.total() == 2


@pytest.mark.promise("STATUS-6")
async def test_a_rejected_goal_has_no_status_and_never_runs(reach: Reach) -> None:
    executor = Steps()

    def on_goal(goal: Goal) -> None:
        raise GoalRejected("busy")

    async with reach(ActionServer(FIBONACCI, executor, on_goal=on_goal)) as client:
        goal_id = GoalID.random()
        with await client.endpoint.status() as statuses:
            with pytest.raises(GoalRejected):
                await client.send_goal(Goal(7), goal_id=goal_id)
            assert await client.goals() == []
            assert (await client.endpoint.get_result(goal_id)).status is GoalStatus.UNKNOWN
            assert statuses.known == 0
            with anyio.move_on_after(0.01) as patience:
                await statuses.receive()
    assert patience.cancelled_caught
    assert executor.runs.total() == 0


@pytest.mark.promise("ACCEPT-7")
async def test_another_goal_under_an_id_in_use_is_rejected(reach: Reach) -> None:
    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor)) as client:
        goal_id = GoalID.random()
        first = await client.send_goal(Goal(7), goal_id=goal_id)
        with pytest.raises(GoalRejected, match="its ID is in use by another goal"):
            await client.send_goal(Goal(8), goal_id=goal_id)
        executor.go.set()
        assert await first.result() == Result([7])
        with pytest.raises(GoalRejected, match="its ID is in use by another goal"):
            await client.send_goal(Goal(8), goal_id=goal_id)


@pytest.mark.promise("ACCEPT-12")
async def test_an_id_of_zeros_names_no_goal_and_is_rejected(reach: Reach) -> None:
    executor = Steps()
    async with reach(ActionServer(FIBONACCI, executor)) as client:
        with pytest.raises(GoalRejected):
            await client.send_goal(Goal(7), goal_id=GoalID(bytes(16)))
        executor.go.set()
        goal_id = GoalID(bytes(range(16)))
        goal = await client.send_goal(Goal(8), goal_id=goal_id)
        assert goal.goal_id == goal_id
        assert await goal.result() == Result([8])
    assert executor.runs.total() == 1


@pytest.mark.promise("ACCEPT-10")
async def test_a_client_that_gives_up_before_the_answer_leaves_no_goal_behind(
    reach: Reach,
) -> None:
    executor, on_goal = Steps(), Undecided()
    async with reach(ActionServer(FIBONACCI, executor, on_goal=on_goal)) as client:
        goal_id = GoalID.random()
        async with anyio.create_task_group() as tasks:

            async def send() -> None:
                await client.send_goal(Goal(1), goal_id=goal_id)

            tasks.start_soon(send)
            await on_goal.asked.wait()
            tasks.cancel_scope.cancel()
            on_goal.decide.set()
        with anyio.fail_after(30):
            outcome = await client.endpoint.get_result(goal_id)
        # It was never accepted, or it was, on its way, and then canceled.
        assert outcome.status in (GoalStatus.UNKNOWN, GoalStatus.CANCELED)


@pytest.mark.promise("REACH-1")
async def test_an_action_that_is_not_served_is_not_found_and_can_be_waited_for(
    reach: Reach,
) -> None:
    address = reach.address()
    other = ActionServer(action_of_numbers("other"), echo)
    with anyio.fail_after(5):
        async with serve(other, address) as (url,), connect(url, FIBONACCI) as client:
            with pytest.raises(ServerNotFound, match="'fibonacci'"):
                await client.send_goal(Goal(1))
            with pytest.raises(ServerNotFound, match=r"'fibonacci' was not served within 0\.01 s"):
                await client.wait_for_server(timeout=0.01)


def action_of_numbers(name: str) -> Any:
    return Action(name, goal=int, feedback=str, result=int)


async def echo(goal: GoalHandle[int]) -> AsyncGenerator[str | int, None]:
    yield goal.request


@pytest.mark.promise("REACH-3")
async def test_several_actions_share_one_connection(reach: Reach) -> None:
    other = ActionServer(action_of_numbers("other"), echo)
    async with reach.connection(server(), other) as connection:
        assert await connection.client(FIBONACCI).call(Goal(2)) == Result([0, 1, 1])
        assert await connection.client(other.action).call(41) == 41
        actions = {info.name: info for info in await connection.actions()}
    assert list(actions) == ["fibonacci", "other"]
    assert actions["fibonacci"] == FIBONACCI.info
    assert actions["fibonacci"].type_name == "arduinobot_msgs/action/Fibonacci"


@pytest.mark.promise("REACH-4")
async def test_a_client_without_the_types_sends_a_goal_from_plain_data(reach: Reach) -> None:
    async with reach.connection(server()) as connection:
        (info,) = await connection.actions()
        client = connection.client(Action.untyped(info))
        async with client.send_goal({"order": 3}) as goal:
            feedback = [item async for item in goal.feedback]
            outcome = await goal.outcome()
    assert feedback == [{"partial_sequence": [0, 1, 1]}, {"partial_sequence": [0, 1, 1, 2]}]
    assert outcome == End(GoalStatus.SUCCEEDED, {"sequence": [0, 1, 1, 2]})


@pytest.mark.promise("STATUS-5", "CANCEL-16")
async def test_an_unknown_goal_can_be_neither_followed_nor_canceled(reach: Reach) -> None:
    async with reach(server()) as client:
        goal_id = GoalID.random()
        with pytest.raises(UnknownGoal, match=str(goal_id)):
            await client.attach(goal_id)
        assert (await client.endpoint.get_result(goal_id)).status is GoalStatus.UNKNOWN
        answer = await client.cancel_goals(goal_id)
        assert answer.return_code is CancelCode.UNKNOWN_GOAL_ID
        assert not answer.accepted


@pytest.mark.promise("ACCEPT-11")
async def test_a_goal_that_cannot_be_encoded_is_the_callers_own_error(reach: Reach) -> None:
    async with reach(server()) as client:
        with pytest.raises(TypeError):
            await client.send_goal(cast("Goal", object()))
        with pytest.raises(OverflowError):
            await client.send_goal(Goal(2**70))
        with pytest.raises(ValueError, match="half a character"):
            await client.send_goal(Goal(cast("int", "\ud800")))
        endless: list[object] = []
        endless.append(endless)
        with pytest.raises(RecursionError):
            await client.send_goal(Goal(cast("int", endless)))
        assert msgspec.msgpack.encode(Goal(1))


class NewerGoal(msgspec.Struct):
    """The type of the goal in a later version of the client."""

    order: int
    start: int = 0


NEWER = Action("fibonacci", goal=NewerGoal, feedback=Feedback, result=Result)


@pytest.mark.promise("ACCEPT-3", "ACCEPT-18")
@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        ({"order": 5, "ordr": 4}, 'goal has no field "ordr"; did you mean order?'),
        ({"ordr": 5}, 'goal has no field "ordr"; did you mean order?'),
        ({"order": "ten"}, 'goal.order must be a whole number, not "ten"'),
        ({"order": 5, "note": "x" * 3000}, 'goal has no field "note"; it has order'),
        ({"order": "x" * 3000}, "goal.order must be a whole number"),
    ],
)
async def test_a_goal_of_a_client_without_types_is_checked_as_at_the_other_doors(
    reach: Reach, goal: dict[str, Any], reason: str
) -> None:
    async with reach.connection(server()) as connection:
        client = connection.client(Action.untyped(FIBONACCI.info))
        with pytest.raises(GoalRejected) as caught:
            await client.send_goal(goal)
        assert reason in caught.value.reason
        assert caught.value.code is RejectionCode.UNREADABLE
        assert await client.call({"order": 2}) == {"sequence": [0, 1, 1]}


@pytest.mark.promise("ACCEPT-18")
async def test_a_client_whose_type_has_a_field_more_is_understood(reach: Reach) -> None:
    async with reach.connection(server()) as connection:
        client = connection.client(NEWER)
        assert await client.call(NewerGoal(2, start=3)) == Result([0, 1, 1])


@pytest.mark.promise("ACCEPT-1", "ACCEPT-18")
async def test_a_large_goal_of_a_client_without_types_is_decided_after_its_check(
    reach: Reach,
) -> None:
    asked: list[int] = []

    async def decide(goal: Lines) -> None:
        await anyio.lowlevel.checkpoint()
        asked.append(len(goal.lines))

    async def count(goal: GoalHandle[Lines]) -> AsyncGenerator[Any, None]:
        yield len(goal.request.lines)

    action = Action("print", goal=Lines, feedback=str, result=int)
    for on_goal in (decide, lambda goal: asked.append(len(goal.lines)), None):
        async with reach.connection(ActionServer(action, count, on_goal=on_goal)) as connection:
            client = connection.client(Action.untyped(action.info))
            assert await client.call({"lines": ["a" * 100] * 50}) == 50
    assert asked == [50, 50]


class Lines(msgspec.Struct):
    lines: list[str]
