"""Nodes of rclpy that use IPv6 only, on this machine, and ends of fibaction over `dds://`."""

from __future__ import annotations

from pathlib import Path

import anyio
import pytest

from fibaction import ServerNotFound, connect, serve
from fibaction_transports.ros2.on_rclpy.rcl import middleware
from tests.ros2.stock.ours import Behaviour, action
from tests.ros2.stock.process import PROFILES_FILE, peer
from tests.support.fibonacci import Goal, Result

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.skipif("fastrtps" not in middleware(), reason="the profile is for Fast DDS"),
]

PATIENCE = 40.0
PROFILE = """\
<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors><transport_descriptor>
    <transport_id>loopback</transport_id>
    <type>UDPv6</type>
    <interfaceWhiteList><address>::1</address></interfaceWhiteList>
  </transport_descriptor></transport_descriptors>
  <participant profile_name="over_ipv6" is_default_profile="true"><rtps>
    <builtin><initialPeersList>
      <locator><udpv6><address>::1</address></udpv6></locator>
    </initialPeersList></builtin>
    <userTransports><transport_id>loopback</transport_id></userTransports>
    <useBuiltinTransports>false</useBuiltinTransports>
  </rtps></participant>
</profiles>
"""
URL = "dds://?ip_versions=6"


@pytest.fixture
def over_ipv6(tmp_path: Path) -> dict[str, str]:
    """The environment of a node of rclpy that uses IPv6 only, at the loopback interface."""
    profile = tmp_path / "profile.xml"
    profile.write_text(PROFILE)
    # With the range LOCALHOST, ROS has transports of its own in place of those of the profile.
    reach = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}
    return {**dict.fromkeys(PROFILES_FILE, str(profile)), **reach}


async def test_a_client_uses_a_server_that_has_ipv6_only(over_ipv6: dict[str, str]) -> None:
    async with peer("server", **over_ipv6), connect(URL, action("stock")) as client:
        with anyio.fail_after(PATIENCE):
            await client.wait_for_server(PATIENCE)
            async with client.send_goal(Goal(4)) as goal:
                feedback = [each.partial_sequence async for each in goal.feedback]
                assert await goal.result() == Result([0, 1, 1, 2, 3])
    assert feedback == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]


async def test_a_client_that_has_ipv6_only_uses_a_server(over_ipv6: dict[str, str]) -> None:
    async with (
        serve(Behaviour().server("ours"), f"{URL}&peers=::1"),
        peer("client", **over_ipv6) as stock,
    ):
        assert await stock.ask("ready", action="ours")
        sent = await stock.ask("send", action="ours", order=4)
        answer = await stock.ask("result", goal=sent["goal"])
    assert answer == {"status": 4, "sequence": [0, 1, 1, 2, 3]}


async def test_without_ipv6_such_a_server_is_not_found(over_ipv6: dict[str, str]) -> None:
    async with (
        peer("server", **over_ipv6),
        connect("dds://", action("stock")) as client,
        connect(URL, action("stock")) as other,
    ):
        with anyio.fail_after(PATIENCE):
            await other.wait_for_server(PATIENCE)
        with pytest.raises(ServerNotFound):
            await client.wait_for_server(0.1)
