"""`dds://` and `zenoh://` as users meet both: their URLs, their errors, names, and large goals."""

from __future__ import annotations

import os
import uuid
from collections.abc import AsyncGenerator
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionServer,
    GoalHandle,
    InvalidURL,
    Return,
    ServerNotFound,
    TransportError,
    connect,
    serve,
)
from fibaction.border.urls import transport_for
from fibaction_transports.ros2.on_zenoh.config import FILE
from fibaction_transports.ros2.ros_transport import RosTransport
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.processes import PATIENCE

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("router")]


@pytest.fixture(params=["dds", "zenoh"])
def scheme(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("dds://robot/arm", "dds://robot/arm: it has a path"),
        ("dds://robot#arm", "dds://robot#arm has a part behind #"),
        ("dds://[", "Invalid IPv6 URL"),
        ("dds://?color=red", "has no setting 'color'; its settings are namespace, domain_id"),
        ("dds://?introspection=contents", "introspection needs rclpy"),
        ("dds://?domain_id=x", "dds://: the setting 'domain_id' cannot be 'x'"),
        ("dds://?domain_id=1&domain_id=2", "dds://: setting given twice"),
        ("dds://?domain_id=233", "domain_id must be between 0 and 232, not 233"),
        ("dds://?lease=0", "lease must be between 0.1 and 3600, not 0.0"),
        ("dds://?discovery=FAR", "discovery must be one of OFF, LOCALHOST, SUBNET, not 'FAR'"),
        ("dds://?fragment_size=1", "fragment_size must be between 256 and 63000, not 1"),
        ("dds://?ip_versions=6,4", "ip_versions must be one of 4, 6 and 4,6, not 6,4"),
        ("zenoh://robot/a/b", "zenoh://robot/a/b: its path has several names"),
        ("zenoh://robot:x", "zenoh://robot:x"),
        ("zenoh://?introspection=contents", "introspection needs rclpy"),
        ("zenoh://?mode=router", "mode is peer or client, not 'router'"),
    ],
)
def test_an_invalid_url_is_an_error_of_one_sentence(url: str, text: str) -> None:
    with pytest.raises(InvalidURL) as caught:
        transport_for(url)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("url", "environment", "text"),
    [
        ("dds://1st", {}, "invalid node_name '1st': it has letters, digits and _"),
        ("dds://?namespace=a%20b", {}, "invalid namespace '/a b'"),
        ("dds://?peers=nowhere.invalid", {}, "static peer 'nowhere.invalid' is unknown"),
        ("zenoh:///1st", {}, "invalid node_name '1st'"),
        ("zenoh://?locators=nothing", {}, "is not valid in Zenoh"),
        ("zenoh://", {"ROS_DOMAIN_ID": "x"}, "'x' is not a number from 0 to 232"),
        ("zenoh://", {FILE: "/nowhere"}, f"{FILE}=/nowhere: "),
        (
            "zenoh://127.0.0.1:1?mode=client",
            {},
            "any of [Single(tcp/127.0.0.1:1)]; is a router there?",
        ),
    ],
)
async def test_a_node_that_cannot_be_made_is_an_error_of_one_sentence(
    url: str, environment: dict[str, str], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(TransportError) as caught:
        async with connect(url):
            pass  # pragma: no cover
    assert text in str(caught.value)


async def test_names_can_be_remapped_and_the_url_has_the_namespace(scheme: str) -> None:
    space = f"/t{uuid.uuid4().hex}"
    arguments = ["--ros-args", "-r", f"__ns:={space}", "-r", "__node:=arm"]
    arguments += ["-r", "fibonacci:=sequence", "-p", "use_sim_time:=true"]
    action = Action(
        "sequence", goal=Goal, feedback=Feedback, result=Result, type_name=FIBONACCI.type_name
    )
    transport = transport_for(f"{scheme}://", arguments=arguments)
    assert isinstance(transport, RosTransport)
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), transport) as (url,),
            connect(url) as connection,
        ):
            assert url == f"{scheme}://?namespace={space}"
            assert transport.served_as("fibonacci") == f"{space}/sequence"
            assert await connection.client(action).call(Goal(3)) == Result([0, 1, 1, 2])
            (info,) = [one for one in await connection.actions() if one.name == "sequence"]
            assert info.type_name == FIBONACCI.type_name
            assert info.goal["$defs"]
            assert list((await connection.peers("sequence")).servers) == [f"{space}/arm"]


async def test_an_action_without_a_server_is_not_found(scheme: str) -> None:
    url = f"{scheme}://?namespace=/t{uuid.uuid4().hex}&discovery_timeout=0.1"
    with anyio.fail_after(PATIENCE):
        async with connect(url, FIBONACCI) as client:
            with pytest.raises(ServerNotFound, match="no server of the action 'fibonacci'"):
                await client.call(Goal(1))


class Text(msgspec.Struct):
    text: str


async def test_goals_feedback_and_results_may_be_large(scheme: str) -> None:
    echo = Action(
        "echo", goal=Text, feedback=Text, result=Text, type_name="fibaction_test_msgs/action/Echo"
    )

    async def execute(goal: GoalHandle[Text]) -> AsyncGenerator[Text | Return[Text], None]:
        yield goal.request
        yield Return(goal.request)

    large = Text(os.urandom(4_000_000).hex())
    heard: list[Any] = []
    url = f"{scheme}://?namespace=/t{uuid.uuid4().hex}"
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(echo, execute), url),
            connect(url, echo) as client,
        ):
            result = await client.call(large, on_feedback=heard.append)
    assert [heard, result] == [[large], large]
