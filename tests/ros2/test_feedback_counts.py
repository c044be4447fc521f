"""Feedback that arrives after the result: it is waited for, and what is lost is counted."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionServer,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalStatus,
    Outcome,
    TransportError,
    connect,
    serve,
)
from fibaction_transports.ros2.client import action_client, followed_goals
from fibaction_transports.ros2.client.goal_stream import RosGoalStream
from fibaction_transports.ros2.names import count_topic
from fibaction_transports.ros2.on_rclpy.rclpy_node import RclpyNode
from fibaction_transports.ros2.server.goal_forwarder import FeedbackPublisher
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.ros2.ends import Undecoded, client_of, new_url
from tests.ros2.stock.ours import action
from tests.ros2.stock.process import peer
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.processes import PATIENCE
from tests.support.ros_ends import both_ends

pytestmark = pytest.mark.anyio

LOST = "feedback messages of goal"


class Withheld:
    """Feedback that a server counts as published, and publishes when the test says so."""

    def __init__(self) -> None:
        self.of: dict[FeedbackPublisher, list[bytes]] = {}
        self._publish = FeedbackPublisher.publish

    async def keep(self, feedback: FeedbackPublisher, payload: bytes) -> None:
        """Stand for `FeedbackPublisher.publish`."""
        self.of.setdefault(feedback, []).append(payload)
        feedback.count += 1

    async def release(self, count: int) -> None:
        """Publish these many messages of each goal."""
        for feedback, payloads in self.of.items():
            for payload in payloads[:count]:
                await self._publish(feedback, payload)
            del payloads[:count]


@pytest.fixture
def withheld(monkeypatch: pytest.MonkeyPatch) -> Withheld:
    made = Withheld()
    monkeypatch.setattr(FeedbackPublisher, "publish", lambda one, payload: made.keep(one, payload))
    return made


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """No wait in these tests lasts as long as this one."""
    monkeypatch.setattr(followed_goals, "LATE_FEEDBACK", 10 * PATIENCE)


async def orders_of(goal: Any) -> list[int]:
    return [len(item.partial_sequence) async for item in goal.feedback]


async def until_missing(client: Any, count: int) -> RosGoalStream:
    """Wait until the only goal of a client is known to lack these many messages."""
    (stream,) = client_of(client.endpoint)._followed
    while stream.missing != count:
        await anyio.lowlevel.checkpoint()
    return stream


@pytest.mark.promise("GOAL-2", "FEEDBACK-2")
@pytest.mark.usefixtures("patient")
async def test_feedback_that_arrives_after_the_result_is_delivered_before_the_end(
    url: str, withheld: Withheld, caplog: pytest.LogCaptureFixture
) -> None:
    async with both_ends(url) as client, client.send_goal(Goal(5)) as goal:
        assert await goal.result() == Result([0, 1, 1, 2, 3, 5])  # it does not wait for feedback
        client_of(client.endpoint)._followed.finish_overdue()  # it is too early
        await withheld.release(4)
        assert await orders_of(goal) == [3, 4, 5, 6]
        assert goal.feedback_dropped == 0
        assert not client_of(client.endpoint)._followed
    assert not caplog.records


@pytest.mark.usefixtures("patient")
async def test_feedback_that_does_not_arrive_is_counted_and_ends_no_later_than_it_may(
    url: str, withheld: Withheld, caplog: pytest.LogCaptureFixture
) -> None:
    async with both_ends(url) as client, client.send_goal(Goal(5)) as goal:
        await goal.result()
        await withheld.release(1)
        stream = await until_missing(client, 3)
        client_of(client.endpoint)._followed._unfinished[stream] = 0.0  # long ago
        assert await orders_of(goal) == [3]
        assert goal.feedback_dropped == 3
        assert goal.feedback.number == 4
    (record,) = caplog.records
    assert record.getMessage() == f"fibonacci: 3 {LOST} {goal.goal_id} are lost"


@pytest.mark.usefixtures("patient", "withheld")
async def test_a_best_effort_reader_counts_what_is_missing_and_does_not_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(action_client, "WATCH_PAUSE", 10 * PATIENCE)  # the test looks
    best_effort = f"{new_url()}&feedback_qos=best_effort"
    async with both_ends(best_effort) as client, client.send_goal(Goal(5)) as goal:
        await goal.result()
        await until_missing(client, 4)
        client_of(client.endpoint)._followed.finish_overdue()
        assert await orders_of(goal) == []
        assert goal.feedback_dropped == 4


@pytest.mark.usefixtures("patient", "withheld")
async def test_a_client_that_reads_no_feedback_waits_for_none(url: str) -> None:
    async with both_ends(url) as client:
        assert await client.call(Goal(5)) == Result([0, 1, 1, 2, 3, 5])
        assert not client_of(client.endpoint)._followed


@pytest.mark.usefixtures("patient", "withheld")
async def test_a_reader_that_leaves_ends_the_wait(url: str) -> None:
    async with both_ends(url) as client:
        goal = await client.send_goal(Goal(5))
        await goal.result()
        goal.close()
        assert await orders_of(goal) == []
        followed = client_of(client.endpoint)._followed
        while followed:
            followed.finish_overdue()


@pytest.mark.usefixtures("patient", "withheld")
async def test_a_server_that_leaves_ends_the_wait_with_the_outcome(url: str) -> None:
    with anyio.fail_after(PATIENCE):
        async with connect(url, FIBONACCI) as client:
            async with serve(ActionServer(FIBONACCI, fibonacci), url):
                goal = await client.send_goal(Goal(5))
                await goal.result()
                await until_missing(client, 4)
            assert await orders_of(goal) == []
            assert goal.feedback_dropped == 4


@pytest.mark.usefixtures("patient")
async def test_the_result_is_not_requested_again_while_feedback_is_missing(
    url: str, withheld: Withheld
) -> None:
    async with both_ends(url) as client, client.send_goal(Goal(5)) as goal:
        await goal.result()
        raw = client_of(client.endpoint)
        (stream,) = raw._followed
        before = list(stream.requests)
        raw._followed._overdue[goal.goal_id] = 0.0  # long ago
        raw._followed.retry_overdue()
        raw._followed.resume()
        assert stream.requests == before
        await withheld.release(4)
        assert await orders_of(goal) == [3, 4, 5, 6]


@pytest.mark.usefixtures("patient")
async def test_feedback_that_does_not_fit_its_type_is_not_waited_for(
    url: str,
) -> None:
    async def unfit(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        yield Feedback([1])
        yield Feedback([2**40])
        yield Feedback([3])
        yield Result([])

    async with both_ends(url, unfit) as client, client.send_goal(Goal(1)) as goal:
        assert [item.partial_sequence async for item in goal.feedback] == [[1], [3]]


async def test_few_ended_goals_are_remembered(
    url: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(followed_goals, "ENDED", 1)
    async with both_ends(url) as client:
        goals = [await client.send_goal(Goal(1)) for _ in range(2)]
        for goal in goals:
            assert await orders_of(goal) == []
        ended = client_of(client.endpoint)._followed
        assert len(ended._ended) == 1
        for goal in goals:
            ended.take_feedback(b"\0\1\0\0" + bytes(goal.goal_id), b"")
    assert len(caplog.records) == 1


async def topics_at(client: Any) -> list[str]:
    ros = client_of(client.endpoint).presence._ros
    return [name for name, _ in ros.topics()]


async def test_a_server_of_rclpy_is_not_asked_for_what_it_does_not_have() -> None:
    async with peer("server"):
        async with connect("ros2://", action("stock")) as client:
            await client.wait_for_server(20)
            async with client.send_goal(Goal(5)) as goal:
                await orders_of(goal)  # rclpy may publish it before this client is connected
                assert await goal.result() == Result([0, 1, 1, 2, 3, 5])
            raw = client_of(client.endpoint)
            topic = count_topic(raw.presence._ros.resolve, "stock")
            assert topic not in await topics_at(client)
            assert raw.presence._ros.count_subscriptions(topic) == 0


async def test_the_topic_is_hidden_and_is_not_found_as_a_part_of_an_action(url: str) -> None:
    async with both_ends(url) as client:
        await client.call(Goal(1))
        (topic,) = [name for name in await topics_at(client) if "fibaction_count" in name]
    assert any(part.startswith("_") for part in topic.split("/"))
    assert "/_action/feedback" not in topic
    assert "/_action/status" not in topic


async def test_of_two_servers_no_number_is_taken(url: str) -> None:
    async with both_ends(url) as client:
        await client.wait_for_server()
        counts = client_of(client.endpoint)._counts
        assert counts.come_from(client_of(client.endpoint).presence.servers())
        assert not counts.come_from(frozenset({b"one", b"two"}))


async def test_a_goal_that_is_sent_while_ros_is_shut_down_is_lost_like_any_other(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with both_ends(url) as client:
        await client.wait_for_server()
        raw = client_of(client.endpoint)
        come_from = raw._counts.come_from

        def shut_down_then(servers: frozenset[bytes]) -> bool:
            ros: Any = raw.presence._ros
            monkeypatch.setattr(ros, "count_publishers", lambda topic: 1)
            ros.node.context.shutdown()
            return come_from(servers)

        monkeypatch.setattr(raw._counts, "come_from", shut_down_then)
        with pytest.raises(ConnectionLost):
            await client.send_goal(Goal(1))


def test_a_number_counts_only_for_a_stream_that_has_followed_from_the_beginning() -> None:
    stream = RosGoalStream(GoalID.random(), Undecoded(), 3, reads=True)
    stream.set_total(7)
    assert stream.missing == 0
    stream.is_counted = True
    assert stream.missing is None
    stream.set_total(2)
    stream.add_feedback(b"x")
    assert stream.missing == 1
    stream.set_outcome(Outcome(GoalStatus.SUCCEEDED, b""))
    assert len(stream.take()) == 1
    assert stream.take() == ()
    assert not stream.is_over
    stream.finish()
    assert stream.take() == (stream.known_outcome(),)
    assert stream.dropped == 1


def test_more_feedback_than_announced_is_none_that_is_missing() -> None:
    stream = RosGoalStream(GoalID.random(), Undecoded(), 3, reads=True)
    stream.is_counted = True
    stream.set_total(1)
    for _ in range(2):  # a server that was started anew counts its own
        stream.add_feedback(b"x")
    assert stream.missing == 0


@pytest.mark.parametrize("denied", ["publisher", "subscription"])
async def test_without_the_permission_for_the_topic_goals_run_as_with_any_server(
    url: str, monkeypatch: pytest.MonkeyPatch, denied: str
) -> None:
    make, warned = getattr(RclpyNode, denied), list[str]()

    def make_if_allowed(ros: RclpyNode, name: str, *arguments: Any, **others: Any) -> Any:
        if name.endswith("_fibaction_count"):
            raise TransportError(f"{name}: not allowed")
        return make(ros, name, *arguments, **others)

    monkeypatch.setattr(RclpyNode, denied, make_if_allowed)
    monkeypatch.setattr(RclpyNode, "warn", lambda ros, text: warned.append(text))
    async with both_ends(url) as client:
        for _ in range(2):
            async with client.send_goal(Goal(5)) as goal:
                assert await orders_of(goal) == [3, 4, 5, 6]
                assert (await goal.outcome()).status is GoalStatus.SUCCEEDED
    (text,) = warned  # once, and not for each goal
    assert text.endswith("_fibaction_count: not allowed")
