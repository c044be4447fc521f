"""A scout sees the graph beside a node, and how far discovery has come."""

from __future__ import annotations

import os
import uuid

import anyio
import pytest

from fibaction import ActionServer, TransportError, connect, serve
from fibaction_transports.ros2.on_dds.graph import open_scout
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.fibonacci import FIBONACCI, fibonacci
from tests.support.processes import PATIENCE
from tests.support.until import until

pytestmark = pytest.mark.anyio


def domain() -> int:
    return int(os.environ["ROS_DOMAIN_ID"])


async def test_a_scout_sees_the_nodes_and_their_actions_and_forgets_those_that_leave() -> None:
    space = f"/t{uuid.uuid4().hex}"
    url = f"dds://arm?namespace={space}"
    with anyio.fail_after(PATIENCE):
        async with open_scout(domain()) as scout:
            async with serve(ActionServer(FIBONACCI, fibonacci), url):
                await until(lambda: f"{space}/arm" in scout.nodes(), True)
                await until(lambda: scout.discovery().pending, 0)
                (topic,) = (one for one, _ in scout.served_actions() if one.startswith(space))
                (end,) = scout.publishers(topic)
                assert end.node == f"{space}/arm"
                assert list(scout.subscriptions(topic)) == []
                known = scout.discovery().known
            await until(lambda: f"{space}/arm" in scout.nodes(), False)
            assert scout.discovery().known < known


async def test_a_scout_has_no_node() -> None:
    space = f"/t{uuid.uuid4().hex}"
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), f"dds://arm?namespace={space}"),
            open_scout(domain()),
            connect("dds://watch") as connection,
        ):
            nodes = await connection.nodes()
    assert f"{space}/arm" in nodes
    assert not nodes & {"/", "/watch"}


async def test_settings_of_ros_that_are_not_valid_are_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "FAR")
    with pytest.raises(TransportError, match="ROS_AUTOMATIC_DISCOVERY_RANGE"):
        async with open_scout(domain()):
            pass
