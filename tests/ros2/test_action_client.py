"""The client: lost messages are requested again, and a wait ends if nothing can come any more."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionServer,
    CancelCode,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    UnknownGoal,
    connect,
    serve,
)
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ProtocolError
from fibaction.words.goals import ActionPeers
from fibaction_transports.ros2.client import (
    action_client,
    endpoint,
    followed_goals,
    presence,
    service_client,
)
from fibaction_transports.ros2.client.goal_stream import RosGoalStream
from fibaction_transports.ros2.client.service_client import ServiceCall, ServiceClient
from fibaction_transports.ros2.node.feedback_counts import ReceivedCounts
from fibaction_transports.ros2.on_rclpy import rcl, rclpy_node
from fibaction_transports.ros2.on_rclpy.ends import RclpyCaller
from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes
from fibaction_transports.ros2.on_rclpy.spinner import Responses
from fibaction_transports.ros2.server.action_server import RosActionServer
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.ros2.ends import Items, Undecoded, client_of, forever, node_of
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.processes import PATIENCE
from tests.support.ros_ends import both_ends

pytestmark = pytest.mark.anyio


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_client, "FIRST_TIMEOUT", 0.3)
    for module in (action_client, followed_goals):
        monkeypatch.setattr(module, "LATE", 0.1)


def lose(monkeypatch: pytest.MonkeyPatch, part: str, *, answers: bool, count: int = 1) -> list[Any]:
    """Let the server lose requests of one kind, or its answers to them; gives what was lost."""
    lost: list[Any] = []
    answer: Callable[[Any, Any], Any] = getattr(RosActionServer, part)

    async def loses(self: RosActionServer, request: Any) -> Any:
        if len(lost) < count and not answers:
            lost.append(request)
            return None  # which cannot be sent
        response = await answer(self, request)
        if len(lost) < count:
            lost.append(response)
            return None
        return response

    monkeypatch.setattr(RosActionServer, part, loses)
    return lost


# Retries


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
    async with both_ends(url, counts) as client:
        assert await client.call(Goal(7)) == Result([7])
    assert len(lost) == runs == 1


@pytest.mark.promise("LOSS-5")
async def test_a_goal_in_the_status_list_is_accepted_if_its_answer_is_lost(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_client, "FIRST_TIMEOUT", 1000.0)
    lost = lose(monkeypatch, "_answer_goal", answers=True)
    async with both_ends(url, forever) as client:
        goal = await client.send_goal(Goal(7))
        assert goal.status.is_active
    assert len(lost) == 1


@pytest.mark.promise("LOSS-5")
async def test_a_retry_that_is_rejected_because_of_the_first_request_is_an_acceptance(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    misses = iter(range(2))
    lost = lose(monkeypatch, "_answer_goal", answers=True)
    async with both_ends(url, forever) as client:
        known = client_of(client.endpoint).known
        look = known.get
        # The status list comes late: only after the retry has been rejected.
        monkeypatch.setattr(
            known, "get", lambda goal_id: look(goal_id) if next(misses, None) is None else None
        )
        goal = await client.send_goal(Goal(7))
        assert goal.status.is_active
        assert goal.stamp > 0
    assert len(lost) == 1


async def test_a_retry_that_is_rejected_is_rejected(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def on_goal(goal: Goal) -> None:
        raise GoalRejected("busy")

    lose(monkeypatch, "_answer_goal", answers=False)
    async with both_ends(url, on_goal=on_goal) as client:
        with pytest.raises(GoalRejected, match="ROS 2 transmits no reason"):
            await client.send_goal(Goal(7))


@pytest.mark.promise("LOSS-5")
async def test_a_cancel_that_is_lost_is_sent_again(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = lose(monkeypatch, "_answer_cancel", answers=False)
    async with both_ends(url, forever) as client:
        goal = await client.send_goal(Goal(7))
        assert (await goal.cancel()).accepted
        assert (await goal.outcome()).status is GoalStatus.CANCELED
    assert len(lost) == 1


async def test_what_was_lost_while_the_server_was_silent_is_requested_again_at_once(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_client, "FIRST_TIMEOUT", 60.0)
    monkeypatch.setattr(followed_goals, "LATE", 60.0)
    lost = lose(monkeypatch, "_answer_cancel", answers=False)
    lost_results = lose(monkeypatch, "_answer_result", answers=False)
    async with both_ends(url, forever) as client, anyio.create_task_group() as tasks:
        goal = await client.send_goal(Goal(7))
        raw = client_of(client.endpoint)
        undecided = RosGoalStream(GoalID.random(), Undecoded(), 10, reads=True)
        raw._follow(undecided)  # it is requested when it has begun
        tasks.start_soon(goal.cancel)
        while not (lost and lost_results):  # noqa: ASYNC110  # as above
            await anyio.sleep(0.01)
        raw._resume()
        assert (await goal.outcome()).status is GoalStatus.CANCELED
        raw._followed.remove(undecided)


@pytest.mark.parametrize("answers", [False, True], ids=["request", "answer"])
async def test_a_result_that_is_lost_is_requested_again(
    url: str, answers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = lose(monkeypatch, "_answer_result", answers=answers, count=2)
    async with both_ends(url) as client:
        assert await client.call(Goal(2)) == Result([0, 1, 1])
        with pytest.raises(UnknownGoal):
            await client.attach(GoalID.random())
    assert len(lost) == 2


async def test_of_500_goals_at_once_few_wait_for_an_answer_at_a_time(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = 0
    send = ServiceClient.send

    def counts(self: ServiceClient, request: Any, call: ServiceCall) -> int:
        nonlocal most
        number = send(self, request, call)
        most = max(most, len(self._open))
        return number

    monkeypatch.setattr(ServiceClient, "send", counts)
    monkeypatch.setattr(service_client, "FIRST_TIMEOUT", 10.0)
    async with both_ends(url, patience=30) as client, anyio.create_task_group() as tasks:
        for _ in range(500):
            tasks.start_soon(client.call, Goal(2))
    assert most <= service_client.AT_ONCE


def seem_to_be_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let servers seem not to be of fibaction: they do not tell the number of feedback messages."""
    monkeypatch.setattr(ReceivedCounts, "come_from", lambda self, servers: False)


@pytest.mark.parametrize("early", [True, False])
async def test_the_result_of_a_running_goal_is_requested_again_if_a_server_does_not_know_the_goal(
    url: str, early: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not early:
        seem_to_be_of_others(monkeypatch)
    async with both_ends(url, forever) as client:
        with await client.endpoint.status() as statuses:
            goal = await client.send_goal(Goal(1))
            while (info := await statuses.receive()) is not None:
                if info.status is GoalStatus.EXECUTING:
                    break
        raw = client_of(client.endpoint)
        (number,) = raw._followed._requested
        raw._followed._take_result(number, raw.impl.GetResultService.Response())
        if early:  # at once, and once, though the goal may run for hours
            assert len(raw._followed._requested) == 1
            assert not raw._followed._overdue
        assert (await goal.cancel()).accepted
        assert (await goal.outcome()).status is GoalStatus.CANCELED


@pytest.mark.parametrize("early", [True, False])
async def test_the_result_is_requested_with_the_goal_if_the_server_is_one_of_fibaction(
    url: str, early: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested, accepted = anyio.Event(), anyio.Event()
    answer = RosActionServer._answer_result

    async def notes(self: RosActionServer, request: Any) -> Any:
        assert accepted.is_set() is not early
        requested.set()
        return await answer(self, request)

    async def on_goal(goal: Goal) -> None:
        assert bool(client_of(client.endpoint)._followed._requested) is early
        if early:
            await requested.wait()
        accepted.set()

    monkeypatch.setattr(RosActionServer, "_answer_result", notes)
    if not early:
        seem_to_be_of_others(monkeypatch)
    async with both_ends(url, on_goal=on_goal) as client:
        assert await client.call(Goal(2)) == Result([0, 1, 1])
        assert requested.is_set()


async def test_the_result_of_a_goal_that_the_server_did_not_know_yet_is_requested_again(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = anyio.Event()
    answer = RosActionServer._answer_result
    take = followed_goals.FollowedGoals._take_result

    async def does_not_know(self: RosActionServer, request: Any) -> Any:
        return await answer(self, request) if told.is_set() else client_impl().Response()

    def takes(self: followed_goals.FollowedGoals, number: int, response: Any) -> None:
        take(self, number, response)
        told.set()

    def client_impl() -> Any:
        return client_of(client.endpoint).impl.GetResultService

    async def on_goal(goal: Goal) -> None:
        await told.wait()

    monkeypatch.setattr(RosActionServer, "_answer_result", does_not_know)
    monkeypatch.setattr(followed_goals.FollowedGoals, "_take_result", takes)
    async with both_ends(url, on_goal=on_goal) as client:
        assert await client.call(Goal(2)) == Result([0, 1, 1])


async def test_a_rejected_goal_is_rejected_although_its_result_was_requested(url: str) -> None:
    def on_goal(goal: Goal) -> None:
        raise GoalRejected("busy")

    async with both_ends(url, on_goal=on_goal) as client:
        for _ in range(10):
            with pytest.raises(GoalRejected):
                await client.send_goal(Goal(7))
        followed = client_of(client.endpoint)._followed
        assert not followed
        assert not followed._requested


# Ends of a wait


async def test_a_request_fails_after_ros_was_shut_down(url: str) -> None:
    with anyio.fail_after(PATIENCE):
        async with connect(url) as connection:
            client = connection.client(FIBONACCI)
            node_of(client).context.shutdown()
            for ask in (
                client.wait_for_server,
                client.cancel_goals,
                connection.actions,
                lambda: connection.peers("fibonacci"),
            ):
                with pytest.raises(ConnectionLost, match="rclpy was shut down"):
                    await ask()


def test_a_request_that_cannot_be_sent_is_a_lost_connection() -> None:
    class Gone:
        def send_request(self, request: Any) -> int:
            raise RuntimeError("the context is not valid")

    with pytest.raises(ConnectionLost, match="ROS cannot send any more: the context"):
        RclpyCaller(Gone(), Gone).send(None)


async def test_a_server_that_is_killed_before_any_sign_of_life_is_missed(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(presence, "FIRST_SIGN", 0.25)
    async with both_ends(f"{url}&reconnect=false", forever) as client:
        # It is dead, and the graph still has it.
        monkeypatch.setattr(presence.Presence, "_poll_liveliness", lambda self: None)
        goal = await client.send_goal(Goal(1))
        with pytest.raises(ConnectionLost, match="has gone away"):
            await goal.outcome()


async def test_a_middleware_without_signs_of_life_does_without(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unsupported(*_: object) -> None:
        raise rcl.UnsupportedEventType("the middleware has no such event")

    monkeypatch.setattr(rcl.raw, "EventHandle", unsupported)
    monkeypatch.setattr(rclpy_node, "middleware", lambda: "rmw_zenoh_cpp")
    await works_for_longer_than_a_first_sign(url, monkeypatch)


async def test_a_middleware_that_never_tells_of_signs_of_life_kills_no_server(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(presence.Presence, "_poll_liveliness", lambda self: None)
    monkeypatch.setattr(rclpy_node, "middleware", lambda: "rmw_zenoh_cpp")
    await works_for_longer_than_a_first_sign(url, monkeypatch)


async def works_for_longer_than_a_first_sign(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Call a server until its first sign of life would be overdue, with nothing in between."""
    monkeypatch.setattr(presence, "FIRST_SIGN", 0.25)
    async with both_ends(url, fibonacci) as client:
        end = anyio.current_time() + 3 * 2 * presence.FIRST_SIGN
        while anyio.current_time() < end:
            assert await client.call(Goal(2)) == Result([0, 1, 1])


async def test_a_middleware_that_has_told_of_a_sign_of_life_is_trusted(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rclpy_node, "middleware", lambda: "rmw_zenoh_cpp")
    async with both_ends(url, fibonacci) as client:
        seen = client_of(client.endpoint).presence
        with anyio.fail_after(PATIENCE):
            while not seen._tells_signs:
                await client.call(Goal(2))


async def test_a_server_that_seems_to_be_gone_for_a_moment_keeps_its_goals(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with both_ends(url, forever) as client:
        goal = await client.send_goal(Goal(1))
        looks: list[bool] = []
        seen_again = anyio.Event()
        look = presence.Presence._look

        def misses_once(self: presence.Presence) -> bool:
            looks.append(bool(looks) and look(self))
            if len(looks) > 2:
                seen_again.set()
            return looks[-1]

        monkeypatch.setattr(presence.Presence, "_look", misses_once)
        with anyio.fail_after(PATIENCE):
            await seen_again.wait()
            assert (await goal.cancel()).accepted
            assert (await goal.outcome()).status is GoalStatus.CANCELED
        assert not looks[0]


# Answers that do not fit


async def test_a_rejected_cancel_as_rclpy_answers_it_is_rejected(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = 0

    async def rejects(self: RosActionServer, request: Any) -> Any:
        return self._impl.CancelGoalService.Response(return_code=code)

    monkeypatch.setattr(RosActionServer, "_answer_cancel", rejects)
    async with both_ends(url, forever) as client:
        by_id = await client.cancel_goals(GoalID.random())
        assert by_id.return_code is CancelCode.REJECTED
        assert (await client.cancel_goals()).return_code is CancelCode.NONE
        code = 77
        with pytest.raises(ProtocolError, match="77"):
            await client.cancel_goals()


@pytest.mark.parametrize("status", [GoalStatus.EXECUTING, 77])
async def test_an_answer_that_is_not_the_end_of_a_goal_is_a_protocol_error(
    url: str, status: int
) -> None:
    async with both_ends(url, forever) as client:
        goal = await client.send_goal(Goal(1))
        raw = client_of(client.endpoint)
        (number,) = raw._followed._requested
        response = raw.impl.GetResultService.Response(status=status)
        raw._followed._take_result(number, response)
        with pytest.raises(ProtocolError, match=f"its status is {status}"):
            await goal.result()


@pytest.mark.promise("GOAL-4")
async def test_a_result_that_cannot_be_read_ends_the_wait_for_it_and_for_no_other(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a text of a server in C++ that is not Unicode."""
    take: Callable[[Responses], Any] = Responses.take
    bad = array("i", [1])

    def take_all_but_bad(self: Responses) -> Any:
        item = take(self)
        if item is not None and getattr(getattr(item[1], "result", None), "sequence", ()) == bad:
            raise ValueError("invalid text")
        return item

    monkeypatch.setattr(Responses, "take", take_all_but_bad)

    async def execute(goal: GoalHandle[Goal]) -> Items:
        if goal.request.order == 2:
            await ended.wait()
        yield Result([goal.request.order])

    ended = anyio.Event()
    async with both_ends(url, execute) as client:
        running = await client.send_goal(Goal(2))
        with pytest.raises(ProtocolError, match="result cannot be read: invalid text"):
            await client.call(Goal(1))
        ended.set()
        assert await running.result() == Result([2])


async def test_an_endpoint_rejects_invalid_feedback(url: str) -> None:
    async with connect(url, FIBONACCI) as client:
        assert client.endpoint.info == FIBONACCI.info
        cut_off = b"\0\1\0\0" + bytes(10)
        with pytest.raises(ProtocolError, match="invalid feedback of 14 bytes"):
            client.endpoint._decoder.feedback(cut_off)  # type: ignore[attr-defined]  # RosEndpoint


async def test_feedback_after_the_result_is_logged_once_for_its_goal(
    url: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with both_ends(url) as client:
        goal = await client.send_goal(Goal(1))
        await goal.result()
        for goal_id in (goal.goal_id, GoalID.random(), goal.goal_id):
            client_of(client.endpoint)._followed.take_feedback(b"\0\1\0\0" + bytes(goal_id), b"")
    late = f"feedback of goal {goal.goal_id} arrived after its result, and is lost"
    assert [record.getMessage() for record in caplog.records] == [f"fibonacci: {late}"]


@pytest.mark.promise("CANCEL-14")
@pytest.mark.parametrize(
    ("stamp", "canceled"),
    [(2**31 * 10**9, True), (10**30, True), (-(2**31 + 1) * 10**9, False), (-(10**30), False)],
)
async def test_a_stamp_beyond_those_of_ros_is_before_or_after_all_goals(
    url: str, stamp: int, canceled: bool
) -> None:
    async with both_ends(url, forever) as client:
        await client.send_goal(Goal(1))
        answer = await client.cancel_goals(before=stamp)
        assert answer.return_code is CancelCode.NONE
        assert bool(answer.goals_canceling) is canceled


# The graph


async def test_peers_are_the_nodes_that_serve_and_that_subscribe(url: str) -> None:
    place = url.partition("=")[2]
    with anyio.fail_after(PATIENCE):
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


@pytest.mark.parametrize("is_scouted", [True, False])
async def test_the_nodes_are_those_of_others(
    url: str, is_scouted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not is_scouted:  # as with a middleware that our own DDS cannot look at
        monkeypatch.setattr(rclpy_node, "middleware", lambda: "rmw_zenoh_cpp")
    place = url.partition("=")[2]
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), url.replace("//", "//robot")),
            connect(url.replace("//", "//onlooker")) as connection,
        ):
            found: set[str] = set()
            while f"{place}/robot" not in found:
                found = await connection.nodes()
            assert f"{place}/onlooker" not in found


def test_an_action_whose_type_is_not_installed_has_no_schemas() -> None:
    unknown = ActionInfo("arm", "no_such_msgs/action/Arm")
    assert endpoint._described(RclpyTypes(), "arm", "no_such_msgs/action/Arm") == unknown
