"""`fibaction.client`: clients and goals over a scripted server, or over a broken endpoint."""

from __future__ import annotations

import math
import uuid
from collections.abc import Awaitable, Callable
from typing import Any, cast

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionError,
    ActionInfo,
    ActionServer,
    CancelAnswer,
    CancelCode,
    ConnectionLost,
    Endpoint,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    Outcome,
    ProtocolError,
    Retry,
    ServerNotFound,
    UnknownGoal,
)
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import FeedbackItem, GoalRequest, GoalStream, GoalUpdate, StatusStream
from fibaction.border.endpoints import ForwardingEndpoint
from fibaction.testing import ScriptedServer
from tests.support.executors import Steps
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.spans import Spans

pytestmark = pytest.mark.asyncio


class BrokenStream(GoalStream):
    """A goal whose connection was lost, or whose server sends nonsense."""

    goal_id = GoalID(bytes(15) + b"\x01")
    stamp = 7
    latest = False
    cursor = 0
    reads = True
    status = GoalStatus.EXECUTING
    dropped = 0
    attempt = 3

    def __init__(self, *, nonsense: bool = False, unknown: bool = False) -> None:
        self.nonsense = nonsense
        self.unknown = unknown
        self.closed = 0
        self.held: list[bool] = []
        self.news = Notifier()

    def take(self, limit: int = 1) -> list[GoalUpdate]:
        if self.nonsense:
            return [FeedbackItem(1, b"\xc0")]
        raise ConnectionLost("the line is dead")

    def known_outcome(self) -> Outcome[bytes] | None:
        if self.nonsense:
            return Outcome(GoalStatus.SUCCEEDED, b"\xc0")
        if self.unknown:
            return Outcome(GoalStatus.UNKNOWN)
        raise ConnectionLost("the line is dead")

    def hold(self, wanted: bool) -> None:
        self.held.append(wanted)

    def close(self) -> None:
        self.closed += 1

    def fail(self, error: ActionError) -> None:
        raise NotImplementedError


class Broken(Endpoint):
    """An endpoint that hands out one stream, and answers a cancel as it was told to."""

    def __init__(self, stream: BrokenStream) -> None:
        self.stream = stream
        self.follows: list[GoalID] = []
        self.cancels: list[GoalID | None] = []
        self.answer: CancelAnswer | Exception | None = ConnectionLost("the line is dead")
        self.sending: anyio.Event | None = None

    @property
    def info(self) -> ActionInfo:
        return FIBONACCI.info

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        if self.sending is not None:
            self.sending.set()
            await anyio.sleep_forever()
        return self.stream

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False, attempt: int = 1
    ) -> GoalStream:
        self.follows.append(goal_id)
        return self.stream

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        self.cancels.append(goal_id)
        if self.answer is None:
            await anyio.sleep_forever()
        if isinstance(self.answer, CancelAnswer):
            return self.answer
        assert isinstance(self.answer, Exception)
        raise self.answer

    async def status(self) -> StatusStream:
        raise ConnectionLost("the line is dead")

    async def wait_for_server(self) -> None:
        await anyio.sleep_forever()


def client_of(endpoint: Endpoint) -> ActionClient[Goal, Feedback, Result]:
    return ActionClient(endpoint, FIBONACCI)


async def test_a_goal_that_is_not_awaited_is_warned_about() -> None:
    async with ScriptedServer(FIBONACCI, [Result([])]) as server:
        with pytest.warns(RuntimeWarning, match=r"ActionClient.send_goal. was never awaited"):
            client_of(server).send_goal(Goal(1))
        assert server.received == []


@pytest.mark.parametrize("wrong", [bytes(16), uuid.UUID(int=1), b"", 7])
async def test_what_is_no_goal_id_goes_nowhere(wrong: Any) -> None:
    broken = Broken(BrokenStream())
    client = client_of(broken)
    with pytest.raises(TypeError, match="goal_id must be a GoalID"):
        client.send_goal(Goal(1), goal_id=wrong)
    with pytest.raises(TypeError, match="goal_id must be a GoalID"):
        await client.attach(wrong)
    with pytest.raises(TypeError, match="goal_id must be a GoalID"):
        await client.cancel_goals(wrong)
    assert (broken.follows, broken.cancels) == ([], [])


async def test_the_text_of_a_goal_id_does_as_well_as_the_id() -> None:
    async with ScriptedServer(FIBONACCI, [Result([])]) as server:
        client = client_of(server)
        goal_id = GoalID.random()
        goal = await client.send_goal(Goal(1), goal_id=str(goal_id))
        assert goal.goal_id == goal_id
        assert (await client.attach(str(uuid.UUID(bytes=goal_id)))).goal_id == goal_id
        answer = await client.cancel_goals(str(goal_id))
        assert answer.return_code is not CancelCode.UNKNOWN_GOAL_ID
        with pytest.raises(ValueError, match="32 hexadecimal digits, not 'g1'"):
            await client.attach("g1")
        with pytest.raises(
            TypeError, match=r"made by a goal, as `goal\.step\('drive'\)`; 'g1' is not"
        ):
            await client.send_goal(Goal(1), step=cast("Any", "g1"))


NOTHING = Action("nothing", goal=type(None), feedback=int, result=str)
EASY = Action("easy", goal=dict[str, int], feedback=int, result=str)


@pytest.mark.parametrize(
    ("action", "goal"),
    [
        (NOTHING, None),
        (EASY, {}),
        (Action.untyped(NOTHING.info), None),
        (Action.untyped(EASY.info), {}),
    ],
)
async def test_an_action_without_a_goal_is_called_without_one(
    action: Action[Any, Any, str], goal: object
) -> None:
    served: Action[Any, int, str] = NOTHING if goal is None else EASY
    async with ScriptedServer(served, ["a"], ["b"]) as server:
        client = ActionClient(server, action)
        assert await client.call() == "a"
        async with client.send_goal() as sent:
            assert await sent.result() == "b"
        assert server.received == [goal, goal]


async def test_a_goal_that_an_action_needs_is_not_left_out() -> None:
    broken = Broken(BrokenStream())
    with pytest.raises(TypeError, match="action 'fibonacci' needs a goal, and none was given"):
        await cast("Any", client_of(broken)).call()


async def test_a_timeout_that_is_text_is_told_in_one_sentence() -> None:
    text: Any = "5"
    client = client_of(Broken(BrokenStream()))
    with pytest.raises(TypeError, match="timeout must be a number, not '5'"):
        client.send_goal(Goal(1), timeout=text)
    with pytest.raises(TypeError, match="timeout must be a number, not '5'"):
        await client.wait_for_server(text)
    with pytest.raises(TypeError, match="delay must be a number, not '5'"):
        Retry(delay=text)


@pytest.mark.parametrize("wrong", [0, -1.5, math.nan])
async def test_a_timeout_that_is_no_time_goes_nowhere(wrong: float) -> None:
    text = f"^timeout must be more than 0 seconds, or None for no limit, not {wrong}$"
    async with ScriptedServer(FIBONACCI, [Result([])]) as server:
        client = client_of(server)
        with pytest.raises(ValueError, match=text):
            client.send_goal(Goal(1), timeout=wrong)
        with pytest.raises(ValueError, match=text):
            await client.call(Goal(1), timeout=wrong)
        with pytest.raises(
            TypeError, match=r"^retry must be a Retry, such as Retry\(attempts=3\), not 3$"
        ):
            await client.call(Goal(1), retry=cast("Retry", 3))
    assert server.received == []


async def test_feedback_and_result_that_are_not_of_their_type_are_the_servers_error() -> None:
    goal = await client_of(Broken(BrokenStream(nonsense=True))).send_goal(Goal(1))
    text = "of action 'fibonacci' is not of its type, as its server sent it: Expected `object`"
    with pytest.raises(ProtocolError, match=f"^feedback {text}, got `None`$"):
        await anext(aiter(goal.feedback))
    with pytest.raises(ProtocolError, match=f"^the result {text}, got `None`$"):
        await goal.outcome()


async def test_a_result_that_is_not_known_any_more_is_an_unknown_goal() -> None:
    goal = await client_of(Broken(BrokenStream(unknown=True))).send_goal(Goal(1))
    assert (await goal.outcome()).status is GoalStatus.UNKNOWN
    with pytest.raises(UnknownGoal):
        await goal.result()


async def test_a_lost_connection_is_told_to_each_wait_and_leaving_does_not_hide_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stream = BrokenStream()
    with pytest.raises(ConnectionLost, match="the line is dead"):
        async with client_of(Broken(stream)).send_goal(Goal(1)) as goal:
            async for _ in goal.feedback:
                raise AssertionError("there is none")
    assert stream.closed
    assert "was left, but could not be canceled: the line is dead" in caplog.text


async def test_a_goal_that_is_dropped_closes_its_feedback() -> None:
    stream = BrokenStream()
    goal = await client_of(Broken(stream)).send_goal(Goal(1))
    feedback = goal.feedback
    del goal
    assert not stream.closed
    del feedback
    assert stream.closed


class LateEndpoint(ForwardingEndpoint):
    """An endpoint whose server comes at the end of the wait."""

    async def wait_for_server(self) -> None:
        await anyio.sleep_forever()


async def test_a_server_that_comes_at_the_end_of_the_wait_is_too_late() -> None:
    async with ActionServer(FIBONACCI, _never) as server:
        with pytest.raises(ServerNotFound, match=r"was not served within 0\.001 s$"):
            await client_of(LateEndpoint(server)).wait_for_server(timeout=0.001)


async def test_waiting_for_a_server_has_an_end() -> None:
    client = client_of(Broken(BrokenStream()))
    with pytest.raises(
        ServerNotFound, match=r"the action 'fibonacci' was not served within 0\.001"
    ):
        await client.wait_for_server(timeout=0.001)
    with anyio.move_on_after(0.001) as patience:
        await client.wait_for_server()
    assert patience.cancelled_caught
    async with ActionServer(FIBONACCI, _never) as server:
        await client_of(server).wait_for_server(timeout=5)


async def _never(goal: GoalHandle[Goal]) -> Any:
    raise AssertionError("nobody sends a goal here")
    yield


async def test_leaving_a_client_cancels_a_goal_that_is_being_sent_by_its_id() -> None:
    endpoint = Broken(BrokenStream())
    endpoint.sending = anyio.Event()
    endpoint.answer = CancelAnswer(CancelCode.NONE)
    goal_id = GoalID.random()
    client = client_of(endpoint)

    async def send() -> None:
        async with client.send_goal(Goal(1), goal_id=goal_id):
            raise AssertionError("it is never accepted")

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(send)
            await endpoint.sending.wait()
            await client.leave()
            assert endpoint.cancels == [goal_id]
            tasks.cancel_scope.cancel()


# Lost feedback


class LossyStream(BrokenStream):
    """A goal that has ended, and whose feedback was lost."""

    dropped = 7

    def __init__(self, *, latest: bool) -> None:
        super().__init__()
        self.latest = latest

    def take(self, limit: int = 1) -> list[GoalUpdate]:
        return [self.known_outcome()]

    def known_outcome(self) -> Outcome[bytes]:
        return Outcome(GoalStatus.SUCCEEDED, FIBONACCI.result.encode(Result([1])))


@pytest.mark.parametrize("latest", [False, True])
async def test_a_call_logs_how_much_feedback_was_lost_unless_that_is_the_policy(
    latest: bool, caplog: pytest.LogCaptureFixture
) -> None:
    stream = LossyStream(latest=latest)
    assert await client_of(Broken(stream)).call(Goal(1), on_feedback=print) == Result([1])
    lost = f"goal {stream.goal_id}: 7 feedback messages were lost"
    assert (lost in caplog.text) is not latest


# Threads


async def test_a_client_in_another_thread_is_told_which_one_is_its_own() -> None:
    async with ScriptedServer(FIBONACCI, [Feedback([1]), Result([3])]) as server:
        client = client_of(server)
        goal = await client.send_goal(Goal(1))
        uses: list[Callable[[], Awaitable[object]]] = [
            lambda: client.call(Goal(1)),
            lambda: _awaited(client.send_goal(Goal(1))),
            lambda: client.attach(goal.goal_id),
            client.cancel_goals,
            client.goals,
            client.events().__aenter__,
            client.wait_for_server,
            goal.result,
            goal.outcome,
            goal.cancel,
            goal.feedback.__anext__,
        ]

        async def use_all() -> None:
            for use in uses:
                with pytest.raises(RuntimeError, match=r"anyio\.from_thread\.run\(client\.call"):
                    await use()
            with pytest.raises(RuntimeError, match="belongs to the event loop of thread"):
                goal.close()

        await anyio.to_thread.run_sync(anyio.run, use_all)
        assert await goal.result() == Result([3])


async def _awaited(sending: Awaitable[object]) -> object:
    return await sending


async def test_a_goal_goes_on_after_its_block_if_it_was_detached() -> None:
    hold = anyio.Event()
    async with ScriptedServer(FIBONACCI, [hold, Result([4])]) as server:
        sending = client_of(server).send_goal(Goal(1))
        async with sending as goal:
            sending.detach()
        hold.set()
        assert await goal.result() == Result([4])


async def test_a_goal_that_was_attached_again_is_canceled_by_its_block() -> None:
    async with ScriptedServer(FIBONACCI, [anyio.Event(), Result([4])]) as server:
        sending = client_of(server).send_goal(Goal(1))
        async with sending as goal:
            sending.detach()
            sending.attach()
        assert (await goal.outcome()).status is GoalStatus.CANCELED


async def test_a_goal_that_was_not_awaited_is_told_with_what_to_write() -> None:
    async with ScriptedServer(FIBONACCI, [Result([4])]) as server:
        forgotten: Any = client_of(server).send_goal(Goal(1))
        with pytest.raises(AttributeError) as caught:
            forgotten.feedback  # noqa: B018
        assert str(caught.value) == (
            "the goal has no attribute 'feedback', because it was not sent: write"
            " `goal = await client.send_goal(...)`, or `async with client.send_goal(...) as goal`"
        )
        assert await (await forgotten).result() == Result([4])


# Spans


async def test_a_client_with_tracing_makes_a_span_for_each_goal() -> None:
    spans = Spans()
    async with ScriptedServer(FIBONACCI, [Result([1])], [GoalRejected("busy")]) as server:
        client = ActionClient(server, FIBONACCI, tracing=spans.tracing)
        assert await client.call(Goal(1)) == Result([1])
        with pytest.raises(GoalRejected):
            await client.call(Goal(2))

    assert [span.status.status_code.name for span in spans.ended] == ["UNSET", "ERROR"]


async def test_the_feedback_of_a_goal_that_is_read_no_more_ends() -> None:
    stream = BrokenStream(nonsense=True)
    stream.reads = False
    goal = await client_of(Broken(stream)).send_goal(Goal(1))
    assert [each async for each in goal.feedback] == []


async def test_the_number_of_the_last_feedback_is_where_another_reader_goes_on() -> None:
    hold = anyio.Event()
    steps = Feedback([1]), Feedback([2]), Feedback([3]), hold, Result([4])
    async with ScriptedServer(FIBONACCI, steps) as server:
        client = client_of(server)
        goal = await client.send_goal(Goal(1))
        assert (goal.feedback.number, goal.feedback.attempt) == (0, 1)
        async for feedback in goal:
            if feedback == Feedback([2]):
                break
        assert repr(client) == "<ActionClient of <Action 'fibonacci'>>"
        assert repr(goal) == f"<ClientGoal {goal.goal_id} EXECUTING>"
        assert repr(goal.feedback) == "<FeedbackReader number=2 dropped=0>"
        later = await client.attach(goal.goal_id, after=goal.feedback.number, attempt=1)
        hold.set()
        assert [(later.feedback.number, feedback) async for feedback in later] == [
            (3, Feedback([3]))
        ]


@pytest.mark.parametrize("timeout", [None, 60.0])
async def test_two_tasks_cannot_read_the_feedback_of_a_goal_at_once(timeout: float | None) -> None:
    executor = Steps()
    async with ActionServer(FIBONACCI, executor) as server:
        client = ActionClient(server, FIBONACCI)
        async with client.send_goal(Goal(1), timeout=timeout) as goal:
            feedback = aiter(goal.feedback)
            await anext(feedback)
            seen: list[Feedback] = []

            async def read() -> None:
                seen.extend([item async for item in goal.feedback])

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(read)
                await anyio.wait_all_tasks_blocked()
                with pytest.raises(RuntimeError, match=r"get another one by `client\.attach"):
                    await anext(feedback)
                executor.go.set()
            assert await goal.result() == Result([1])
            # One after another may read on, also after a wait that was canceled.
            assert [item async for item in goal.feedback] == seen == []


async def test_only_a_client_that_was_awaited_is_closed() -> None:
    with pytest.raises(RuntimeError, match="this client need not be closed"):
        await client_of(Broken(BrokenStream(nonsense=True))).aclose()
