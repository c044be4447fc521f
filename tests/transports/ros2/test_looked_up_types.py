"""Types that participants tell by TypeLookup, by answers that were recorded of a node of rclpy."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import anyio
import pytest
from anyio.abc import TaskGroup

from fibaction import ConnectionLost, TransportError
from fibaction_transports.ros2.node.parts import EndInfo
from fibaction_transports.ros2.node.ros_node import NodeLife, RosNode
from fibaction_transports.ros2.on_dds import type_questions
from fibaction_transports.ros2.on_dds.type_questions import TypeQuestions, read_types
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.descriptions import (
    described_types,
    type_learner,
)
from fibaction_transports.ros2.without_ros.descriptions.described_types import (
    DescriptionRequest,
    FieldTypeDescription,
    UnusableDescription,
)
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.rtps.events import TypesAnswered
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.processes import PATIENCE

pytestmark = pytest.mark.anyio

PREFIX = b"participant1"
LINES = (Path(__file__).parent / "type_answers.txt").read_text().splitlines()
ANSWERS = {
    bytes.fromhex(question): bytes.fromhex(answer)
    for question, answer in (line.split() for line in LINES if not line.startswith("#"))
}
FIBONACCI = "arduinobot_msgs/action/Fibonacci"
HASHES = (
    "RIHS01_189adbe9370aa5f07a728a0eb0612068fdb264cf7204d1fe297da65059e9a58e",
    "RIHS01_ded124fd7abff27bcb4dabea2588df87882b19d380d064c3341ef415d4093cc6",
    "RIHS01_604ef4953a4ac339f4d1415a8589910b71e40fe32c0dfce26d2adc7380e341d4",
)
IDS = (
    bytes.fromhex("f270dc0d0ad1f7950b49d06e8774ef"),
    bytes.fromhex("f20a066497e86c6ac339bc23e9dda3"),
    bytes.fromhex("f2488c3bf2b4754697c339267067f7"),
)
TOPIC = "/far/_action/feedback"


@pytest.fixture(autouse=True)
def no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FIBACTION_SEARCH")


class Robot(NodeLife):
    """A node of rclpy with one action, as the graph and TypeLookup tell of it."""

    until = RosNode.until

    def __init__(self, tasks: TaskGroup, answers: dict[bytes, bytes] = ANSWERS) -> None:
        super().__init__()
        self.questions = TypeQuestions(self.ask)
        self.asked = 0
        self.described: list[str] = []
        self.hashes, self.ids = list(HASHES), list(IDS)
        self.answers_questions = True
        self._tasks = tasks
        self._answers = answers

    def ask(self, prefix: bytes, type_ids: Sequence[bytes]) -> int:
        assert prefix == PREFIX
        if not self.answers_questions:
            return 0
        self.asked += 1
        found = self._answers.get(b"".join(type_ids))
        if found is not None:
            self._tasks.start_soon(self._answer, self.asked, found)
        return self.asked

    async def _answer(self, number: int, found: bytes) -> None:
        for answer in (
            TypesAnswered(b"participant2", number, b"of another participant"),
            TypesAnswered(PREFIX, number + 7, b"to another question"),
            TypesAnswered(PREFIX, number, found),
        ):
            self.questions.take(answer)

    def _end(self, number: int) -> list[EndInfo]:
        gid = PREFIX + bytes([0, 0, number, 3])
        return [EndInfo(gid, "/far", EndQos(), self.hashes[number], "", self.ids[number])]

    def request_readers(self, service: str) -> list[EndInfo]:
        return self._end(0)

    def answer_writers(self, service: str) -> list[EndInfo]:
        return self._end(1)

    def publishers(self, topic: str) -> list[EndInfo]:
        return self._end(2)

    def caller(self, service: str, *_: object) -> Robot:
        return self

    def is_available(self) -> bool:
        return True

    def send(self, request: DescriptionRequest) -> int:
        self.described.append(request.type_name)
        raise ConnectionLost("it does not describe")

    def remove(self, caller: Robot) -> None:
        assert caller is self


@asynccontextmanager
async def robot(**settings: Any) -> AsyncGenerator[tuple[Robot, FileTypes, Any], None]:
    with anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            node, types = Robot(tasks, **settings), FileTypes()
            asking = cast("RosNode", node)
            yield node, types, type_learner.TypeLearner(asking, types, node.questions)


async def test_all_of_an_action_is_learned_and_asked_once() -> None:
    async with robot() as (node, types, learner):
        for _ in range(2):
            await learner.learn([(TOPIC, FIBONACCI)])
        assert (node.asked, node.described) == (2, [])
        impl = types.find(FIBONACCI).impl
        assert impl.SendGoalService.Request.type_hash == HASHES[0]
        assert impl.GetResultService.Response.type_hash == HASHES[1]
        assert impl.FeedbackMessage.type_hash == HASHES[2]
        assert "int32 order" in types.texts(FIBONACCI)[FIBONACCI]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("no answers", "its participant does not answer questions about types"),
        ("other hash", "it has another hash"),
        ("broken", "the types of its answer are broken"),
        ("nothing", "it does not tell a type that it was asked for"),
        ("too many", "it nests more than 1 types"),
        ("too large", "it has more than 0 values"),
        ("no action", "Fibonacci.action:1: expected int32"),
    ],
)
async def test_what_cannot_be_used_is_logged_and_the_feedback_is_asked_for(
    change: str, told: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("INFO")
    answers = ANSWERS
    if change == "broken":
        answers = {key: value[:-9] for key, value in ANSWERS.items()}
    elif change == "nothing":
        answers = {key: bytes(4) for key in ANSWERS}
    elif change == "too many":
        monkeypatch.setattr(type_questions, "MOST_TYPES", 1)
    elif change == "too large":
        monkeypatch.setattr(described_types, "MOST_VALUES", 0)
    elif change == "no action":
        answers = {key: value.replace(b"order", b"or er") for key, value in ANSWERS.items()}
    async with robot(answers=answers) as (node, types, learner):
        node.answers_questions = change != "no answers"
        if change == "other hash":
            node.hashes[1] = HASHES[0]
        await learner.learn([(TOPIC, FIBONACCI)])
        asked = node.asked
        del learner._silent[node.publishers(TOPIC)[0].gid]  # as if it had described the feedback
        await learner.learn([(TOPIC, FIBONACCI)])
        assert node.asked == asked
        assert node.described == [f"{FIBONACCI}_FeedbackMessage"] * 2
        with pytest.raises(TransportError):
            types.find(FIBONACCI)
    first = caplog.records[0].getMessage()
    assert first.startswith(f"/far tells of {FIBONACCI}: ")
    assert told in first


async def test_without_an_answer_the_feedback_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type_learner, "ASK_TIME", 0.2)
    async with robot(answers={}) as (node, _, learner):
        while not node.described:
            await learner.learn([(TOPIC, FIBONACCI)])


@pytest.mark.parametrize("missing", ["id", "hash"])
async def test_ends_that_announce_too_little_are_not_looked_up(missing: str) -> None:
    async with robot() as (node, _, learner):
        if missing == "id":
            node.ids[1] = b""
        else:
            node.hashes[0] = ""
        await learner.learn([(TOPIC, FIBONACCI)])
        assert node.asked == 0
        assert node.described


def test_every_kind_of_field_is_read() -> None:
    types = {one.name.rpartition("::")[2]: one for key in ANSWERS for one in _types(key)}
    goal = {field.name: field.type for field in types["Everything_Goal_"].fields}
    assert goal["a_bool"] == FieldTypeDescription(15)
    assert goal["a_float64"] == FieldTypeDescription(11)
    assert goal["a_bounded_string"] == FieldTypeDescription(21, 0, 5)
    assert goal["default_bounded"] == FieldTypeDescription(11 + 96, 5)
    assert goal["default_fixed"] == FieldTypeDescription(6 + 48, 3)
    assert goal["default_strings"] == FieldTypeDescription(17 + 144)
    # What Fast DDS is told by ROS: neither a byte nor a wide text.
    assert goal["a_byte"] == goal["a_uint8"] == FieldTypeDescription(3)
    assert goal["a_wstring"] == FieldTypeDescription(17)


def _types(key: bytes) -> list[type_questions.TypeObject]:
    return list(read_types(ANSWERS[key]).values())


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (b"\xf2\x51", b"\xf2\x40", "it has a type that ROS does not have"),
        (b"\x01\x00\x04\x00", b"\x01\x00\x33\x00", "it has a type that ROS does not have"),
        (b"order", b"\xff\xff\xff\xff\xff", "the types of its answer are broken"),
        (b"\x04\0\0\0\xf2", b"\xff\xff\xff\xff\xf2", "it has more than 1,000 types or fields"),
    ],
)
def test_a_type_that_ros_does_not_have_is_an_error(old: bytes, new: bytes, problem: str) -> None:
    answer = next(one for one in ANSWERS.values() if b"order" in one)
    assert old in answer
    with pytest.raises(UnusableDescription, match=problem):
        read_types(answer.replace(old, new))
