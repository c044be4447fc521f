"""What `doctor` and `list` say where nodes speak another middleware, or none is reached."""

from __future__ import annotations

import os
import socket
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import ActionServer, connect, serve
from fibaction.border.abc import Diagnosis
from fibaction.border.urls import transport_for
from fibaction_transports.ros2.node import middlewares
from fibaction_transports.ros2.on_zenoh import node
from fibaction_transports.ros2.on_zenoh.config import ATTEMPTS
from fibaction_transports.ros2.on_zenoh.node import NO_NODES, NO_ROUTER
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.fibonacci import FIBONACCI, fibonacci
from tests.support.ports import free_port
from tests.support.processes import PATIENCE
from tests.support.ros_domain import DOMAINS
from tests.transports.ros2.test_diagnosis import until

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("router")]

NAMED = "RMW_IMPLEMENTATION is rmw_zenoh_cpp, whose nodes are not in DDS: use zenoh://"
QUIET = "discovery_timeout=0.1"


@pytest.fixture
def listening(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Listens where a router of Zenoh would; gives the port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        monkeypatch.setattr(middlewares, "LOOKED_AT", port)
        yield port


def listens(host: str, port: int, url: str) -> str:
    return (
        f"a router of Zenoh listens at {host}:{port}, so nodes on rmw_zenoh_cpp may be there,"
        f" which are not in DDS: use {url}"
    )


async def diagnosed(url: str, action: str = "", seconds: float = 0.01) -> Diagnosis:
    with anyio.fail_after(PATIENCE):
        return await transport_for(url, arguments=[]).diagnose(seconds, action)


async def test_a_router_of_zenoh_beside_dds_is_told(listening: int) -> None:
    found = await diagnosed("dds://?peers=127.0.0.1")

    assert found.facts["rmw_implementation"] == "not set"
    assert found.facts["zenoh_routers"] == [f"localhost:{listening}", f"127.0.0.1:{listening}"]
    assert found.advice[-2:] == (
        listens("localhost", listening, "zenoh://"),
        listens("127.0.0.1", listening, "zenoh://127.0.0.1"),
    )


async def test_a_list_without_actions_says_once_where_they_may_be(
    listening: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    async with connect(f"dds://?{QUIET}") as connection:
        assert await connection.actions() == []
        assert await connection.actions() == []

    router = listens("localhost", listening, "zenoh://")
    assert caplog.messages == [f"no action was found: {one}" for one in (NAMED, router)]


async def test_the_middleware_that_the_environment_names_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    in_dds, in_zenoh = await diagnosed("dds://"), await diagnosed("zenoh://")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    other = await diagnosed("zenoh://")

    assert in_dds.facts["rmw_implementation"] == "rmw_zenoh_cpp"
    assert NAMED in in_dds.advice
    assert not [one for one in in_zenoh.advice if "RMW_IMPLEMENTATION" in one]
    assert (
        "RMW_IMPLEMENTATION is rmw_cyclonedds_cpp, whose nodes are not in Zenoh: use dds://"
        in other.advice
    )


async def test_zenoh_says_whether_a_router_answers(
    router: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    domain, port = int(os.environ["ROS_DOMAIN_ID"]), free_port()
    nowhere = f"zenoh://127.0.0.1:{port}?{QUIET}"
    alone = await diagnosed(nowhere)
    other = (domain + 1) % DOMAINS
    beside = await until(lambda found: found.facts["zenoh_routers"], f"zenoh://?domain_id={other}")
    async with connect(nowhere) as connection:
        assert await connection.actions() == []

    assert not alone.is_found
    assert not beside.is_found
    told = NO_ROUTER.format(f"tcp/127.0.0.1:{port}")
    assert alone.advice == (told,)
    assert beside.advice == (f"{NO_NODES} ROS_DOMAIN_ID {other} there, too?",)
    assert (alone.facts["domain"], alone.facts["zenoh_routers"]) == (domain, [])
    assert len(beside.facts["zenoh_routers"]) == 1
    assert caplog.messages == [f"no action was found: {told}"]

    caplog.clear()
    monkeypatch.setattr(node, "ROUTER_PAUSE", 0.0)
    monkeypatch.setenv(ATTEMPTS, "1")
    async with connect(nowhere) as connection:
        assert await connection.actions() == []
    assert caplog.messages == [told]


async def test_zenoh_says_what_is_served_and_why_an_action_cannot_be_used(tmp_path: Path) -> None:
    space = f"/t{uuid.uuid4().hex}"
    path = tmp_path / "arduinobot_msgs/action/Fibonacci.action"
    path.parent.mkdir(parents=True)
    path.write_text("int32 order\n---\nint32[] sequence\n---\nint64[] partial_sequence\n")
    where = f"zenoh://?namespace={space}"

    def served(found: Diagnosis) -> list[Any]:
        return [one for one in found.facts["actions"] if one["name"].startswith(space)]

    with anyio.fail_after(PATIENCE):
        async with connect(f"{where}&domain_id=100"):
            idle = await until(lambda found: found.facts["nodes"], f"{where}&domain_id=100")
        async with serve(ActionServer(FIBONACCI, fibonacci), f"zenoh:///cook?namespace={space}"):
            found = await until(lambda found: bool(served(found)), where, "fibonacci")
            misspelt = await until(lambda found: bool(served(found)), where, "fibonaci")
            url = f"{where}&search={tmp_path}"
            other = await until(lambda found: bool(served(found)), url, "fibonacci")

    assert idle.advice == ("nodes were heard, and none of them serves an action",)
    assert (found.is_found, found.advice) == (True, ())
    assert served(found) == [
        {
            "name": f"{space}/fibonacci",
            "type": "arduinobot_msgs/action/Fibonacci",
            "servers": [f"{space}/cook"],
        }
    ]
    assert f"{space}/cook" in found.facts["nodes"]
    assert not misspelt.is_found
    assert misspelt.facts["problems"] == [
        f"the action {space}/fibonaci has no server; did you mean {space}/fibonacci?"
    ]
    assert not other.is_found
    (problem,) = other.facts["problems"]
    assert problem.startswith("its server has another version of the types: ")
