"""Feedback that arrives after the result of a server which does not tell how much there was."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from fibaction.words.goals import GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2.client.followed_goals import FollowedGoals
from fibaction_transports.ros2.client.goal_stream import RosGoalStream
from fibaction_transports.ros2.client.status_lists import ReceivedStatuses
from fibaction_transports.ros2.convert.status_bytes import pack_count, pack_line, pack_statuses
from fibaction_transports.ros2.node.parts import TopicSubscription
from fibaction_transports.ros2.on_dds.topics import DdsSubscription
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.node_messages import PARAMETER
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.qos import Durability, Qos, Reliability

pytestmark = pytest.mark.anyio
GOAL = GoalID(bytes(range(16)))
OUTCOME = Outcome(GoalStatus.SUCCEEDED, b"")
RELIABLE = Qos(reliability=Reliability.RELIABLE)
RUNNING = GoalInfo(GOAL, 5, GoalStatus.EXECUTING)
FEEDBACK = b"\x00\x01\x00\x00" + GOAL


class Decoder:
    def feedback(self, message: bytes) -> bytes:
        return message

    def outcome(self, response: Any) -> Outcome[bytes]:
        return OUTCOME


class Node:
    """A node with the client of a service, whose answers the test gives."""

    types = SimpleNamespace(uuid=bytes)
    answer: Callable[[int, Any], None]

    def caller(self, service: str, service_type: Any, qos: EndQos, take: Any, *_: Any) -> Any:
        self.answer = take
        return SimpleNamespace(send=lambda request: 1, forget=lambda number: None)


def no_pause(reader: Any, is_paused: bool) -> None:
    """Pause nothing."""


def ended(
    catch_up: Callable[[Callable[[], None]], None], known: ReceivedStatuses | None = None
) -> tuple[FollowedGoals, RosGoalStream]:
    """Return the goals of a client, and the stream of one whose result has arrived."""
    node: Any = Node()
    service: Any = SimpleNamespace(
        Request=lambda: SimpleNamespace(goal_id=SimpleNamespace(uuid=None))
    )
    decoder: Any = Decoder()
    known = known or ReceivedStatuses()
    followed = FollowedGoals(
        node, "a", "a/get", service, EndQos(), known, is_reliable=True, catch_up=catch_up
    )
    stream = RosGoalStream(GOAL, decoder, 10, reads=True)
    stream.begin(RUNNING)
    followed.add(stream)
    node.answer(followed.request_result(stream), SimpleNamespace(status=GoalStatus.SUCCEEDED))
    return followed, stream


async def test_feedback_that_is_on_its_way_comes_before_the_outcome() -> None:
    waiting = list[Callable[[], None]]()
    followed, stream = ended(waiting.append)
    assert stream.known_outcome() == OUTCOME
    assert stream.take() == ()
    for _ in range(2):
        followed.take_feedback(FEEDBACK, b"publisher")
        assert not stream.is_over
    (then,) = waiting
    then()
    assert [
        item.number for item in stream.take(2) if not isinstance(item, GoalStatus | Outcome)
    ] == [1, 2]
    assert stream.take() == (OUTCOME,)
    assert followed.of(GOAL) == ()


async def test_without_a_way_to_ask_the_result_ends_the_feedback() -> None:
    _, stream = ended(lambda then: then())
    assert stream.take() == (OUTCOME,)


def test_a_goal_is_not_active_any_more_when_its_result_was_faster_than_the_status_list() -> None:
    known = ReceivedStatuses()
    known.update(pack_statuses([pack_line(RUNNING)]))
    followed, _ = ended(lambda then: then(), known)
    assert followed.active(GOAL) is None
    used_again = GoalInfo(GOAL, 6, GoalStatus.EXECUTING)
    known.update(pack_statuses([pack_line(used_again)]))
    assert followed.active(GOAL) == used_again


class Silent(TopicSubscription):
    def publisher_count(self) -> int:
        return 1


def test_a_middleware_that_cannot_tell_counts_as_caught_up() -> None:
    called = list[int]()
    Silent().when_caught_up(lambda: called.append(1))
    assert called == [1]


def test_a_subscription_that_was_asked_again_waits_for_the_later_answer() -> None:
    called = list[int]()
    reader: Any = SimpleNamespace(is_catching_up=True, topic="rt/a", qos=Qos())
    subscription = DdsSubscription(reader, lambda *_: None, lambda of: of.is_catching_up, no_pause)
    subscription.when_caught_up(lambda: called.append(1))
    subscription.note_caught_up()
    assert called == []
    reader.is_catching_up = False
    subscription.when_caught_up(lambda: called.append(2))
    assert called == [2]
    subscription.note_caught_up()
    subscription.note_caught_up()
    assert called == [2, 1]


def numbered(subscription: DdsSubscription, *numbers: int) -> None:
    """Let messages of one writer arrive."""
    writer = Guid(bytes(16))
    for number in numbers:
        subscription.receive(Sample(writer, number, FEEDBACK, None, None))


async def test_feedback_that_a_server_kept_no_longer_is_counted_by_the_numbers_of_its_messages(
    caplog: pytest.LogCaptureFixture,
) -> None:
    followed, stream = ended(lambda then: None)
    reader: Any = SimpleNamespace(topic="rt/a/_action/feedback", qos=RELIABLE)
    subscription = DdsSubscription(reader, followed.take_feedback, lambda _: False, no_pause)
    subscription.tell_lost(followed.note_lost)
    numbered(subscription, 7, 8, 12, 13)

    items = [item for item in stream.take(9) if not isinstance(item, GoalStatus | Outcome)]
    assert [item.number for item in items] == [1, 2, 6, 7]
    assert stream.dropped == 3
    (told,) = caplog.messages
    assert told.startswith("a message on /a/_action/feedback was dropped (3 so far): ")


async def test_feedback_that_is_lost_before_the_first_of_a_goal_is_not_its_own() -> None:
    followed, stream = ended(lambda then: None)
    followed.note_lost(5)
    followed.take_feedback(FEEDBACK, b"")
    other = RosGoalStream(GoalID.random(), stream.decoder, 10, reads=True)
    followed.add(other)
    followed.note_lost(5)  # of either of them
    followed.take_feedback(FEEDBACK, b"")

    items = [item for item in stream.take(9) if not isinstance(item, GoalStatus | Outcome)]
    assert [item.number for item in items] == [1, 2]


def test_a_topic_of_latest_messages_may_skip_some(caplog: pytest.LogCaptureFixture) -> None:
    reader: Any = SimpleNamespace(topic="rt/status", qos=Qos(durability=Durability.TRANSIENT_LOCAL))
    numbered(DdsSubscription(reader, lambda *_: None, lambda _: False, no_pause), 1, 9)
    assert caplog.messages == []


def test_the_number_of_feedback_messages_is_the_parameter_that_ros_reads() -> None:
    message = PARAMETER()
    message.name = str(GOAL)
    message.value.type = 2  # PARAMETER_INTEGER
    message.value.integer_value = 2**40 + 3
    assert pack_count(GOAL, 2**40 + 3) == PARAMETER.codec.encode(message)
