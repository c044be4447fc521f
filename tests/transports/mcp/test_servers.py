"""Servers that come and go, several of them, and what cannot be used."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionError,
    ActionInfo,
    ActionServer,
    ConnectionLost,
    GoalHandle,
    InvalidURL,
    ServerFailed,
    ServerNotFound,
    serve,
)
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Connection, Endpoint, GoalRequest, Transport
from fibaction.observe import followed_servers
from fibaction.words.goals import UNKNOWN_OUTCOME, GoalID, GoalInfo, Parent
from fibaction.words.statuses import GoalStatus
from fibaction_transports._agents import robot_actions
from fibaction_transports._agents.agent_goals import AgentGoal, AgentGoals
from fibaction_transports.inprocess import InProcessTransport
from fibaction_transports.mcp import AgentPolicy, McpBridge
from fibaction_transports.mcp.answers import goal_answer, overview
from tests.cli.served import Served, counter
from tests.support.processes import PATIENCE
from tests.transports.driving_robot import DRIVE, Drive
from tests.transports.mcp.robot import (
    MODES,
    UNASKED,
    Mode,
    Robot,
    Talk,
    robot_and_talk,
    sent_by_others,
    talk,
)

pytestmark = pytest.mark.asyncio
both = pytest.mark.parametrize("mode", MODES)


async def until(news: Notifier, condition: Callable[[], object]) -> None:
    """Wait until the condition holds, which may begin to at the news."""
    with anyio.fail_after(PATIENCE):
        while not condition():
            await news.wait()


class Asked(Served):
    """A connection that tells when it is asked for its actions."""

    def __init__(self, news: Notifier, *servers: Any) -> None:
        super().__init__(*servers)
        self._news = news

    async def actions(self) -> list[ActionInfo]:
        self._news.notify()
        return await super().actions()


class Far(Transport):
    """A server far away, whose connections are what the test says."""

    def __init__(self, *servers: Any) -> None:
        self.asked = Notifier()
        """Told when it is asked for anything: then what came before has been noted."""
        self.connection: Served = Asked(self.asked, *servers)
        self.error: ActionError | None = None
        """The reason why no connection can be opened."""
        self.times = 0
        """The number of connections that were opened."""

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> Far:
        raise NotImplementedError

    def serve(self, *endpoints: Endpoint) -> Any:
        raise NotImplementedError

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        self.asked.notify()
        if self.error is not None:
            raise self.error
        self.times += 1
        yield self.connection


# They come and go


@both
async def test_clients_are_told_when_actions_come_and_go(mode: Mode) -> None:
    robot = Robot()
    async with (
        serve(robot.count, robot.here),
        McpBridge(robot.here, UNASKED) as bridge,
        talk(bridge, mode) as made,
    ):
        own = ["send_goal", "goal_status", "cancel_goal"]
        assert await made.tools() == ["count", *own]
        listening = await listen(made)
        async with serve(robot.drive, robot.here):
            await told(made, listening)
            assert await made.tools() == ["arm-drive", "count", *own]
            assert (await made.data("arm-drive", meters=1))["status"] == "SUCCEEDED"
        await told(made, listening)
        assert await made.tools() == ["count", *own]
        assert "no tool 'arm-drive' now" in await made.error("arm-drive", meters=1)
        if listening is not None:
            await listening.__aexit__(None, None, None)


async def listen(made: Talk) -> Any:
    """Ask for changes of the list; None where they are told without being asked for."""
    if made.client.protocol_version < "2026":
        return None
    listening = made.client.listen(tools_list_changed=True)
    await listening.__aenter__()
    return listening


async def told(made: Talk, listening: Any) -> None:
    """Wait until the client is told that the list has changed."""
    with anyio.fail_after(PATIENCE):
        await made.told.wait()
    made.told = anyio.Event()


@both
async def test_a_server_may_die_and_come_back(mode: Mode) -> None:
    robot = Robot()
    far = Far(robot.drive)
    async with robot.drive, McpBridge(far, UNASKED) as bridge, talk(bridge, mode) as made:
        assert (await made.data("arm-drive", meters=1))["status"] == "SUCCEEDED"
        far.connection.error = ConnectionLost("the line was cut")
        far.error = ServerNotFound("no server listens there")
        await until(far.asked, lambda: bridge.problems == {"": "no server listens there"})
        # The tool is still there, and its goal gets an answer.
        assert "arm-drive" in await made.tools()
        (server,) = (await made.data("goal_status"))["servers"]
        assert server == {"reachable": False, "problem": "no server listens there"}
        assert "The server cannot be reached: no server listens there." in await made.error("fly")
        far.connection.error = far.error = None
        await until(far.asked, lambda: not bridge.problems)
        assert far.times == 2
        assert (await made.data("arm-drive", meters=1))["status"] == "SUCCEEDED"
        assert robot.sent == [Drive(1), Drive(1)]


async def test_a_server_that_is_not_there_at_the_start_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(followed_servers, "FIRST_LOOK", 0.01)
    monkeypatch.setattr(followed_servers, "LOOK_TIMEOUT", 0.02)
    robot = Robot()
    far = Far(robot.drive)
    far.connection.silent = True
    async with robot.drive, McpBridge(far, UNASKED) as bridge:
        assert bridge.tools == ["send_goal", "goal_status", "cancel_goal"]
        await until(far.asked, lambda: bridge.problems == {"": "it does not answer"})
        far.connection.silent = False
        far.connection.error = ServerFailed("it has a bug")
        await until(far.asked, lambda: bridge.problems == {"": "it has a bug"})
        far.connection.error = None
        await until(far.asked, lambda: not bridge.problems)
        assert "arm-drive" in bridge.tools
        assert far.times == 1
    texts = [record.getMessage() for record in caplog.records]
    assert texts == [
        "the server: it does not answer",
        "the server: it has a bug",
        "the server: it answers again",
    ]


async def test_an_action_that_is_another_one_now_is_another_tool() -> None:
    here = InProcessTransport()
    async with McpBridge(here, UNASKED) as bridge, talk(bridge, "auto") as made:
        news = bridge._tools._actions.news
        async with serve(counter("one", [1, "done"]), here):
            await until(news, lambda: "one" in bridge.tools)
            assert (await made.data("one", goal=1))["result"] == "done"
        await until(news, lambda: "one" not in bridge.tools)

        async def say(goal: GoalHandle[Drive]) -> AsyncGenerator[int | str, None]:
            yield f"{goal.request.meters} m"

        other = Action("one", goal=Drive, feedback=int, result=str)
        async with serve(ActionServer(other, say), here):
            await until(news, lambda: "one" in bridge.tools)
            assert (await made.data("one", meters=2))["result"] == "2 m"


# What cannot be used


async def test_what_cannot_be_used_is_left_out_and_said_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot_actions, "MOST_ACTIONS", 2)
    far = Far(*map(counter, ("one", "broken", "two", "three")))
    far.connection.unusable.add("broken")
    evil: Any = Described(counter("one"), {"$ref": "http://evil.example"})
    far.connection.servers["one"] = evil
    async with McpBridge(far) as bridge:
        for _ in range(3):
            await far.asked.wait()
        assert bridge.tools[:2] == ["three", "two"]
    texts = [record.getMessage() for record in caplog.records]
    assert len(texts) == 2
    assert texts[0].startswith("action one is left out: the schema of the goal ")
    assert texts[1] == "action broken is left out: the type of broken is not installed"


class Described:
    """The description of a server's action, with another schema of its goals."""

    def __init__(self, server: Any, goal: dict[str, Any]) -> None:
        self.info = msgspec.structs.replace(server.info, goal=goal)


async def test_only_so_many_actions_become_tools(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot_actions, "MOST_ACTIONS", 1)
    async with McpBridge(Far(counter("one"), counter("two"), counter("three"))) as bridge:
        assert bridge.tools[0] == "one"
        assert len(bridge.tools) == 4
    texts = [record.getMessage() for record in caplog.records]
    assert texts == ["action two is left out: only 1 actions are shown"]


async def test_names_that_clash_get_digits() -> None:
    async with McpBridge(Far(counter("a/b"), counter("/a/b"), counter("send_goal"))) as bridge:
        first, second, third, *own = bridge.tools
        assert first == "a-b"
        assert second.startswith("a-b_")
        assert third.startswith("send_goal_")
        assert own == ["send_goal", "goal_status", "cancel_goal"]


# Several servers


async def test_the_tools_of_several_servers_have_their_names() -> None:
    left, right = Robot(), Robot()
    policy = AgentPolicy(allow=("left:*", "count"), unasked=("left:arm/*",))
    async with (
        serve((left.drive, left.count), left.here),
        serve((right.drive, right.count), right.here),
        McpBridge({"left": left.here, "right": right.here}, policy) as bridge,
        talk(bridge, "auto") as made,
    ):
        assert await made.tools() == [
            "left-arm-drive",
            "left-count",
            "right-count",
            "send_goal",
            "goal_status",
            "cancel_goal",
        ]
        await made.data("left-arm-drive", meters=2)
        assert (left.sent, right.sent) == ([Drive(2)], [])
        assert "must agree" in await made.error("right-count", goal=1)
        told = await made.data("goal_status")
        assert told["servers"] == [
            {"name": "left", "reachable": True},
            {"name": "right", "reachable": True},
        ]
        assert [one["server"] for one in told["actions"]] == ["left", "left", "right"]
        tools = {tool.name: tool for tool in (await made.client.list_tools()).tools}
        assert tools["left-arm-drive"].title == "arm/drive of left"


async def test_the_problems_of_several_servers_are_told_by_their_names() -> None:
    robot, far = Robot(), Far()
    far.error = ServerNotFound("it is off")
    async with (
        serve(robot.drive, robot.here),
        McpBridge({"left": robot.here, "right": far}, UNASKED) as bridge,
        talk(bridge, "auto") as made,
    ):
        assert bridge.problems == {"right": "it is off"}
        text = await made.error("fly")
        assert text.endswith(
            "there are left-arm-drive. The server right cannot be reached: it is off."
        )


@pytest.mark.parametrize(
    ("servers", "error", "text"),
    [
        ({}, ValueError, "at least one server"),
        ({"": "tcp://h:1", "b": "tcp://h:2"}, ValueError, "letters, digits and _, not ''"),
        ({"a b": "tcp://h:1"}, ValueError, "letters, digits and _, not 'a b'"),
        ("nonsense", InvalidURL, "is not a URL"),
    ],
)
async def test_servers_are_checked_at_once(servers: Any, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        McpBridge(servers)


# Goals when something is lost


async def test_a_goal_that_cannot_be_sent_says_why() -> None:
    class Broken(Served):
        error_of_goal: ActionError

        def endpoint(self, action: Any) -> Endpoint:
            broken = self

            class Sends(type(super().endpoint(action))):  # type: ignore[misc]  # of the server
                def __init__(self) -> None:
                    pass

                async def offer_goal(self, request: GoalRequest) -> Any:
                    raise broken.error_of_goal

            return Sends()

    far = Far()
    broken = far.connection = Broken(counter("one"))
    async with McpBridge(far, UNASKED) as bridge, talk(bridge, "auto") as made:
        broken.error_of_goal = ConnectionLost("the line was cut")
        assert await made.error("one", goal=1) == (
            "The connection was lost, and the goal may have been accepted: the line was cut. Call"
            " goal_status without a goal_id before you send it again."
        )
        broken.error_of_goal = ServerNotFound("it is off")
        assert await made.error("one", goal=1) == "The goal was not sent: it is off"


async def test_a_goal_that_was_lost_is_found_again_when_it_is_asked_about(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with robot_and_talk("auto", UNASKED) as (robot, made):
        sent = await made.data("send_goal", tool="arm-drive", goal={"meters": 100})
        await robot.waits.wait()
        goals = made.bridge._tools._calls._goals._goals
        (goal,) = goals.values()
        goal.stream.fail(ConnectionLost("the line was cut"))
        await goal.ended.wait()
        found = await made.data("goal_status", goal_id=sent["goal_id"])
        assert found["status"] == "EXECUTING"
        assert found["feedback"] == {"meters": 1}
        # It is still an own goal, for which the user is not asked.
        assert (await made.data("cancel_goal", goal_id=sent["goal_id"]))["status"] == "CANCELED"

        sent = await made.data("send_goal", tool="arm-drive", goal={"meters": 100})
        goal = goals[GoalID.parse(sent["goal_id"])]
        goal.stream.fail(ConnectionLost("the line was cut"))
        await goal.ended.wait()

        async def no_goals(_: Any) -> dict[Any, Any]:
            return {}

        monkeypatch.setattr(AgentGoals, "listed", no_goals)
        text = await made.error("goal_status", goal_id=sent["goal_id"])
        assert text.startswith(
            "The goal cannot be followed any more, and may continue: the line was cut. Call"
        )


async def test_a_goal_that_ends_badly_for_the_bridge_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with robot_and_talk("auto", UNASKED) as (robot, made):
        other = await sent_by_others(robot, 100)
        await robot.waits.wait()

        async def lost(*_: Any, **__: Any) -> Any:
            raise ConnectionLost("the line was cut")

        with monkeypatch.context() as patch:
            (action, _) = made.bridge._tools._actions.by_label.values()
            patch.setattr(action.endpoint, "feedback", lost)
            text = await made.error("goal_status", goal_id=str(other.goal_id))
            assert text == "The goal cannot be followed: the line was cut"
            patch.setattr(action.endpoint, "status", lost)
            told = await made.data("goal_status")
            assert told["actions"][0]["problem"] == "its server does not tell its goals"
        with monkeypatch.context() as patch:
            patch.setattr(AgentGoal, "cancel", lost)
            text = await made.error("cancel_goal", goal_id=str(other.goal_id))
            assert text == "The goal was not canceled, and may continue: the line was cut"
        await other.cancel()


async def test_a_cancel_of_a_call_while_the_server_is_away_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with robot_and_talk("auto", UNASKED) as (robot, made):
        tried = anyio.Event()

        async def lost(*_: Any) -> Any:
            tried.set()
            raise ConnectionLost("the line was cut")

        with anyio.fail_after(PATIENCE), monkeypatch.context() as patch:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(lambda: made.call("arm-drive", meters=100))
                await robot.waits.wait()
                (action, _) = made.bridge._tools._actions.by_label.values()
                patch.setattr(action.endpoint, "cancel_goals", lost)
                tasks.cancel_scope.cancel()
            await tried.wait()
        assert not robot.stopped.is_set()
        await robot.drive.cancel_goals()
    (record,) = caplog.records
    assert record.getMessage().endswith("was left, but could not be canceled: the line was cut")


async def test_an_unknown_outcome_is_an_error() -> None:
    async with robot_and_talk("auto", UNASKED) as (_, made):
        sent = await made.data("count", goal=1)
        goal = made.bridge._tools._calls._goals._goals[GoalID.parse(sent["goal_id"])]
        goal.outcome = UNKNOWN_OUTCOME
        assert goal_answer(goal).is_error


async def test_a_goal_is_reported_with_its_client_and_its_parent_if_they_are_known() -> None:
    async with robot_and_talk("auto") as (_, made):
        (action, _) = made.bridge._tools._actions.by_label.values()
        root = GoalInfo(GoalID.random(), 10**18, GoalStatus.EXECUTING, client="kitchen")
        child = msgspec.structs.replace(root, client="", parent=Parent(GoalID(bytes(16)), "lift\n"))
        (told,) = overview({}, [action], {action: [root, child]})["actions"]
        assert told["action"] == DRIVE.name
        one, other = told["goals"]
        assert (one["client"], "parent" in one) == ("kitchen", False)
        assert other["parent"] == {"goal_id": "0" * 32, "step": "lift\\x0a"}
