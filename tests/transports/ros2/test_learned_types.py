"""Types that a client learns from the nodes that serve an action, without their files."""

from __future__ import annotations

import uuid
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionServer, GoalHandle, TransportError, connect, serve
from fibaction.interfaces.files import read_action
from fibaction.interfaces.structs import make_structs
from fibaction.types.action import ActionInfo
from fibaction_transports.ros2 import DdsTransport
from fibaction_transports.ros2.on_dds import graph
from fibaction_transports.ros2.on_dds.descriptions import type_learner
from fibaction_transports.ros2.on_dds.descriptions.description_messages import (
    GET_TYPE_DESCRIPTION,
    DescriptionRequest,
    DescriptionResponse,
)
from fibaction_transports.ros2.on_dds.descriptions.type_registry import TypeRegistry
from fibaction_transports.ros2.on_dds.messages import dds_types
from fibaction_transports.ros2.on_dds.messages.dds_types import DdsTypes
from fibaction_transports.ros2.on_dds.messages.message_type import TypeHashes, read_hashes
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
            f"the goal and the result of {PAINT} are not known here: put {PAINT}.action into a"
            " folder, and name that folder with search=FOLDER or in FIBACTION_SEARCH"
        )
    assert [one.type_name for one in asked] == [f"{PAINT}_FeedbackMessage"]


async def test_users_types_for_a_goal_that_is_not_known_are_an_error(
    folder: Path, as_rclpy: None
) -> None:
    name = new_name()
    async with painting(folder, name), connect(DdsTransport()) as connection:
        await found(connection, name)
        typed = Action(name, goal=int, feedback=dict, result=str, type_name=PAINT)
        with pytest.raises(TransportError, match="the goal and the result of far_msgs/action/Pain"):
            connection.client(typed)


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


async def test_a_node_without_the_service_costs_a_moment(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type_learner, "ASK_TIME", 0.1)
    monkeypatch.setattr(type_learner.TypeLearner, "_ask", lambda *_: anyio.sleep_forever())
    monkeypatch.setattr(type_learner, "MOST_SILENT", 0)
    name = new_name()
    async with painting(folder, name), connect(DdsTransport()) as connection:
        assert await found(connection, name) == ActionInfo(name, PAINT)


async def test_an_end_without_a_hash_is_not_asked(
    folder: Path, monkeypatch: pytest.MonkeyPatch, asked: list[DescriptionRequest]
) -> None:
    monkeypatch.setattr(graph, "read_hashes", lambda user_data: TypeHashes())
    name = new_name()
    async with painting(folder, name), connect(DdsTransport()) as connection:
        assert await found(connection, name) == ActionInfo(name, PAINT)
    assert asked == []


async def test_the_types_that_are_kept_are_bounded(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dds_types, "MOST_LEARNED", 1)
    types = DdsTypes()
    file = read_action(folder / f"{PAINT}.action")
    types.learn(file, "one", is_whole=True)
    assert types.has_learned(PAINT, "one")
    types.learn(file._replace(type_name="far_msgs/action/Draw"), "two", is_whole=True)
    assert not types.has_learned(PAINT, "one")
    assert types.has_learned("far_msgs/action/Draw", "two")
    assert GET_TYPE_DESCRIPTION.definition.type_name.endswith("/GetTypeDescription")
