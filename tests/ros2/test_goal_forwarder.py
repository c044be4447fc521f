"""The feedback topic: it begins more slowly for a new reader."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import pytest

from fibaction import GoalID
from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.server import goal_forwarder
from fibaction_transports.ros2.server.goal_forwarder import FIRST_PACE, LOOK_PAUSE, FeedbackTopic
from fibaction_transports.ros2.settings import RosSettings
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio

pytestmark = pytest.mark.anyio

MANY = 600
"""More than half a queue."""


class Message:
    def __init__(self) -> None:
        self.goal_id = self
        self.uuid: Any = None
        self.feedback: Any = None


class Ros:
    """A node, its graph and a publisher, with the readers that a test gives it."""

    def __init__(self) -> None:
        self.types = self
        self.readers: list[bytes] = []
        self.looks = 0
        self.has_taken_all = False

    def uuid(self, goal_id: bytes) -> bytes:
        return goal_id

    def publisher(self, *_: object) -> Ros:
        return self

    def count_subscriptions(self, topic: str) -> int:
        return len(self.readers)

    count_callers = count_subscriptions

    def reader_count(self) -> int:
        return len(self.readers)

    def subscriptions(self, topic: str) -> list[EndInfo]:
        self.looks += 1
        return [EndInfo(gid, "/reader", EndQos()) for gid in self.readers]

    def has_arrived(self, margin: int) -> bool:
        return self.has_taken_all

    def publish(self, message: Message) -> None:
        """Do nothing."""


class Names:
    feedback, send_goal = "feedback", "send_goal"


class Codec:
    def to_ros(self, payload: bytes) -> bytes:
        return payload


class Time:
    """A clock that is set by those who wait."""

    def __init__(self) -> None:
        self.now = 100.0

    async def sleep_until(self, when: float) -> None:
        self.now = max(self.now, when)


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    time = Time()
    monkeypatch.setattr(goal_forwarder, "current_time", lambda: time.now)
    monkeypatch.setattr(anyio, "sleep_until", time.sleep_until)
    return time


@pytest.fixture
def ros() -> Ros:
    return Ros()


@pytest.fixture
def taken(ros: Ros, time: Time) -> Callable[..., Any]:
    """Publish the feedback of a goal, and return the seconds that it took."""
    node: Any = ros
    names: Any = Names()
    codec: Any = Codec()
    topic = FeedbackTopic(node, "arm", names, Message, codec, RosSettings())

    async def publish(messages: int = MANY) -> float:
        before = time.now
        publish_one = topic.of(GoalID.random()).publish
        for _ in range(messages):
            await publish_one(b"feedback")
        return time.now - before

    return publish


async def test_a_goal_begins_slowly_for_a_new_reader(
    ros: Ros, time: Time, taken: Callable[..., Any]
) -> None:
    assert await taken() < FIRST_PACE  # nobody reads

    time.now += 1.0
    ros.readers = [b"one"]
    assert await taken() > FIRST_PACE

    time.now += 1.0
    assert await taken() < FIRST_PACE


async def test_a_new_reader_is_noticed_although_another_has_left(
    ros: Ros, time: Time, taken: Callable[..., Any]
) -> None:
    ros.readers = [b"one"]
    await taken()

    time.now += 1.0
    ros.readers = [b"two"]
    assert await taken() > FIRST_PACE

    time.now += 1.0
    ros.readers = []
    assert await taken() < FIRST_PACE


async def test_readers_that_are_known_to_take_everything_get_more_in_a_second(
    ros: Ros, taken: Callable[..., Any]
) -> None:
    ros.readers = [b"one"]
    await taken()  # the first messages come slowly
    await taken()
    usual = await taken()
    ros.has_taken_all = True
    await taken()
    assert await taken() < usual / 2


async def test_readers_are_looked_up_once_for_many_goals_at_a_time(
    ros: Ros, time: Time, taken: Callable[..., Any]
) -> None:
    ros.readers = [b"one"]
    await taken()
    before = ros.looks

    time.now += 2 * LOOK_PAUSE
    for _ in range(10):
        await taken(1)
    assert ros.looks == before + 1
