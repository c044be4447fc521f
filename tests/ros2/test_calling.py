"""The client's half: what is lost is asked for again, and nobody waits for what cannot come."""

from __future__ import annotations

import uuid
from array import array
from collections.abc import AsyncGenerator, Callable
from contextlib import suppress
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionServer,
    CancelCode,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalRejected,
    GoalStatus,
    Outcome,
    ServerNotFound,
    UnknownGoal,
    connect,
    serve,
)
from fibaction.abc import FeedbackItem
from fibaction.action import ActionInfo
from fibaction.exceptions import ProtocolError
from fibaction.goals import ActionPeers
from fibaction.server.status_broadcast import StatusSubscription
from fibaction_transports.ros2 import asking, calling, presence, remote, serving
from fibaction_transports.ros2.asking import Asker, Question
from fibaction_transports.ros2.following import Reading, RosGoal
from fibaction_transports.ros2.intake import Responses
from fibaction_transports.ros2.serving import Served
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

pytestmark = pytest.mark.anyio

Items = AsyncGenerator[Feedback | Result, None]
LOST = ConnectionLost("it is gone")


@pytest.fixture
def url() -> str:
    """A namespace where nobody serves anything."""
    return f"ros2://?namespace=/t{uuid.uuid4().hex}"


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asking, "FIRST_PATIENCE", 0.3)
    monkeypatch.setattr(remote, "LATE", 0.1)


async def forever(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    await anyio.sleep_forever()
    yield Result([])


def lose(monkeypatch: pytest.MonkeyPatch, part: str, *, answers: bool, count: int = 1) -> list[Any]:
    """Let the server lose requests of one kind, or its answers to them; gives what was lost."""
    lost: list[Any] = []
    answer: Callable[[Any, Any], Any] = getattr(Served, part)

    async def loses(self: Served, request: Any) -> Any:
        if len(lost) < count and not answers:
            lost.append(request)
            return None  # which cannot be sent
        response = await answer(self, request)
        if len(lost) < count:
            lost.append(response)
            return None
        return response

    monkeypatch.setattr(Served, part, loses)
    return lost


@pytest.mark.promise("LOSS-5")
@pytest.mark.parametrize("answers", [False, True], ids=["request", "answer"])
async def test_a_goal_that_is_lost_on_the_way_is_sent_again_and_runs_once(
    url: str, answers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = 0

    async def counts(goal: GoalHandle[Goal]) -> Items:
        nonlocal runs
        runs += 1
        yield Result([goal.request.order])

    lost = lose(monkeypatch, "_answer_goal", answers=answers)
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, counts), url),
            connect(url, FIBONACCI) as client,
        ):
            assert await client.call(Goal(7)) == Result([7])
    assert len(lost) == runs == 1


@pytest.mark.promise("LOSS-5")
async def test_a_second_try_that_is_refused_because_of_the_first_is_an_acceptance(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = lose(monkeypatch, "_answer_goal", answers=True)
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, forever), url),
            connect(url, FIBONACCI) as client,
        ):
            known = client.endpoint._server.known  # type: ignore[attr-defined]  # it is ours
            # The list comes late: only after the second try has been refused.
            monkeypatch.setattr(known, "get", Late(known.get, 2))
            goal = await client.send_goal(Goal(7))
            assert goal.status.is_active
            assert goal.stamp > 0
    assert len(lost) == 1


class Late:
    """Finds nothing the first times."""

    def __init__(self, look: Callable[[bytes], Any], misses: int) -> None:
        self.look = look
        self.misses = misses

    def __call__(self, goal_id: bytes) -> Any:
        self.misses -= 1
        return None if self.misses >= 0 else self.look(goal_id)


async def test_a_second_try_that_is_rejected_is_rejected(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def on_goal(goal: Goal) -> None:
        raise GoalRejected("busy")

    lose(monkeypatch, "_answer_goal", answers=False)
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci, on_goal=on_goal), url),
            connect(url, FIBONACCI) as client,
        ):
            with pytest.raises(GoalRejected, match="ROS 2 transmits no reason"):
                await client.send_goal(Goal(7))


@pytest.mark.promise("LOSS-5")
async def test_a_cancel_that_is_lost_is_asked_for_again(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = lose(monkeypatch, "_answer_cancel", answers=False)
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, forever), url),
            connect(url, FIBONACCI) as client,
        ):
            goal = await client.send_goal(Goal(7))
            assert (await goal.cancel()).accepted
            assert (await goal.outcome()).status is GoalStatus.CANCELED
    assert len(lost) == 1


@pytest.mark.parametrize("answers", [False, True], ids=["request", "answer"])
async def test_a_result_that_is_lost_is_asked_for_again(
    url: str, answers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = lose(monkeypatch, "_answer_result", answers=answers, count=2)
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), url),
            connect(url, FIBONACCI) as client,
        ):
            assert await client.call(Goal(2)) == Result([0, 1, 1])
            goal_id = GoalID.random()
            with pytest.raises(UnknownGoal):
                await client.attach(goal_id)
    assert len(lost) == 2


async def test_500_goals_at_once_all_succeed_and_few_are_without_an_answer(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = 0
    send = Asker.send

    def counts(self: Asker, request: Any, question: Question) -> int:
        nonlocal most
        number = send(self, request, question)
        most = max(most, len(self._open))
        return number

    monkeypatch.setattr(Asker, "send", counts)
    monkeypatch.setattr(asking, "FIRST_PATIENCE", 10.0)
    results: list[Result] = []
    async with serve(ActionServer(FIBONACCI, fibonacci), url), connect(url, FIBONACCI) as client:

        async def one() -> None:
            results.append(await client.call(Goal(2)))

        with anyio.fail_after(30):
            async with anyio.create_task_group() as tasks:
                for _ in range(500):
                    tasks.start_soon(one)
    assert results == [Result([0, 1, 1])] * 500
    assert most <= asking.AT_ONCE


async def test_whoever_waits_is_told_when_the_server_goes_away(url: str) -> None:
    ends: list[str] = []

    async def wait(ending: Any) -> None:
        try:
            await ending
        except ConnectionLost as exc:
            ends.append(str(exc))

    with anyio.fail_after(10):
        async with connect(url, FIBONACCI) as client, anyio.create_task_group() as tasks:
            server = ActionServer(FIBONACCI, forever)
            async with server:
                async with serve(server, url):
                    await client.wait_for_server()
                    goal = await client.send_goal(Goal(1))
                    statuses = await client.endpoint.status()
                    while (info := await statuses.receive()) is not None:
                        if info.status is GoalStatus.EXECUTING:
                            break
                    tasks.start_soon(wait, goal.outcome())
                    tasks.start_soon(wait, statuses.receive())
                    await anyio.wait_all_tasks_blocked()
    assert ends == ["the server of 'fibonacci' has gone away"] * 2


async def test_whoever_waits_is_told_when_the_connection_is_closed_here(url: str) -> None:
    ends: list[str] = []

    async def wait(goal: Any) -> None:
        try:
            await goal.outcome()
        except ConnectionLost as exc:
            ends.append(str(exc))

    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, forever), url),
            anyio.create_task_group() as tasks,
        ):
            async with connect(url, FIBONACCI) as client:
                goal = await client.send_goal(Goal(1))
                tasks.start_soon(wait, goal)
                await anyio.wait_all_tasks_blocked()
            await anyio.wait_all_tasks_blocked()
            assert ends == ["the connection was closed here"]


async def test_a_refusal_as_rclpy_tells_it_is_a_refusal(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = 0

    async def refuses(self: Served, request: Any) -> Any:
        return self._impl.CancelGoalService.Response(return_code=code)

    monkeypatch.setattr(serving.Served, "_answer_cancel", refuses)
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, forever), url),
            connect(url, FIBONACCI) as client,
        ):
            by_id = await client.cancel_goals(GoalID.random())
            assert by_id.return_code is CancelCode.REJECTED
            assert (await client.cancel_goals()).return_code is CancelCode.NONE
            code = 77
            with pytest.raises(ProtocolError, match="77"):
                await client.cancel_goals()


async def test_a_server_that_is_killed_before_any_sign_of_life_is_missed(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(presence, "FIRST_SIGN", 0.5)
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, forever), url),
            connect(url, FIBONACCI) as client,
        ):
            # It has died; but to the graph, it is still there.
            monkeypatch.setattr(presence.Presence, "_look_at_life", lambda self: None)
            goal = await client.send_goal(Goal(1))
            with pytest.raises(ConnectionLost, match="has gone away"):
                await goal.outcome()


async def test_a_server_that_was_there_and_is_gone_is_not_waited_for(url: str) -> None:
    with anyio.fail_after(10):
        async with connect(f"{url}&discovery_timeout=60", FIBONACCI) as client:
            async with serve(ActionServer(FIBONACCI, fibonacci), url):
                assert await client.call(Goal(2)) == Result([0, 1, 1])
            with pytest.raises(ServerNotFound):
                while True:
                    with suppress(ConnectionLost):  # it leaves just now
                        await client.cancel_goals()


async def test_the_result_of_a_running_goal_is_asked_for_again_if_somebody_does_not_know_it(
    url: str,
) -> None:
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, forever), url),
            connect(url, FIBONACCI) as client,
        ):
            with await client.endpoint.status() as statuses:
                goal = await client.send_goal(Goal(1))
                while (info := await statuses.receive()) is not None:
                    if info.status is GoalStatus.EXECUTING:
                        break
            server = client.endpoint._server  # type: ignore[attr-defined]  # it is ours
            (number,) = server._asked
            server._take_result((number, server.impl.GetResultService.Response()))
            assert (await goal.cancel()).accepted
            assert (await goal.outcome()).status is GoalStatus.CANCELED


@pytest.mark.parametrize("status", [GoalStatus.EXECUTING, 77])
async def test_an_answer_that_is_no_end_of_a_goal_is_a_protocol_error(
    url: str, status: int
) -> None:
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, forever), url),
            connect(url, FIBONACCI) as client,
        ):
            goal = await client.send_goal(Goal(1))
            server = client.endpoint._server  # type: ignore[attr-defined]  # it is ours
            (number,) = server._asked
            server._take_result((number, server.impl.GetResultService.Response(status=status)))
            with pytest.raises(ProtocolError, match=f"has the status {int(status)}"):
                await goal.result()


@pytest.mark.promise("GOAL-4")
async def test_a_result_that_cannot_be_read_ends_the_wait_for_it_and_for_no_other(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a text of a server in C++ that is no Unicode."""
    take: Callable[[Responses], Any] = Responses.take
    bad = array("i", [1])

    def take_all_but_bad(self: Responses) -> Any:
        item = take(self)
        if item is not None and getattr(getattr(item[1], "result", None), "sequence", ()) == bad:
            raise ValueError("it is no text")
        return item

    monkeypatch.setattr(Responses, "take", take_all_but_bad)

    async def execute(goal: GoalHandle[Goal]) -> Items:
        if goal.request.order == 2:
            await ended.wait()
        yield Result([goal.request.order])

    ended = anyio.Event()
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, execute), url),
            connect(url, FIBONACCI) as client,
        ):
            running = await client.send_goal(Goal(2))
            with pytest.raises(ProtocolError, match="result cannot be read: it is no text"):
                await client.call(Goal(1))
            ended.set()
            assert await running.result() == Result([2])


@pytest.mark.promise("CANCEL-14")
@pytest.mark.parametrize(
    ("stamp", "canceled"),
    [(2**31 * 10**9, True), (10**30, True), (-(2**31 + 1) * 10**9, False), (-(10**30), False)],
)
async def test_a_stamp_that_ros_cannot_say_is_before_or_behind_all_goals(
    url: str, stamp: int, canceled: bool
) -> None:
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, forever), url),
            connect(url, FIBONACCI) as client,
        ):
            await client.send_goal(Goal(1))
            answer = await client.cancel_goals(before=stamp)
            assert answer.return_code is CancelCode.NONE
            assert bool(answer.goals_canceling) is canceled


async def test_whoever_asks_is_told_that_ros_was_shut_down(url: str) -> None:
    with anyio.fail_after(10):
        async with connect(url) as connection:
            client = connection.client(FIBONACCI)
            connection.endpoint(FIBONACCI)._server._ros.node.context.shutdown()  # type: ignore[attr-defined]  # as above
            for ask in (
                client.wait_for_server,
                client.cancel_goals,
                connection.actions,
                lambda: connection.peers("fibonacci"),
            ):
                with pytest.raises(ConnectionLost, match="rclpy was shut down"):
                    await ask()


def test_what_cannot_be_sent_is_a_lost_connection() -> None:
    class Gone:
        def send_request(self, request: Any) -> int:
            raise RuntimeError("the context is not valid")

    with pytest.raises(ConnectionLost, match="ROS cannot send any more: the context"):
        asking.sent(Gone(), None)


# Who is there


async def test_peers_are_the_nodes_that_serve_and_that_listen(url: str) -> None:
    place = url.partition("=")[2]
    with anyio.fail_after(10):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), url.replace("//", "//robot")),
            connect(url.replace("//", "//operator"), FIBONACCI) as client,
            connect(url.replace("//", "//onlooker")) as connection,
        ):
            await client.wait_for_server()
            peers = ActionPeers()
            while not (peers.servers and peers.clients):  # one may be known before the other
                peers = await connection.peers("fibonacci")
            assert peers == ActionPeers((f"{place}/robot",), (f"{place}/operator",))


async def test_an_action_that_nobody_serves_or_uses_has_no_peers(url: str) -> None:
    with anyio.fail_after(10):
        async with connect(f"{url}&discovery_timeout=0.1") as connection:
            assert await connection.peers("fibonacci") == ActionPeers()


async def test_a_client_that_has_just_come_sees_the_goals_that_there_are(url: str) -> None:
    with anyio.fail_after(10):
        async with serve(ActionServer(FIBONACCI, forever), url):
            async with connect(url, FIBONACCI) as client:
                assert await client.goals() == []
                goal = await client.send_goal(Goal(1))
                async with connect(url, FIBONACCI) as other:
                    assert [one.goal_id for one in await other.goals()] == [goal.goal_id]


async def test_an_endpoint_says_what_it_is_for_and_reads_no_nonsense(url: str) -> None:
    async with connect(url, FIBONACCI) as client:
        assert client.endpoint.info == FIBONACCI.info
        with pytest.raises(ProtocolError, match="feedback of 3 bytes"):
            client.endpoint._reading.feedback(b"abc")  # type: ignore[attr-defined]  # as above


def test_an_action_whose_type_is_not_installed_has_no_schemas() -> None:
    unknown = ActionInfo("arm", "no_such_msgs/action/Arm")
    assert calling._described("arm", "no_such_msgs/action/Arm") == unknown


# What is followed


class Plain(Reading):
    """Feedback as it is."""

    def feedback(self, message: bytes) -> bytes:
        return message

    def outcome(self, response: Any) -> Outcome[bytes]:
        raise NotImplementedError


def goal(depth: int = 3, *, reads: bool = True) -> RosGoal:
    made = RosGoal(GoalID.random(), Plain(), depth, reads=reads)
    made.begin(GoalInfo(made.goal_id, 5, GoalStatus.ACCEPTED))
    return made


async def test_unread_feedback_is_bounded_and_what_is_dropped_is_counted() -> None:
    stream = goal(3)
    for number in range(5):
        stream.arrive(bytes([number]))
    assert stream.take(2) == [FeedbackItem(3, b"\2"), FeedbackItem(4, b"\3")]
    assert stream.dropped == 2
    assert stream.take(2) == [FeedbackItem(5, b"\4")]
    assert stream.take(2) == ()
    stream.end(Outcome(GoalStatus.SUCCEEDED, b""))
    assert stream.take() == (stream.known_outcome(),)
    assert (await stream.outcome()).status is stream.status is GoalStatus.SUCCEEDED
    stream.fail(LOST)  # too late
    assert stream.take() == (stream.known_outcome(),)
    assert stream.dropped == 2


async def test_statuses_are_told_before_feedback_and_only_forward() -> None:
    stream = goal()
    stream.arrive(b"x")
    for status in (GoalStatus.EXECUTING, GoalStatus.ACCEPTED, GoalStatus.SUCCEEDED):
        stream.tell(status)
    assert await anext(aiter(stream)) is GoalStatus.EXECUTING
    assert await anext(aiter(stream)) == FeedbackItem(1, b"x")
    assert stream.status is GoalStatus.SUCCEEDED
    stream.hold(True)  # has no effect


async def test_what_has_arrived_is_read_before_the_loss_is_told() -> None:
    stream = goal()
    stream.arrive(b"x")
    stream.fail(LOST)
    stream.arrive(b"y")
    stream.end(Outcome(GoalStatus.SUCCEEDED))
    assert stream.take() == [FeedbackItem(1, b"x")]
    for wait in (stream.receive, stream.outcome):
        with pytest.raises(ConnectionLost, match="it is gone"):
            await wait()


def test_a_stream_that_is_closed_or_reads_nothing_keeps_nothing() -> None:
    for stream in (goal(), goal(reads=False)):
        stream.arrive(b"x")
        stream.tell(GoalStatus.EXECUTING)
        stream.close()
        stream.arrive(b"y")
        assert stream.take() is None
        assert stream.status is GoalStatus.EXECUTING


async def test_statuses_that_are_not_read_lose_the_oldest() -> None:
    left: list[StatusSubscription] = []
    infos = [GoalInfo(GoalID.random(), number, GoalStatus.ACCEPTED) for number in range(4)]
    stream = StatusSubscription(infos[:1], left.append, limit=2)
    assert stream.known == 1
    for info in infos[1:]:
        stream.put(info)
    assert stream.dropped == 1
    assert [await stream.receive() for _ in range(3)] == infos[1:]
    stream.fail(LOST)
    with pytest.raises(ConnectionLost):
        await stream.receive()
    stream.close()
    assert left == [stream]
    assert await stream.receive() is None
