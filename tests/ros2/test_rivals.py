"""Two servers of one name: each of them runs every goal, and a client is told."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

from fibaction import ActionClient, ActionServer, GoalHandle, GoalID, connect, serve
from fibaction.words.goals import GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2.client import followed_goals, service_client
from fibaction_transports.ros2.client.action_client import RosActionClient
from fibaction_transports.ros2.client.goal_stream import RosGoalStream
from fibaction_transports.ros2.convert.status_bytes import pack_line, pack_statuses, stamps_of
from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.node.rivals import Rivals
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.server.action_server import RosActionServer
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.ros2.ends import Items, Undecoded, client_of, new_url, tells_publishers
from tests.ros2.stock.waiting import eventually
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.processes import PATIENCE

pytestmark = pytest.mark.anyio

MESSAGES = 20
WARNING = "there are 2 servers of this name, and each of them runs every goal"
OF_ONE, OF_ALL = "feedback is taken of one server", "feedback comes from all of them"


def tagged(tag: int, tags: dict[int, int]) -> ActionServer[Goal, Feedback, Result]:
    """Make a server whose feedback is its tag, which it notes by the stamp of each goal."""

    async def execute(goal: GoalHandle[Goal]) -> Items:
        tags[goal.stamp] = tag
        for _ in range(MESSAGES):
            yield Feedback([tag])
            await anyio.sleep(0.001)
        yield Result([tag])

    return ActionServer(FIBONACCI, execute)


async def both_servers_of(client: ActionClient[Goal, Feedback, Result]) -> None:
    """Wait until the client has found two servers, and the nodes of their topics."""
    presence = client_of(client.endpoint).presence
    ros, names = presence._ros, presence._names

    async def servers() -> tuple[bool, int, int]:
        ends = [*ros.publishers(names.status), *ros.publishers(names.feedback)]
        return presence.is_there(), len(presence.servers()), sum(bool(one.node) for one in ends)

    await eventually(servers, lambda found: found == (True, 2, 4))


@asynccontextmanager
async def client_of_two(
    tags: dict[int, int], first: str = "one", second: str = "two"
) -> AsyncGenerator[ActionClient[Goal, Feedback, Result], None]:
    """Serve the action on two nodes of these names, and give a client that has found both."""
    url = new_url()
    async with (
        serve(tagged(1, tags), url.replace("//", f"//{first}")),
        serve(tagged(2, tags), url.replace("//", f"//{second}")),
        connect(url, FIBONACCI) as client,
    ):
        await both_servers_of(client)
        yield client


@pytest.mark.parametrize("names", ["one name", "two names"])
async def test_feedback_is_taken_of_the_server_that_accepted_the_goal_and_the_log_warns_once(
    names: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.ros2.node.rivals.LEASES_BEFORE_WARNING", 0.0)
    tells = tells_publishers()
    tags: dict[int, int] = {}
    first, second = ("robot", "robot") if names == "one name" else ("one", "two")
    with anyio.fail_after(PATIENCE):
        async with client_of_two(tags, first, second) as client:
            for _ in range(2):
                goal = await client.send_goal(Goal(1))
                await goal.outcome()
                seen = {one.partial_sequence[0] async for one in goal.feedback}
                assert tags[goal.stamp] in seen
                assert len(seen) == 1 or not tells
    assert caplog.text.count(WARNING) == 1


@pytest.mark.parametrize("lists", ["late", "lost"])
async def test_feedback_waits_a_while_for_status_lists_that_come_after_the_result(
    lists: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tells = tells_publishers()
    if tells and lists == "late":
        monkeypatch.setattr(followed_goals, "LATE", PATIENCE)
    held: list[Any] = []
    take = RosActionClient._take_statuses
    monkeypatch.setattr(RosActionClient, "_take_statuses", lambda _, *item: held.append(item))
    tags: dict[int, int] = {}

    with anyio.fail_after(PATIENCE):
        async with client_of_two(tags) as client:
            goal = await client.send_goal(Goal(1))
            await goal.outcome()
            if lists == "late":
                while len({of for message, of in held if goal.goal_id in message}) < 1 + tells:
                    await anyio.lowlevel.checkpoint()
                for item in held:
                    take(client_of(client.endpoint), *item)
            seen = {one.partial_sequence[0] async for one in goal.feedback}
    assert tags[goal.stamp] in seen
    assert len(seen) == 1 or not tells or lists == "lost"


async def test_a_goal_that_was_found_in_a_status_list_gets_the_feedback_of_the_server_of_that_list(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Both answers are lost, and the list of the server with the later stamp arrives first."""
    if not tells_publishers():
        return  # nothing tells the two servers apart
    monkeypatch.setattr(service_client, "FIRST_TIMEOUT", PATIENCE)
    answer = RosActionServer._answer_goal
    take = RosActionClient._take_statuses
    held: list[tuple[int, bytes, bytes]] = []
    tags: dict[int, int] = {}
    goals: list[Any] = []

    async def answers_nothing(self: RosActionServer, request: Any) -> None:
        await answer(self, request)

    def holds(self: RosActionClient, message: bytes, publisher: bytes) -> None:
        if stamps := stamps_of(message):
            held.append((max(stamps.values()), message, publisher))

    async def send(client: ActionClient[Goal, Feedback, Result]) -> None:
        goals.append(await client.send_goal(Goal(1)))

    monkeypatch.setattr(RosActionServer, "_answer_goal", answers_nothing)
    monkeypatch.setattr(RosActionClient, "_take_statuses", holds)
    with anyio.fail_after(PATIENCE):
        async with client_of_two(tags) as client:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(send, client)
                while len({publisher for *_, publisher in held}) < 2:
                    await anyio.lowlevel.checkpoint()
                latest_first = sorted(held, reverse=True)
                take(client_of(client.endpoint), *latest_first[0][1:])
            for _, *item in latest_first:
                take(client_of(client.endpoint), *item)
            (goal,) = goals
            await goal.outcome()
            seen = {one.partial_sequence[0] async for one in goal.feedback}
    assert goal.stamp == max(tags)
    assert seen == {tags[goal.stamp]}


def test_unread_feedback_of_another_server_is_dropped_and_the_rest_numbered_anew() -> None:
    stream = RosGoalStream(GoalID.random(), Undecoded(), 10, reads=True)
    for message, publisher in ((b"a", b"one"), (b"b", b"two"), (b"c", b"one"), (b"d", b"")):
        stream.add_feedback(message, publisher)
    (first,) = stream.take()

    stream.take_from(frozenset({b"one"}))
    stream.take_from(frozenset())  # nothing is known of other publishers now
    stream.add_feedback(b"e", b"two")
    stream.add_feedback(b"f", b"one")

    taken = [first, *stream.take(10)]
    assert [(one.number, one.payload) for one in taken] == [  # type: ignore[union-attr]
        (1, b"a"),
        (2, b"c"),
        (3, b"d"),
        (4, b"f"),
    ]
    assert stream.dropped == 0


class Node:
    """The ends of the topics of two servers in one context, which have one name."""

    def __init__(self, *ends: Any) -> None:
        self.looks = 0
        self._ends = ends

    def publishers(self, topic: str) -> list[EndInfo]:
        self.looks += 1
        return [EndInfo(end.gid, end.node, EndQos()) for end in self._ends if end.topic == topic]


class End:
    def __init__(self, topic: str, gid: bytes, node: str = "robot") -> None:
        self.topic, self.gid, self.node = topic, gid, f"/{node}" if node else ""


class Names:
    status, feedback = "status", "feedback"


def listed(goal_id: GoalID, stamp: int) -> bytes:
    return pack_statuses([pack_line(GoalInfo(goal_id, stamp, GoalStatus.ACCEPTED))])


async def test_the_server_with_the_nearest_stamp_has_the_goal() -> None:
    one, two = b"participant1one.", b"participant2two."
    node: Any = Node(
        End("status", one),
        End("status", two),
        End("feedback", b"participant1fb.."),
        End("feedback", b"participant2fb.."),
    )
    names: Any = Names()
    rivals = Rivals(node, "arm", names, 2.0)
    goal_id = GoalID.random()

    rivals.note(frozenset({one}), 1)
    rivals.note_list(one, listed(goal_id, 90))  # one server alone is not compared
    assert rivals.feedback_of(goal_id, 100) == frozenset()

    rivals.note(frozenset({one, two}), 2)
    rivals.note_list(one, listed(goal_id, 90))
    assert rivals.feedback_of(GoalID.random(), 100) == frozenset()
    assert rivals.feedback_of(goal_id, 100) == frozenset()  # the other one may be nearer
    assert rivals.feedback_of(goal_id, 90) == {b"participant1fb.."}
    assert rivals.feedback_of(goal_id, 90) == {b"participant1fb.."}  # kept, and not looked up
    assert node.looks == 2
    rivals.note_list(two, listed(goal_id, 105))
    assert rivals.feedback_of(goal_id, 100) == {b"participant2fb.."}

    rivals.note(frozenset({one}), 1)
    assert rivals.feedback_of(goal_id, 100) == frozenset()


async def test_without_participants_in_the_ids_the_nodes_tell_servers_apart() -> None:
    one, two = b"abcdefghijklmnop", b"bcdefghijklmnopq"
    node: Any = Node(
        End("status", one, "one"),
        End("status", two, "two"),
        End("feedback", b"cdefghijklmnopqr", "one"),
        End("feedback", b"defghijklmnopqrs", "two"),
    )
    names: Any = Names()
    rivals = Rivals(node, "arm", names, 2.0)
    goal_id = GoalID.random()

    rivals.note(frozenset({one, two}), 1)
    rivals.note_list(one, listed(goal_id, 90))
    rivals.note_list(two, listed(goal_id, 101))

    assert rivals.feedback_of(goal_id, 100) == {b"defghijklmnopqrs"}


async def test_before_the_nodes_are_known_no_feedback_is_taken_for_that_of_another_server() -> None:
    one, two = b"participant1one.", b"participant2two."
    ends = [
        End("status", one, ""),
        End("status", two, ""),
        End("feedback", b"participant2fb..", ""),
    ]
    node: Any = Node(*ends)
    names: Any = Names()
    rivals = Rivals(node, "arm", names, 2.0)
    goal_id = GoalID.random()

    rivals.note(frozenset({one, two}), 2)
    rivals.note_list(one, listed(goal_id, 90))
    rivals.note_list(two, listed(goal_id, 105))
    assert rivals.feedback_of(goal_id, 90) == frozenset()

    ends[0].node = ends[1].node = ends[2].node = "/robot"
    node._ends = (*ends, End("feedback", b"participant1fb.."))
    assert rivals.feedback_of(goal_id, 90) == {b"participant1fb.."}


async def test_a_second_server_that_is_soon_silent_causes_no_warning(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that was killed, beside the one that took its place."""
    clock = [0.0]
    monkeypatch.setattr("fibaction_transports.ros2.node.rivals.current_time", lambda: clock[0])
    node: Any = Node()
    names: Any = Names()
    rivals = Rivals(node, "arm", names, 2.0)
    both = frozenset({b"one", b"two"})

    for clock[0], count in ((0.0, 2), (1.9, 2), (2.1, 1), (3.0, 2), (6.9, 2)):
        rivals.note(both, count)
    assert caplog.text == ""
    for clock[0] in (7.0, 8.0):
        rivals.note(both, 2)
    assert caplog.text.count(WARNING) == 1


@pytest.mark.parametrize(("publisher", "told"), [(b"one", OF_ONE), (b"", OF_ALL)])
async def test_the_warning_says_whose_feedback_the_client_gets(
    publisher: bytes, told: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fibaction_transports.ros2.node.rivals.LEASES_BEFORE_WARNING", 0.0)
    node: Any = Node()
    names: Any = Names()
    rivals = Rivals(node, "arm", names, 2.0)

    rivals.note_list(publisher, listed(GoalID.random(), 1))
    rivals.note(frozenset({b"one", b"two"}), 2)

    assert told in caplog.text
