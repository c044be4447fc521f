"""The topics of actions, for rosbridge clients: feedback and statuses of the goals of others."""

from __future__ import annotations

import base64
import json
from typing import Any

import msgspec
import pytest

from fibaction import GoalStatus, Peer, Permission
from fibaction.wire.messages import (
    AwaitServer,
    Close,
    Credit,
    Done,
    Ended,
    Failed,
    Feedback,
    Finished,
    Follow,
    FromClient,
    GoalChanged,
    Received,
    Watching,
    WatchStatus,
    Why,
    decode_from_client,
    decode_from_server,
    encode,
)
from fibaction_transports.web.rosbridge.operations import Subscribe, Unsubscribe
from fibaction_transports.web.rosbridge.server import topics, watched_action
from fibaction_transports.web.rosbridge.server.pending_calls import CREDIT
from fibaction_transports.web.rosbridge.server.topics import FIRST_REQUEST, RETRY_AFTER, Topics
from tests.transports.hearing import Hearing
from tests.transports.tcp.servers import new_server
from tests.transports.web.rosbridge.clients import Serving
from tests.transports.web.rosbridge.robot import TYPE, Robot, goal

asynchronous = pytest.mark.anyio

FEEDBACK = "/fibonacci/_action/feedback"
STATUS = "/fibonacci/_action/status"


def uuid_of(goal_id: bytes) -> dict[str, str]:
    return {"uuid": base64.b64encode(goal_id).decode()}


def feedback(goal_id: bytes, *numbers: int, topic: str = FEEDBACK) -> dict[str, Any]:
    msg = {"goal_id": uuid_of(goal_id), "feedback": {"partial_sequence": list(numbers)}}
    return {"op": "publish", "topic": topic, "msg": msg}


def statuses_in(message: dict[str, Any]) -> dict[str, int]:
    """The statuses in a message, by the base64 text of the goals' IDs."""
    assert (message["op"], set(message)) == ("publish", {"op", "topic", "msg"})
    listed = message["msg"]["status_list"]
    assert all(one["goal_info"]["stamp"]["sec"] > 10**9 for one in listed)
    return {one["goal_info"]["goal_id"]["uuid"]: one["status"] for one in listed}


# Through a server


class Heard:
    """What a client hears of both topics, in whatever order they come."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.feedback: list[Any] = []
        self.statuses: dict[str, int] = {}

    async def next(self) -> None:
        message = await self._client.hear()
        if message["topic"] == FEEDBACK:
            self.feedback.append(message)
        else:
            self.statuses = statuses_in(message)


@asynchronous
async def test_a_client_gets_the_feedback_of_goals_that_others_send(serving: Serving) -> None:
    robot = Robot()
    kind = TYPE.replace("/action", "") + "_FeedbackMessage"
    async with (
        serving(robot.server) as served,
        served.connect() as watcher,
        served.connect() as sender,
    ):
        await sender.say(goal(50))
        await sender.hear_until("action_feedback")
        await sender.hear()
        await watcher.say(op="subscribe", id="s1", topic=STATUS, type="action_msgs/GoalStatusArray")
        (running,) = statuses_in(await watcher.hear())
        await watcher.say(op="subscribe", id="s2", topic=FEEDBACK, type=kind)
        await sender.say(goal(3, id="g2"))
        heard = Heard(watcher)
        while len(heard.feedback) < 2:
            await heard.next()
        uuid = heard.feedback[0]["msg"]["goal_id"]["uuid"]
        goal_id = base64.b64decode(uuid)
        assert heard.feedback == [feedback(goal_id, 0), feedback(goal_id, 0, 3)]
        while heard.statuses != {running: 2, uuid: 4}:
            await heard.next()
        robot.go_on.set()
        while heard.statuses != {running: 4, uuid: 4}:
            await heard.next()
        assert len(heard.feedback) == 2


@asynchronous
async def test_topics_need_the_permission_to_observe(serving: Serving, log: Hearing) -> None:
    def authorize(peer: Peer, action: str, permission: Permission) -> bool:
        return permission is not Permission.OBSERVE

    async with serving(Robot().server, authorize=authorize) as served:
        async with served.connect() as client:
            await client.say(op="subscribe", topic=STATUS)
            await client.say(op="subscribe", topic=FEEDBACK)
            await client.say(goal(1, feedback=False))
            assert (await client.hear())["op"] == "action_result"
    (note,) = [one.getMessage() for one in log.records]
    assert "the topics of the action 'fibonacci' are not served" in note
    assert "may not observe" in note


# By itself


GOAL = b"g" * 16
OTHER = b"o" * 16


def changed(
    number: int, status: GoalStatus, goal_id: bytes = GOAL, feedback_count: int = 0
) -> GoalChanged:
    return GoalChanged(number, goal_id, 5 * 10**18, status, 0, feedback_count)


class Partner:
    """`Topics`, and the session that a test plays."""

    def __init__(self, *, served: bool = True, most_goals: int = 10) -> None:
        endpoints = {"fibonacci": new_server()} if served else {}
        self.now = 0.0
        self.notes: list[str] = []
        self.topics = Topics(endpoints, most_goals, self.notes.append, lambda: self.now)

    def subscribe(self, topic: str = FEEDBACK, **more: Any) -> list[FromClient]:
        return sent(self.topics.subscribe(Subscribe(topic, **more)))

    def unsubscribe(self, topic: str = FEEDBACK, **more: Any) -> list[FromClient]:
        return sent(self.topics.unsubscribe(Unsubscribe(topic, **more)))

    def say(self, message: Any) -> list[FromClient]:
        """Say something as the session, which is nothing to tell the client at once."""
        told = decode_from_server(encode(message))
        assert self.topics.is_about(told)
        assert self.topics.texts_of(told) == []
        return sent(self.topics.take_replies())

    def hear(self, message: Any) -> list[Any]:
        """Say something as the session, and return what the client is told at once."""
        return list(map(json.loads, self.topics.texts_of(message)))

    def taken(self) -> list[Any]:
        return list(map(json.loads, self.topics.take_texts()))


def sent(frames: list[bytes]) -> list[FromClient]:
    return [decode_from_client(frame) for frame in frames]


def watching(partner: Partner, topic: str = FEEDBACK, *known: GoalStatus) -> int:
    """Subscribe to a topic, of an action with these goals; return the number of the request."""
    (watch,) = partner.subscribe(topic)
    assert isinstance(watch, WatchStatus)
    assert partner.say(Watching(watch.id, len(known))) == []
    return watch.id


def followed(partner: Partner, watch: int, goal_id: bytes = GOAL) -> Follow:
    """Tell of a goal that runs, and return the request that follows it."""
    (follow,) = partner.say(changed(watch, GoalStatus.EXECUTING, goal_id))
    assert isinstance(follow, Follow)
    return follow


PAYLOAD = msgspec.msgpack.encode({"partial_sequence": [1]})


def test_goals_that_run_are_followed_from_now_on_and_new_ones_from_their_begin() -> None:
    partner = Partner()
    watch = watching(partner, FEEDBACK, GoalStatus.EXECUTING, GoalStatus.SUCCEEDED)
    (running,) = partner.say(changed(watch, GoalStatus.EXECUTING, GOAL, feedback_count=7))
    assert running == Follow(FIRST_REQUEST + 1, "fibonacci", GOAL, None, False, CREDIT)
    assert partner.say(changed(watch, GoalStatus.SUCCEEDED, b"e" * 16)) == []
    (new,) = partner.say(changed(watch, GoalStatus.ACCEPTED, OTHER))
    assert isinstance(new, Follow)
    assert (new.after, new.own, new.goal_id) == (0, False, OTHER)
    assert partner.say(changed(watch, GoalStatus.EXECUTING, OTHER)) == []
    # One that has ended before it was told is followed all the same: its feedback is kept.
    (short,) = partner.say(changed(watch, GoalStatus.ABORTED, b"s" * 16))
    assert isinstance(short, Follow)
    assert partner.hear(Feedback(new.id, 1, PAYLOAD)) == [feedback(OTHER, 1)]
    assert partner.say(Ended(new.id, GoalStatus.SUCCEEDED, None, "", 1)) == []
    assert partner.hear(Feedback(new.id, 2, PAYLOAD)) == []
    assert partner.say(Failed(short.id, Why.UNKNOWN_GOAL, "forgotten")) == []


def test_statuses_come_as_one_list_when_all_known_goals_were_told() -> None:
    partner = Partner()
    watch = watching(partner, STATUS, GoalStatus.EXECUTING, GoalStatus.ABORTED)
    assert partner.say(changed(watch, GoalStatus.EXECUTING)) == []
    assert not partner.topics.has_texts
    assert partner.taken() == []
    partner.say(changed(watch, GoalStatus.ABORTED, OTHER))
    assert partner.topics.has_texts
    stamp = {"sec": 5 * 10**9, "nanosec": 0}
    listed = [
        {"goal_info": {"goal_id": uuid_of(goal_id), "stamp": stamp}, "status": status}
        for goal_id, status in ((OTHER, 6), (GOAL, 2))
    ]
    assert partner.taken() == [{"op": "publish", "topic": STATUS, "msg": {"status_list": listed}}]
    assert not partner.topics.has_texts
    partner.now = 1
    partner.say(changed(watch, GoalStatus.EXECUTING, GOAL, feedback_count=3))
    assert partner.taken() == []  # nothing is new
    partner.say(changed(watch, GoalStatus.CANCELED))
    (message,) = partner.taken()
    assert list(statuses_in(message).values()) == [6, 5]


def test_goals_that_have_ended_are_in_the_list_up_to_a_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watched_action, "MOST_ENDED", 2)
    partner = Partner()
    watch = watching(partner, STATUS)
    for name in (b"a", b"b", b"c"):
        partner.say(changed(watch, GoalStatus.SUCCEEDED, name * 16))
    (message,) = partner.taken()
    assert list(statuses_in(message)) == [uuid_of(name * 16)["uuid"] for name in (b"b", b"c")]


def test_feedback_that_is_wanted_later_comes_from_then_on() -> None:
    partner = Partner()
    watch = watching(partner, STATUS, GoalStatus.EXECUTING)
    partner.say(changed(watch, GoalStatus.EXECUTING))
    (follow,) = partner.subscribe(FEEDBACK)
    assert isinstance(follow, Follow)
    assert follow.after is None
    assert partner.subscribe(FEEDBACK, id="again") == []
    bare = FEEDBACK.removeprefix("/")
    assert partner.subscribe(bare) == []
    assert partner.hear(Feedback(follow.id, 1, PAYLOAD)) == [
        feedback(GOAL, 1),
        feedback(GOAL, 1, topic=bare),
    ]


def test_the_last_subscription_ends_the_requests() -> None:
    partner = Partner()
    watch = watching(partner, FEEDBACK)
    follow = followed(partner, watch)
    assert partner.subscribe(STATUS, id="s") == []
    assert partner.unsubscribe("/else/_action/status") == []
    assert partner.unsubscribe("/chatter") == []
    assert partner.unsubscribe(STATUS, id="another") == []
    assert partner.unsubscribe(FEEDBACK) == [Received(follow.id)]
    assert partner.hear(Feedback(follow.id, 1, PAYLOAD)) == []
    assert partner.unsubscribe(STATUS, id="s") == [Close(watch)]
    assert partner.say(Finished(watch)) == []
    assert partner.topics.take_texts() == []
    assert (partner.topics._open, partner.topics._actions) == ({}, {})
    (again,) = partner.subscribe(STATUS)
    assert isinstance(again, WatchStatus)


def test_goals_are_followed_up_to_a_number() -> None:
    partner = Partner(most_goals=1)
    watch = watching(partner, FEEDBACK)
    follow = followed(partner, watch)
    assert partner.say(changed(watch, GoalStatus.EXECUTING, OTHER)) == []
    assert partner.notes == ["it follows 1 goals of the action 'fibonacci', and no more"]
    partner.say(Ended(follow.id, GoalStatus.SUCCEEDED, None, "", 1))
    followed(partner, watch, b"n" * 16)


def test_an_action_that_is_not_served_yet_is_waited_for() -> None:
    partner = Partner(served=False)
    (wait,) = partner.subscribe("/later/_action/status", type="any")
    assert wait == AwaitServer(FIRST_REQUEST, "/later")
    (watch,) = partner.say(Done(FIRST_REQUEST))
    assert watch == WatchStatus(FIRST_REQUEST + 1, "/later", CREDIT)


@pytest.mark.parametrize("how", ["finished", "lost"])
def test_a_server_whose_statuses_end_is_asked_again(how: str) -> None:
    partner = Partner()
    watch = watching(partner, STATUS)
    assert partner.subscribe(FEEDBACK) == []
    follow = followed(partner, watch)
    partner.taken()
    lost = Failed(watch, Why.CONNECTION_LOST, "it is gone")
    assert partner.say(Finished(watch) if how == "finished" else lost) == []
    assert not partner.topics.has_texts
    partner.now = RETRY_AFTER
    assert partner.topics.has_texts
    assert partner.taken() == []
    (wait,) = sent(partner.topics.take_replies())
    assert isinstance(wait, AwaitServer)
    assert not partner.topics.has_texts
    (again,) = partner.say(Done(wait.id))
    assert isinstance(again, WatchStatus)
    assert partner.say(Watching(again.id, 1)) == []
    assert partner.say(changed(again.id, GoalStatus.EXECUTING)) == []  # it is followed already
    (message,) = partner.taken()
    assert list(statuses_in(message).values()) == [2]
    assert partner.hear(Feedback(follow.id, 1, PAYLOAD)) == [feedback(GOAL, 1)]


@pytest.mark.parametrize(
    ("topic", "kind", "note"),
    [
        ("/chatter", None, "there are only ACTION/_action/feedback and ACTION/_action/status"),
        ("/_action/status", None, "there are only"),
        (STATUS, "std_msgs/String", "its type is action_msgs/msg/GoalStatusArray, and not"),
        (FEEDBACK, f"{TYPE}_Feedback", f"its type is {TYPE}_FeedbackMessage, and not {TYPE}_Feed"),
    ],
)
def test_what_is_not_a_topic_of_an_action_is_ignored(
    topic: str, kind: str | None, note: str
) -> None:
    partner = Partner()
    assert partner.subscribe(topic, type=kind) == []
    assert note in partner.notes[0]


def test_a_connection_has_a_number_of_subscriptions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(topics, "MOST_SUBSCRIPTIONS", 2)
    partner = Partner()
    watching(partner, STATUS)
    assert partner.subscribe(STATUS, id=1) == partner.subscribe(FEEDBACK) == []
    assert "a connection has at most 2 subscriptions" in partner.notes[0]
    assert len(partner.notes) == 1


def test_credit_is_given_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(topics, "CREDIT", 2)
    partner = Partner()
    watch = watching(partner, FEEDBACK)
    follow = followed(partner, watch)
    assert partner.say(changed(watch, GoalStatus.CANCELING)) == [Credit(watch, 2)]
    partner.hear(Feedback(follow.id, 1, PAYLOAD))
    partner.hear(Feedback(follow.id, 2, PAYLOAD))
    assert partner.topics.has_texts
    assert sent(partner.topics.take_replies()) == [Credit(follow.id, 2)]


def test_feedback_that_json_cannot_express_is_left_out() -> None:
    partner = Partner()
    watch = watching(partner, FEEDBACK)
    follow = followed(partner, watch)
    assert partner.hear(Feedback(follow.id, 1, b"\xc1")) == []
    assert "feedback of the action 'fibonacci' is left out" in partner.notes[0]
