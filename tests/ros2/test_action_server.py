"""The server, called by raw requests, and by clients of fibaction where these are enough."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionServer,
    CancelCode,
    CancelRejected,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalRejected,
    GoalStatus,
    connect,
    serve,
)
from fibaction_transports.inprocess import InProcessTransport
from fibaction_transports.ros2.client.goal_stream import RosGoalStream
from fibaction_transports.ros2.convert.status_bytes import status_of
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node import rivals
from fibaction_transports.ros2.on_rclpy import ends, rcl
from fibaction_transports.ros2.on_rclpy.rcl import uuid_of
from fibaction_transports.ros2.on_rclpy.rclpy_adapter import own_node
from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes
from fibaction_transports.ros2.on_rclpy.spinner import Requests
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.server import action_server, goal_forwarder, service_server
from fibaction_transports.ros2.server.action_server import RosActionServer, ServedEndpoint
from fibaction_transports.ros2.server.served_statuses import ServedStatuses
from fibaction_transports.ros2.settings import NodeSettings, RosSettings
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.ros2.ends import Items, Undecoded, client_of, forever, raw_client, result_of, send
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.processes import PATIENCE
from tests.support.ros_ends import both_ends

pytestmark = pytest.mark.anyio

TRANSIENT_LOCAL = EndQos(depth=1, durability="transient_local")


async def test_a_goal_sent_twice_while_it_is_decided_is_accepted_once(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, again, decide = anyio.Event(), anyio.Event(), anyio.Event()
    accept: Callable[..., Awaitable[int | None]] = RosActionServer._accept

    decisions: list[str] = []

    async def tells(self: RosActionServer, *request: Any) -> int | None:
        if asked.is_set():
            again.set()
        stamp = await accept(self, *request)
        decisions.append("decided before" if stamp is None else "accepted")
        return stamp

    monkeypatch.setattr(RosActionServer, "_accept", tells)
    answers: list[bool] = []
    goal_id = GoalID.random()

    async def on_goal(goal: Goal) -> None:
        asked.set()
        await decide.wait()

    async def one() -> None:
        answers.append((await send(server, goal_id, 1)).accepted)

    async with (
        raw_client(url, ActionServer(FIBONACCI, forever, on_goal=on_goal)) as server,
        anyio.create_task_group() as tasks,
    ):
        tasks.start_soon(one)
        await asked.wait()
        tasks.start_soon(one)
        await again.wait()
        decide.set()
    assert sorted(answers) == [False, True]
    assert decisions == ["accepted", "decided before"]


async def test_an_answer_that_cannot_reach_its_client_yet_is_sent_again_and_feedback_waits_for_it(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    happened: list[str] = []

    def has_answered(service: Any, response: Any, header: Any) -> bool:
        if type(response).__name__.endswith("SendGoal_Response"):
            happened.append("answer")
            if len(happened) < 3:
                return False
        return rcl.has_answered(service, response, header)

    async def keep_pace(topic: goal_forwarder.FeedbackTopic) -> None:
        happened.append("feedback")

    monkeypatch.setattr(ends, "has_answered", has_answered)
    monkeypatch.setattr(goal_forwarder.FeedbackTopic, "_keep_pace", keep_pace)
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), url),
            connect(url, FIBONACCI) as client,
            client.send_goal(Goal(5)) as goal,
        ):
            received = [len(item.partial_sequence) async for item in goal.feedback]
    assert happened == ["answer"] * 3 + ["feedback"] * 4
    assert received == [3, 4, 5, 6]


async def test_answers_to_a_client_that_cannot_be_reached_are_dropped_and_others_are_served(
    url: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(service_server, "ANSWER_PAUSES", (0.01,))
    heard = anyio.Event()

    def on_goal(goal: Goal) -> None:
        if goal.order == 7:
            heard.set()

    server = ActionServer(FIBONACCI, fibonacci, on_goal=on_goal)
    with anyio.fail_after(20):
        async with (
            serve(server, url),
            connect(url, FIBONACCI) as other,
            own_node(NodeSettings(namespace=url.partition("=")[2])) as deaf,
        ):
            service = RclpyTypes().find(FIBONACCI.type_name).impl.SendGoalService
            # Every server gets its requests. No server can answer: none is transient local.
            name = action_names(deaf.resolve, "fibonacci").send_goal
            client = deaf.caller(name, service, TRANSIENT_LOCAL, lambda *_: None)
            request = service.Request()
            request.goal_id.uuid = uuid_of(GoalID.random())
            request.goal.order = 7
            while not heard.is_set():  # nothing tells that the server is connected
                client.send(request)
                with anyio.move_on_after(0.1):
                    await heard.wait()
            assert (await (await other.send_goal(Goal(5))).result()).sequence == [0, 1, 1, 2, 3, 5]
    assert "fibonacci: an answer cannot reach its client, and is lost" in caplog.text


def test_a_warning_of_rclpy_is_an_error_only_for_answers_of_fibaction() -> None:
    program = """
import warnings
from fibaction_transports.ros2.on_rclpy.rcl import has_answered

class Service:
    def service_send_response(self, response, header):
        warnings.warn("failed to send response (timeout): why", RuntimeWarning, stacklevel=2)

print(has_answered(Service(), None, None))
print(Service().service_send_response(None, None))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.split() == ["False", "None"]
    assert "RuntimeWarning: failed to send response (timeout): why" in done.stderr


@pytest.mark.parametrize("error", [RuntimeError("the client has left"), SystemError("a bug")])
def test_an_answer_that_fails_in_another_way_is_an_error(error: Exception) -> None:
    class Service:
        def service_send_response(self, response: Any, header: Any) -> None:
            raise error

    with pytest.raises(type(error), match=str(error)):
        rcl.has_answered(Service(), None, None)


async def test_the_node_stays_for_a_moment_after_the_last_answer_so_that_it_arrives(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(action_server, "LINGER", 0.5)
    async with connect(url, FIBONACCI) as client:
        async with serve(ActionServer(FIBONACCI, forever), url):
            goal = await client.send_goal(Goal(1))
            leaving = anyio.current_time()
        assert anyio.current_time() - leaving >= 0.5  # the end was sent after `leaving`
        assert (await goal.outcome()).status is GoalStatus.ABORTED


@pytest.mark.promise("ACCEPT-2", "EXECUTE-5")
async def test_the_reasons_of_rejections_and_of_an_abort_are_in_the_log_of_ros(
    url: str, capfd: pytest.CaptureFixture[str]
) -> None:
    def on_goal(goal: Goal) -> None:
        raise GoalRejected("it is\nbusy")

    def on_cancel(goal: GoalHandle[Goal]) -> None:
        raise CancelRejected("too late")

    async with raw_client(url, ActionServer(FIBONACCI, fibonacci, on_goal=on_goal)) as client:
        assert not (await send(client, GoalID.random(), 1)).accepted
    async with raw_client(url, ActionServer(FIBONACCI, forever, on_cancel=on_cancel)) as client:
        assert (await send(client, GoalID.random(), 1)).accepted
        response = await client.cancel(client.impl.CancelGoalService.Request())
        assert response.return_code == CancelCode.REJECTED
    said = capfd.readouterr().err
    assert "rejected: it is\\x0abusy" in said
    assert "cancel rejected: too late" in said
    assert "ABORTED: server stopped" in said


async def test_a_result_that_does_not_fit_its_ros_type_aborts_the_goal(
    url: str, capfd: pytest.CaptureFixture[str]
) -> None:
    async def too_large(goal: GoalHandle[Goal]) -> Items:
        yield Feedback([2**31])
        yield Feedback([7])
        yield Feedback([2**32])
        yield Result([2**31])

    async with both_ends(url, too_large) as client:
        with await client.endpoint.status() as statuses:
            goal = await client.send_goal(Goal(1))
            assert [item async for item in goal.feedback] == [Feedback([7])]
            assert (await goal.outcome()).status is GoalStatus.ABORTED
            seen = [await statuses.receive() for _ in range(3)]
    assert [one.status for one in seen if one is not None] == [
        GoalStatus.ACCEPTED,
        GoalStatus.EXECUTING,
        GoalStatus.ABORTED,
    ]
    said = capfd.readouterr().err
    assert said.count("does not fit its ROS type, and is left out") == 1
    assert "its result does not fit its ROS type" in said


async def test_an_outcome_waits_a_while_for_the_first_request(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.ros2.server.goal_forwarder.GRACE", 5.0)
    server = ActionServer(FIBONACCI, fibonacci, result_timeout=0)
    async with raw_client(url, server) as reached:
        goal_id = GoalID.random()
        await send(reached, goal_id, 1)
        assert (await result_of(reached, goal_id)).status == GoalStatus.SUCCEEDED
        assert (await result_of(reached, goal_id)).status == GoalStatus.UNKNOWN


async def test_goals_of_other_transports_are_seen_with_their_feedback(url: str) -> None:
    go = anyio.Event()

    async def waits(goal: GoalHandle[Goal]) -> Items:
        await go.wait()
        yield Feedback([7])
        yield Result([8])

    server = ActionServer(FIBONACCI, waits)
    with anyio.fail_after(PATIENCE):
        async with (
            serve(server, InProcessTransport(), url) as (here, _),
            connect(here, FIBONACCI) as mine,
            connect(url, FIBONACCI) as theirs,
        ):
            goal = await mine.send_goal(Goal(1))
            seen = await theirs.attach(goal.goal_id)
            go.set()
            assert [item async for item in seen.feedback] == [Feedback([7])]
            assert await seen.result() == Result([8])


async def test_a_second_server_of_the_same_action_causes_a_warning(
    url: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(rivals, "RIVALS_PAUSE", 0.05)
    async with (
        serve(ActionServer(FIBONACCI, fibonacci), url),
        serve(ActionServer(FIBONACCI, fibonacci), url),
    ):
        with anyio.fail_after(PATIENCE):
            while len(caplog.records) < 2:  # noqa: ASYNC110  # a log offers nothing to wait for
                await anyio.sleep(0.01)
        await anyio.sleep(0.2)
    warnings = [one.message for one in caplog.records if "another server serves it" in one.message]
    assert len(warnings) == 2  # one of each server
    assert "another server serves it" in capfd.readouterr().err


each_error = pytest.mark.parametrize(
    "error", [ConnectionLost("it is gone"), KeyError("a bug")], ids=type
)
"""An error that an endpoint may raise, and one that it must not raise."""


class Broken:
    """A method of an endpoint that fails."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def __call__(self, *_: object, **__: object) -> Any:
        raise self.error


@each_error
async def test_an_endpoint_that_fails_is_an_answer_and_the_server_goes_on(
    url: str, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = ActionServer(FIBONACCI, forever)
    async with raw_client(url, server) as reached:
        with monkeypatch.context() as broken:
            for name in ("send_goal", "cancel_goals", "get_result"):
                broken.setattr(server, name, Broken(error))
            assert not (await send(reached, GoalID.random(), 1)).accepted
            cancel = reached.impl.CancelGoalService.Request()
            assert (await reached.cancel(cancel)).return_code == CancelCode.REJECTED
            assert (await result_of(reached, GoalID.random())).status == GoalStatus.UNKNOWN
        assert (await send(reached, GoalID.random(), 1)).accepted


async def test_more_requests_than_can_be_under_way_are_lost_and_that_is_logged(
    url: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(service_server, "UNDERWAY", 1)
    async with raw_client(url, ActionServer(FIBONACCI, forever)) as server:
        goal_id = GoalID.random()
        await send(server, goal_id, 1)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(result_of, server, goal_id)
            tasks.start_soon(result_of, server, goal_id)
            while "one is lost" not in caplog.text:  # noqa: ASYNC110  # as above
                await anyio.sleep(0.01)
            tasks.cancel_scope.cancel()


async def test_a_request_that_arrives_after_the_tasks_have_ended_is_dropped(
    url: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    place = url.partition("=")[2]
    with anyio.fail_after(PATIENCE):
        async with (
            ActionServer(FIBONACCI, forever) as server,
            own_node(NodeSettings(namespace=place)) as ros,
            anyio.create_task_group() as tasks,
        ):
            served = RosActionServer(ros, ServedEndpoint(server, ros.types), RosSettings(), tasks)
            tasks.cancel_scope.cancel()  # as if trio had raised a Ctrl-C in one of them
            goals = next(one for one in ros.sources._sources if isinstance(one, Requests))
            goals._sink((None, None))
            await served.drain()
    assert [one.levelno for one in caplog.records if "one is lost" in one.message] == [logging.INFO]


@each_error
async def test_the_statuses_of_an_endpoint_that_comes_back_are_followed_again(
    url: str, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(action_server, "RETRY_PAUSE", 0.01)
    server = ActionServer(FIBONACCI, forever)
    follow: Callable[[], Any] = server.status
    fails = iter([error])

    async def status() -> Any:
        for failure in fails:
            raise failure
        return await follow()

    monkeypatch.setattr(server, "status", status)
    with anyio.fail_after(PATIENCE):
        async with serve(server, url), connect(url, FIBONACCI) as client:
            with await client.endpoint.status() as statuses:
                goal = await client.send_goal(Goal(1))
                info = await statuses.receive()
    assert info is not None
    assert info.goal_id == goal.goal_id


async def test_a_subscriber_that_never_matches_delays_only_one_goal(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(goal_forwarder, "MATCH_TIMEOUT", 0.1)
    place = url.partition("=")[2]
    impl = RclpyTypes().find(FIBONACCI.type_name).impl
    async with own_node(NodeSettings(namespace=place)) as ros:
        name = action_names(ros.resolve, "fibonacci").feedback
        ros.subscription(name, impl.FeedbackMessage, TRANSIENT_LOCAL, lambda *_: None)
        async with both_ends(url) as client:
            for _ in range(3):
                assert await client.call(Goal(3)) == Result([0, 1, 1, 2])


async def test_a_goal_that_a_gateway_has_lost_is_unknown(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if the server behind the gateway had gone away in the middle."""
    server = ActionServer(FIBONACCI, forever)
    streams: list[RosGoalStream] = []

    async def send_goal(goal_id: GoalID, *_: object, **__: object) -> RosGoalStream:
        stream = RosGoalStream(goal_id, Undecoded(), 10, reads=True)
        stream.begin(GoalInfo(goal_id, 5, GoalStatus.ACCEPTED))
        streams.append(stream)
        return stream

    monkeypatch.setattr(server, "send_goal", send_goal)
    goal_id = GoalID.random()
    async with raw_client(url, server) as reached:
        assert (await send(reached, goal_id, 1)).accepted
        streams[0].fail(ConnectionLost("it is gone"))
        assert (await result_of(reached, goal_id)).status == GoalStatus.UNKNOWN


async def test_a_goal_whose_stream_fails_is_unknown_and_the_others_go_on(
    url: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Failing(RosGoalStream):
        def take(self, limit: int = 1) -> Any:
            raise KeyError("a bug")

    async def send_goal(goal_id: GoalID, *_: object, **__: object) -> RosGoalStream:
        return Failing(goal_id, Undecoded(), 10, reads=True)

    server = ActionServer(FIBONACCI, fibonacci)
    goal_id = GoalID.random()
    async with raw_client(url, server) as reached:
        with monkeypatch.context() as broken:
            broken.setattr(server, "send_goal", send_goal)
            assert (await send(reached, goal_id, 1)).accepted
        assert (await result_of(reached, goal_id)).status == GoalStatus.UNKNOWN
        other = GoalID.random()
        assert (await send(reached, other, 1)).accepted
        assert (await result_of(reached, other)).status == GoalStatus.SUCCEEDED
    assert f"goal {goal_id} is lost: 'a bug'" in caplog.text
    assert "Traceback" in caplog.text
    assert "UNKNOWN" not in caplog.text  # it is logged once, with the real reason


@each_error
async def test_a_goal_of_another_transport_that_cannot_be_followed_does_not_affect_others(
    url: str, error: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "fibaction.ros2")
    server = ActionServer(FIBONACCI, fibonacci)
    monkeypatch.setattr(server, "feedback", Broken(error))
    with anyio.fail_after(PATIENCE):
        async with (
            serve(server, InProcessTransport(), url) as (here, _),
            connect(here, FIBONACCI) as mine,
            connect(url, FIBONACCI) as theirs,
        ):
            goal = await mine.send_goal(Goal(2))
            while "no feedback of goal" not in caplog.text:  # noqa: ASYNC110  # as above
                await anyio.sleep(0.01)
            assert await goal.result() == await theirs.call(Goal(2)) == Result([0, 1, 1])


async def test_a_client_that_asks_for_a_result_while_the_server_leaves_gets_it(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = ActionServer(FIBONACCI, forever)
    stop: Callable[[], Any] = server.stop
    stopped = anyio.Event()

    async def stops() -> None:
        await stop()
        stopped.set()

    monkeypatch.setattr(server, "stop", stops)
    statuses: list[int] = []
    goal_id = GoalID.random()
    with anyio.fail_after(PATIENCE):
        async with connect(url) as connection, anyio.create_task_group() as tasks:
            endpoint: Any = connection.endpoint(FIBONACCI)

            async def ask() -> None:
                await stopped.wait()
                statuses.append((await result_of(client_of(endpoint), goal_id)).status)

            async with serve(server, url):
                await endpoint.wait_for_server()
                assert (await send(client_of(endpoint), goal_id, 1)).accepted
                tasks.start_soon(ask)
    assert statuses == [GoalStatus.ABORTED]


async def test_every_status_of_a_goal_is_published_though_those_of_all_goals_are_read_late(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    published: list[list[GoalStatus]] = []
    publish = ServedStatuses._publish

    def record(self: Any) -> None:
        published.append([GoalStatus(status_of(line)) for line in self._lines.values()])
        publish(self)

    async def never(self: Any) -> None:
        await anyio.sleep_forever()

    monkeypatch.setattr(ServedStatuses, "_publish", record)
    monkeypatch.setattr(RosActionServer, "_follow_statuses", never)
    async with both_ends(url) as client:
        assert await client.call(Goal(3)) == Result([0, 1, 1, 2])
    assert published == [
        [],
        [GoalStatus.ACCEPTED],
        [GoalStatus.EXECUTING],
        [GoalStatus.SUCCEEDED],
    ]
