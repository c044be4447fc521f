"""Topics beside the goals of a console that is a node of rclpy."""

from __future__ import annotations

import pytest

from tests.cli.test_sources import check_newest

pytestmark = pytest.mark.anyio


async def test_a_topic_of_a_node_over_dds_is_read_through_rclpy() -> None:
    await check_newest({"arm": "ros2://"}, "arm/chatter", "dds://talker")
