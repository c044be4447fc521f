"""A node that sends what is wrong, or twice: one line of the log, and everybody else goes on."""

from __future__ import annotations

import uuid
from typing import Any

import anyio
import pytest

from fibaction import ActionServer, GoalID, GoalStatus, connect, serve
from fibaction.border.urls import transport_for
from fibaction.words.goals import GoalInfo
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.convert.status_bytes import pack_line, pack_statuses
from fibaction_transports.ros2.names import action_names, count_topic
from fibaction_transports.ros2.ros_transport import RosTransport
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.processes import PATIENCE
from tests.support.until import until

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("router")]

TYPE = FIBONACCI.type_name


@pytest.fixture(params=["dds", "zenoh"])
def url(request: pytest.FixtureRequest) -> str:
    return f"{request.param}://?namespace=/t{uuid.uuid4().hex}"


def adapter(url: str) -> Any:
    transport = transport_for(url)
    assert isinstance(transport, RosTransport)
    return transport._adapter


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one for one in caplog.messages if "is left out" in one or "was dropped" in one]


async def test_messages_that_are_wrong_are_one_line_each(
    url: str, caplog: pytest.LogCaptureFixture
) -> None:
    goal_id = GoalID.random()
    line = bytearray(pack_line(GoalInfo(goal_id, 5, GoalStatus.ACCEPTED)))
    line[-1] = 77
    expected = [
        "a goal is left out: invalid status list: 77 is not a valid GoalStatus",
        "a message was dropped (1 so far): invalid status list of 8 bytes: it announces 9 goals",
        "a message was dropped (2 so far): invalid number of feedback messages: a goal ID has 32",
    ]
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), url),
            connect(url, FIBONACCI) as client,
            adapter(url).open() as rogue,
        ):
            assert await client.call(Goal(1)) == Result([0, 1])
            impl, names = rogue.types.find(TYPE).impl, action_names(rogue.resolve, "fibonacci")
            statuses = rogue.publisher(
                names.status, impl.GoalStatusMessage, qos.published_status(2.0)
            )
            counts = rogue.publisher(
                count_topic(rogue.resolve, "fibonacci"), rogue.types.Parameter, qos.counts()
            )
            await until(lambda: bool(statuses.reader_count() and counts.reader_count()))
            caplog.clear()
            statuses.publish_bytes(pack_statuses([bytes(line)]))
            await until(lambda: bool(told(caplog)))
            statuses.publish_bytes(b"\x00\x01\x00\x00\x09\x00\x00\x00")
            await until(lambda: len(told(caplog)) == 2)
            counts.publish(rogue.types.Parameter(name="nonsense"))
            await until(lambda: len(told(caplog)) == 3)

    for text, beginning in zip(told(caplog), expected, strict=True):
        assert text.startswith(beginning)
    assert not [one for one in caplog.records if one.exc_info]


async def test_a_goal_that_is_sent_again_is_not_a_warning(
    url: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    answers: list[Any] = []
    with anyio.fail_after(PATIENCE):
        async with serve(ActionServer(FIBONACCI, fibonacci), url), adapter(url).open() as rogue:
            service = rogue.types.find(TYPE).impl.SendGoalService
            names = action_names(rogue.resolve, "fibonacci")
            caller = rogue.caller(
                names.send_goal, service, qos.services(""), lambda _, answer: answers.append(answer)
            )
            await until(caller.is_available)
            request, goal_id = service.Request(), GoalID.random()
            request.goal_id.uuid = rogue.types.uuid(goal_id)
            for count in (1, 2):
                caller.send(request)
                await until(lambda count=count: len(answers) == count)  # type: ignore[misc]

    assert [one.accepted for one in answers] == [True, False]
    again = f"fibonacci: goal {goal_id} was sent again, and was decided before"
    about_it = [one for one in caplog.records if str(goal_id) in one.getMessage()]
    assert [(one.levelname, one.getMessage()) for one in about_it] == [("INFO", again)]
