"""Types that a client learns from the nodes that serve an action, without their files."""

from __future__ import annotations

import re
import uuid
from collections.abc import AsyncGenerator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import anyio
import pytest

from fibaction import (
    Action,
    ActionServer,
    ConnectionLost,
    GoalHandle,
    TransportError,
    connect,
    serve,
)
from fibaction.interfaces.files import ActionFile, read_action
from fibaction.interfaces.structs import make_structs
from fibaction.types.action import ActionInfo
from fibaction_transports.ros2 import DdsTransport
from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.node.ros_node import NodeLife, RosNode
from fibaction_transports.ros2.on_dds import graph
from fibaction_transports.ros2.on_dds.type_questions import TypeQuestions
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.descriptions import type_learner
from fibaction_transports.ros2.without_ros.descriptions.described_types import (
    GET_TYPE_DESCRIPTION,
    DescriptionRequest,
    DescriptionResponse,
)
from fibaction_transports.ros2.without_ros.messages import file_types
from fibaction_transports.ros2.without_ros.messages.file_types import (
    FileTypes,
    InterfaceFiles,
    ServerVersion,
)
from fibaction_transports.ros2.without_ros.messages.message_type import TypeHashes, read_hashes
from fibaction_transports.ros2.without_ros.own_node import TypeRegistry
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio

pytestmark = pytest.mark.anyio

PATIENCE = 20.0
PAINT = "far_msgs/action/Paint"
TEXT = "Spot spot\n---\nint32 spots\n---\n# So far.\nSpot[] painted\nfloat32 share 0.5\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the files of an action, which only its server knows."""
    for name, text in (("action/Paint.action", TEXT), ("msg/Spot.msg", "int32 x 7\nint32 y\n")):
        path = tmp_path / "far_msgs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


@pytest.fixture
def as_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no endpoint announce the hash of an action, as those of ROS do not."""

    def read(user_data: bytes) -> TypeHashes:
        return TypeHashes(read_hashes(user_data).of_type, "")

    monkeypatch.setattr(graph, "read_hashes", read)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[DescriptionRequest]:
    """The requests that all nodes have answered."""
    found: list[DescriptionRequest] = []
    plain = TypeRegistry.answer

    def answer(registry: TypeRegistry, request: DescriptionRequest) -> DescriptionResponse:
        found.append(request)
        return plain(registry, request)

    monkeypatch.setattr(TypeRegistry, "answer", answer)
    return found


@asynccontextmanager
async def painting(folder: Path, name: str) -> AsyncGenerator[anyio.Event, None]:
    """Serve the action; its goals begin when the event is set."""
    begun = anyio.Event()
    structs = make_structs(read_action(folder / f"{PAINT}.action"))
    action = Action(
        name,
        goal=structs["Paint_Goal"],
        feedback=structs["Paint_Feedback"],
        result=structs["Paint_Result"],
        type_name=PAINT,
    )

    async def paint(goal: GoalHandle[Any]) -> AsyncGenerator[Any, None]:
        await begun.wait()
        yield structs["Paint_Feedback"](painted=[goal.request.spot])
        yield structs["Paint_Result"](spots=goal.request.spot.x)

    with anyio.fail_after(PATIENCE):
        async with serve(ActionServer(action, paint), DdsTransport(search=[str(folder)])):
            yield begun


async def found(connection: Any, name: str) -> ActionInfo:
    (info,) = [one for one in await connection.actions() if one.name == name]
    assert isinstance(info, ActionInfo)
    return info


def new_name() -> str:
    return f"paint_{uuid.uuid4().hex}"


async def test_an_action_of_fibaction_is_described_by_its_server_and_takes_goals(
    folder: Path, asked: list[DescriptionRequest]
) -> None:
    name = new_name()
    async with painting(folder, name) as begun, connect(DdsTransport()) as connection:
        begun.set()
        info = await found(connection, name)
        assert info.type_name == PAINT
        feedback_schema = info.feedback["$defs"]["Paint_Feedback"]
        assert feedback_schema["description"] == "So far."
        assert feedback_schema["properties"]["share"]["default"] == 0.5
        client = connection.client(Action.untyped(info))
        async with client.send_goal({"spot": {"y": 1}}) as goal:
            feedback = [one async for one in goal.feedback]
            assert await goal.result() == {"spots": 7}
        assert feedback == [{"painted": [{"x": 7, "y": 1}], "share": 0.5}]
        assert await found(connection, name) == info
        texts = await connection.interface_texts(info)
        assert texts == {PAINT: TEXT, "far_msgs/msg/Spot": "int32 x 7\nint32 y\n"}
    assert [one.type_name for one in asked] == [PAINT]


async def test_an_action_of_which_only_feedback_is_told_is_followed(
    folder: Path, as_rclpy: None, asked: list[DescriptionRequest]
) -> None:
    name = new_name()
    async with (
        painting(folder, name) as begun,
        connect(DdsTransport(search=[str(folder)])) as knowing,
        connect(DdsTransport()) as connection,
    ):
        info = await found(connection, name)
        assert (info.goal, info.result) == ({}, {})
        assert "Paint_Feedback" in info.feedback["$defs"]
        client = connection.client(Action.untyped(info))
        whole = knowing.client(Action.untyped(await found(knowing, name)))
        await client.wait_for_server(PATIENCE)
        async with whole.send_goal({"spot": {"x": 3}}) as goal:
            followed = await client.attach(goal.goal_id)
            begun.set()
            seen = [one async for one in followed.feedback]
            assert seen == [{"painted": [{"x": 3, "y": 0}], "share": 0.5}]
            assert await followed.result() is None
            assert await goal.result() == {"spots": 3}
        with pytest.raises(TransportError) as caught:
            await client.send_goal({"spot": {"x": 3}})
        assert str(caught.value).startswith(
            f"the goal and the result of {PAINT} are not known here: put {PAINT}.action beside"
            " your program, or into a folder, and name that folder with search=FOLDER"
        )
        with pytest.raises(TransportError) as told:
            await connection.interface_texts(info)
        assert str(told.value) == str(caught.value)
        assert (await knowing.interface_texts(info))[PAINT] == TEXT
    assert [one.type_name for one in asked] == [f"{PAINT}_FeedbackMessage"]


async def test_the_name_of_an_action_is_enough_if_its_file_is_found_here(folder: Path) -> None:
    name = new_name()
    async with (
        painting(folder, name) as begun,
        connect(DdsTransport(search=[str(folder)])) as connection,
    ):
        begun.set()
        await connection.peers(name)
        client = connection.client(Action.untyped(ActionInfo(name)))
        await client.wait_for_server(PATIENCE)
        assert await client.call({"spot": {"x": 4}}) == {"spots": 4}


async def test_users_types_for_a_goal_that_is_not_known_are_an_error(
    folder: Path, as_rclpy: None
) -> None:
    name = new_name()
    async with painting(folder, name), connect(DdsTransport()) as connection:
        await found(connection, name)
        typed = Action(name, goal=int, feedback=dict, result=str, type_name=PAINT)
        with pytest.raises(TransportError, match="the goal and the result of far_msgs/action/Pain"):
            connection.client(typed)


async def test_an_action_of_which_nothing_is_told_is_followed_to_its_end_and_nobody_is_asked(
    folder: Path, monkeypatch: pytest.MonkeyPatch, asked: list[DescriptionRequest]
) -> None:
    monkeypatch.setattr(graph, "read_hashes", lambda user_data: TypeHashes())
    name = new_name()
    async with (
        painting(folder, name) as begun,
        connect(DdsTransport(search=[str(folder)])) as knowing,
        connect(DdsTransport()) as connection,
    ):
        info = await found(connection, name)
        assert info == ActionInfo(name, PAINT)
        client = connection.client(Action.untyped(info))
        assert connection.endpoint(info).info == info
        whole = knowing.client(Action.untyped(await found(knowing, name)))
        await client.wait_for_server(PATIENCE)
        async with whole.send_goal({"spot": {"x": 3}}) as goal:
            followed = await client.attach(goal.goal_id)
            begun.set()
            assert [one async for one in followed.feedback] == [None]
            assert await followed.result() is None
            assert await goal.result() == {"spots": 3}
        missing = f"{PAINT} is not known here: put {PAINT}.action beside your program"
        with pytest.raises(TransportError, match=missing):
            await client.send_goal({"spot": {"x": 3}})
        with pytest.raises(TransportError, match=missing):
            await connection.interface_texts(info)
        typed = Action(name, goal=int, feedback=dict, result=str, type_name=PAINT)
        with pytest.raises(TransportError, match=missing):
            connection.client(typed)
    assert asked == []


def test_an_unknown_action_is_one_object_and_few_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_types, "MOST_LEARNED", 1)
    types = FileTypes()
    one = types.find_to_follow(PAINT)
    assert types.find_to_follow(PAINT) is one
    assert one.info("paint") == ActionInfo("paint", PAINT)
    types.find_to_follow("far_msgs/action/Draw")
    assert types.find_to_follow(PAINT) is not one
    with pytest.raises(TransportError, match="give the Action 'paint' a type_name"):
        types.find_to_follow("Paint", "paint")


@pytest.mark.parametrize(
    "response",
    [
        DescriptionResponse(failure_reason="no"),
        DescriptionResponse(failure_reason="x" * 2**20),
    ],
    ids=["a failure", "an answer that is too large"],
)
async def test_a_publisher_that_does_not_answer_as_it_should_is_asked_once(
    response: DescriptionResponse,
    folder: Path,
    as_rclpy: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    requests: list[DescriptionRequest] = []

    def answer(registry: TypeRegistry, request: DescriptionRequest) -> DescriptionResponse:
        requests.append(request)
        return response

    monkeypatch.setattr(TypeRegistry, "answer", answer)
    name = new_name()
    async with painting(folder, name), connect(DdsTransport()) as connection:
        for _ in range(2):
            assert await found(connection, name) == ActionInfo(name, PAINT)
    assert len(requests) == 1


async def test_a_node_that_does_not_answer_costs_a_moment_and_is_asked_again_later(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type_learner, "ASK_TIME", 0.1)
    monkeypatch.setattr(type_learner, "MOST_SILENT", 0)
    asked: list[str] = []

    async def ask(asking: object, node: str, request: DescriptionRequest) -> None:
        asked.append(request.type_name)
        await anyio.sleep_forever()

    monkeypatch.setattr(type_learner, "ask_node", ask)
    name = new_name()
    async with painting(folder, name), connect(DdsTransport()) as connection:
        for _ in range(2):  # none is remembered
            assert await found(connection, name) == ActionInfo(name, PAINT)
        assert len(asked) == 2
        monkeypatch.setattr(type_learner, "MOST_SILENT", 1)
        for _ in range(3):
            assert await found(connection, name) == ActionInfo(name, PAINT)
        assert len(asked) == 3
        monkeypatch.setattr(type_learner, "current_time", lambda: anyio.current_time() + 60)
        assert await found(connection, name) == ActionInfo(name, PAINT)
        assert len(asked) == 4


async def test_the_types_that_are_kept_are_bounded(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file_types, "MOST_LEARNED", 1)
    types = FileTypes()
    file = read_action(folder / f"{PAINT}.action")
    types.learn(file, "one", is_whole=True)
    assert types.has_learned(PAINT, "one")
    types.learn(file._replace(type_name="far_msgs/action/Draw"), "two", is_whole=True)
    assert not types.has_learned(PAINT, "one")
    assert types.has_learned("far_msgs/action/Draw", "two")
    assert GET_TYPE_DESCRIPTION.definition.type_name.endswith("/GetTypeDescription")


async def test_another_version_of_a_type_is_told_before_the_first_goal(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, caplog: pytest.LogCaptureFixture
) -> None:
    name, other = new_name(), tmp_path_factory.mktemp("other")
    path = other / f"{PAINT}.action"
    path.parent.mkdir(parents=True)
    path.write_text("int32 spot\n---\nint32 spots\n---\n")
    async with (
        painting(folder, name),
        connect(DdsTransport(search=[str(other)])) as connection,
    ):
        info = await found(connection, name)
        assert caplog.records == []
        assert await found(connection, name) == info
        (record,) = caplog.records
        assert record.getMessage().startswith(f"{name} cannot be used: its server has another")
        client = connection.client(Action.untyped(info))
        await client.wait_for_server(PATIENCE)
        for _ in range(2):
            with pytest.raises(TransportError) as caught:
                await client.send_goal({"spot": 1})
        with pytest.raises(TransportError, match="its server has another version of the types"):
            await connection.interface_texts(info)
        there, here = "RIHS01_[0-9a-f]{8}.. there", "RIHS01_[0-9a-f]{8}.. here"
        (part,) = re.findall(
            f"{PAINT}_SendGoal_Request is {there}, and {here}; {PAINT}_Feed", str(caught.value)
        )
        assert part
        assert str(caught.value).startswith(
            f"cannot use the action {name!r} in ROS: its server has another version of the types: "
        )
        assert "use the interface files with which the server was built" in str(caught.value)
    assert len(caplog.records) == 1


@pytest.mark.parametrize("told_by", ["the end", "the goal", "the wait"])
async def test_another_version_that_is_seen_once_is_told_once(
    told_by: str,
    folder: Path,
    tmp_path_factory: pytest.TempPathFactory,
    caplog: pytest.LogCaptureFixture,
) -> None:
    name, other = new_name(), tmp_path_factory.mktemp("other")
    path = other / f"{PAINT}.action"
    path.parent.mkdir(parents=True)
    path.write_text("int32 spot\n---\nint32 spots\n---\n")
    async with painting(folder, name):
        async with connect(DdsTransport(search=[str(other)])) as connection:
            client = connection.client(Action.untyped(await found(connection, name)))
            if told_by == "the goal":
                with pytest.raises(TransportError, match="another version of the types"):
                    await client.send_goal({"spot": 1})
            assert caplog.records == []
            if told_by == "the wait":
                await client.wait_for_server(PATIENCE)
    assert len(caplog.records) == (told_by != "the goal")


@pytest.mark.parametrize("place", [f"old/{PAINT}.action", "old/Paint.action"])
async def test_of_several_versions_in_files_that_of_the_server_is_taken(
    place: str, folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    name, other = new_name(), tmp_path_factory.mktemp("other")
    for path, text in (
        (other / f"{PAINT}.action", "int32 spot\n---\nint32 spots\n---\n"),
        (other / "broken" / f"{PAINT}.action", "int33 spot\n---\n---\n"),
        (other / place, TEXT),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    search = [str(other), str(other / "old"), str(folder)]
    async with (
        painting(folder, name) as begun,
        connect(DdsTransport(search=search)) as connection,
    ):
        begun.set()
        info = await found(connection, name)
        assert (await connection.interface_texts(info))[PAINT] == TEXT
        client = connection.client(Action.untyped(info))
        await client.wait_for_server(PATIENCE)
        assert await client.call({"spot": {"x": 4}}) == {"spots": 4}


def test_a_version_that_no_file_has_is_looked_for_once_and_few_are_remembered(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file_types, "MOST_MISSED", 1)
    read: list[str] = []
    versions = InterfaceFiles.versions

    def counted(files: InterfaceFiles, type_name: str) -> Iterator[ActionFile]:
        read.append(type_name)
        return versions(files, type_name)

    monkeypatch.setattr(InterfaceFiles, "versions", counted)
    types = FileTypes([folder])
    one, two, none = (
        ServerVersion(frozenset(goal), frozenset(), frozenset()) for goal in (["one"], ["two"], [])
    )
    for version in (one, one, two, one, none):
        types.choose(PAINT, version)
    assert read == [PAINT] * 3
    types.choose("far_msgs/../Paint", one)
    right = types.find(PAINT).impl.SendGoalService.Request.type_hash
    types.choose(PAINT, one._replace(goal=frozenset([right, "another"])))
    assert read == [PAINT] * 3


class SlowNode(NodeLife):
    """A node that learns late of another one, whose service is late, and then lost."""

    graph_news, until = RosNode.graph_news, RosNode.until

    def __init__(self) -> None:
        super().__init__()
        self.looks = self.tries = 0
        self.removed: list[SlowNode] = []

    def publishers(self, topic: str) -> list[EndInfo]:
        self.looks += 1
        return [EndInfo(b"gid", "/far" if self.looks > 2 else "", EndQos(), "RIHS01_")]

    def request_readers(self, service: str) -> list[EndInfo]:
        return []

    answer_writers = request_readers

    def caller(self, service: str, *_: object) -> SlowNode:
        assert service == "/far/get_type_description"
        return self

    def is_available(self) -> bool:
        self.tries += 1
        return self.tries > 1

    def send(self, request: DescriptionRequest) -> int:
        raise ConnectionLost("the line is cut")

    def remove(self, caller: SlowNode) -> None:
        self.removed.append(caller)


async def test_a_node_and_its_service_are_waited_for_and_may_be_lost(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    node = SlowNode()
    asking = cast("RosNode", node)
    learner = type_learner.TypeLearner(asking, FileTypes(), TypeQuestions(lambda *_: 0))
    await learner.learn([("/go/_action/feedback", "gone_msgs/action/Go")])
    assert node.removed == [node]
    assert [record.getMessage() for record in caplog.records] == [
        "/far describes gone_msgs/action/Go_FeedbackMessage: the line is cut"
    ]
