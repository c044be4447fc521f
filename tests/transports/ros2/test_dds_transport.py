"""`dds://` as users meet it: its URLs, its errors, and what an action needs."""

from __future__ import annotations

import sys
import uuid
from collections.abc import AsyncGenerator, Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest

import fibaction_transports.ros2
from fibaction import (
    ActionServer,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalInfo,
    InvalidURL,
    TransportError,
    call,
    connect,
    serve,
)
from fibaction.border.abc import ForwardingEndpoint, StatusStream
from fibaction.border.urls import transport_for
from fibaction.schema.template import Template
from fibaction_transports.ros2 import DdsTransport, ros2_transport
from fibaction_transports.ros2.ros_transport import RosTransport
from fibaction_transports.ros2.server import action_server
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.article import Numbers, Progress, article
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.processes import PATIENCE

pytestmark = pytest.mark.anyio

ROOT = Path(__file__).parents[3]


def url_of(where: str, **settings: Any) -> str:
    transport = transport_for(where, **settings)
    assert isinstance(transport, DdsTransport)
    return transport.url


def test_the_url_has_the_settings_that_a_client_must_share() -> None:
    url = "dds://arm?namespace=/robot&lease=5&discovery=SUBNET&peers=a,b&search=/x,/y"
    assert url_of(url) == ("dds://?namespace=/robot&lease=5.0&discovery=SUBNET&peers=a,b")
    assert url_of("dds://?ip_versions=4,6") == "dds://?ip_versions=4,6"
    assert DdsTransport().url == "dds://"
    assert DdsTransport(peers=[], ip_versions=[]).url == "dds://"


WAYS = [
    ("ros2://arm?via=dds&namespace=/robot", "", "DDS", "dds://?namespace=/robot"),
    ("ros2://arm?via=zenoh&namespace=/robot", "", "Zenoh", "zenoh://?namespace=/robot"),
    ("ros2://arm", "", "DDS", "dds://"),
    ("ros2://arm", "rmw_cyclonedds_cpp", "DDS", "dds://"),
    ("ros2://arm", "rmw_zenoh_cpp", "Zenoh", "zenoh://"),
]


@pytest.mark.parametrize(("url", "rmw", "name", "where"), WAYS)
def test_without_ros_the_way_is_that_of_the_url_or_of_the_environment(
    url: str,
    rmw: str,
    name: str,
    where: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr(ros2_transport, "find_spec", lambda _: None)
    monkeypatch.setenv("RMW_IMPLEMENTATION", rmw)
    made = transport_for(url)

    assert isinstance(made, RosTransport)
    assert (made.scheme, made.url) == (where.partition(":")[0], where)
    assert made._adapter._node.name == "arm"  # type: ignore[attr-defined]  # both have it
    assert caplog.messages == [f"ros2://arm goes over {name}, without ROS"]


def test_the_way_may_be_a_setting_in_code() -> None:
    assert isinstance(transport_for("ros2://", via="dds"), DdsTransport)


def test_a_way_that_there_is_not_is_an_error() -> None:
    with pytest.raises(InvalidURL, match="ros2://arm: via is rclpy, dds or zenoh, not 'ros1'"):
        transport_for("ros2://arm?via=ros1&lease=2")


def test_an_rclpy_of_another_python_is_told_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    of_ros = tmp_path / "rclpy" / "__init__.py"
    of_ros.parent.mkdir()
    of_ros.write_text("raise ImportError('No module named rclpy._rclpy_pybind11\\nThe C')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delattr(fibaction_transports.ros2, "on_rclpy", raising=False)
    for name in list(sys.modules):
        if name.split(".")[0] == "rclpy" or ".on_rclpy" in name:
            monkeypatch.delitem(sys.modules, name)
    python = ".".join(map(str, sys.version_info[:2]))
    reason = (
        f"this Python {python} cannot import the rclpy in {of_ros} (No module named"
        " rclpy._rclpy_pybind11); is PYTHONPATH left over from a ROS of another Python?"
    )
    made = transport_for("ros2://")

    assert isinstance(made, DdsTransport)
    assert caplog.messages == [f"ros2:// goes over DDS: {reason}"]
    with pytest.raises(TransportError) as caught:
        transport_for("ros2://?via=rclpy")
    assert str(caught.value) == reason


async def test_a_function_with_the_fields_of_ros_is_served_at_each_address() -> None:
    urls = ["tcp://127.0.0.1:0", "ws://127.0.0.1:0", f"dds://?namespace=/t{uuid.uuid4().hex}"]
    numbers = Numbers([0, 1, 1, 2, 3])
    with anyio.fail_after(PATIENCE):
        async with serve(article, *urls) as served:
            for url in served:
                reported: list[Progress] = []
                assert await call(url, article, 4, on_feedback=reported.append) == numbers
                assert [len(one.partial_sequence) for one in reported] == [3, 4, 5]
            async with connect(served[-1]) as connection:
                (info,) = [one for one in await connection.actions() if one.name == "article"]
    goal = Template(info.goal)
    assert {name: one.get("default") for name, one in goal.fields.items()} == {"order": 0}


async def test_an_endpoint_in_ros_is_served_again_with_the_type_that_it_has() -> None:
    first, second = (f"dds://?namespace=/t{uuid.uuid4().hex}" for _ in range(2))
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), first),
            connect(first) as connection,
            serve(ForwardingEndpoint(connection.endpoint(FIBONACCI)), second),
        ):
            assert await call(second, FIBONACCI, Goal(5)) == Result([0, 1, 1, 2, 3, 5])


class LostAfterOne:
    """The statuses of an endpoint that is lost after the first."""

    def __init__(self, statuses: StatusStream) -> None:
        self._statuses = statuses
        self._is_told = False

    def __enter__(self) -> LostAfterOne:
        return self

    def __exit__(self, *_: object) -> None:
        self._statuses.close()

    async def receive(self) -> GoalInfo | None:
        if self._is_told:
            raise ConnectionLost("it is gone")
        self._is_told = True
        return await self._statuses.receive()


async def test_a_goal_that_is_told_anew_before_it_is_followed_is_followed_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(action_server, "RETRY_PAUSE", 0.0)
    may_run, asked_twice = anyio.Event(), anyio.Event()
    asked: list[GoalID] = []

    async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Any, None]:
        await may_run.wait()
        async for each in fibonacci(goal):
            yield each

    server = ActionServer(FIBONACCI, execute)
    status, feedback = server.status, server.feedback
    lost: Iterator[type[LostAfterOne]] = iter([LostAfterOne])

    async def statuses() -> Any:
        return next(lost, lambda those: those)(await status())

    async def followed(goal_id: GoalID, **more: Any) -> Any:
        asked.append(goal_id)
        if len(asked) == 2:
            asked_twice.set()
        await asked_twice.wait()
        return await feedback(goal_id, **more)

    monkeypatch.setattr(server, "status", statuses)
    monkeypatch.setattr(server, "feedback", followed)
    url = f"dds://?namespace=/t{uuid.uuid4().hex}"
    with anyio.fail_after(PATIENCE):
        async with (
            serve(server, "inproc://told", url) as (here, there),
            connect(here, FIBONACCI) as mine,
            connect(there, FIBONACCI) as theirs,
        ):
            goal = await mine.send_goal(Goal(4))
            attached = await theirs.attach(goal.goal_id)
            await asked_twice.wait()
            may_run.set()
            heard = [one async for one in attached.feedback]
            assert await attached.result() == Result([0, 1, 1, 2, 3])
            assert await theirs.call(Goal(1)) == Result([0, 1])
    assert asked == [goal.goal_id] * 2
    assert len(heard) == 3
