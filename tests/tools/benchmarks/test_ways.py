"""A peer that cannot be had is left out by name, with a sentence."""

from __future__ import annotations

from contextlib import AsyncExitStack
from pathlib import Path

import pytest

from tests.tools.benchmarks import suite
from tests.tools.benchmarks.ways import (
    IN_ONE,
    ROS,
    WAYS,
    Way,
    left_out,
    left_out_here,
    started,
)

BROKEN = Way("broken peer", IN_ONE, "nothing_of_that_name", is_ours=False, has_server=False)
EVERYTHING = dict.fromkeys(
    ("grpc", "nats", "ros2", "rclpy", "rclpy_deep", "rclpy_events"), "not asked for"
)


def test_a_library_that_is_not_installed_is_named() -> None:
    assert left_out_here(lambda _: False, None) == {
        "grpc": "grpcio is not installed; `make bench` installs it",
        "nats": "nats-py is not installed; `make bench` installs it",
    }


def test_without_an_environment_for_ros_all_of_its_ways_are_left_out(tmp_path: Path) -> None:
    reasons = left_out(tmp_path / "python")

    assert {key for key in reasons if WAYS[key].group == ROS} == {
        "ros2",
        "rclpy",
        "rclpy_deep",
        "rclpy_events",
    }
    assert "make ros" in reasons["rclpy"]


@pytest.mark.asyncio
@pytest.mark.parametrize(
    "key",
    [key for key, way in WAYS.items() if way.group != ROS and key not in ("grpc", "nats")],
)
async def test_a_way_does_all_that_is_measured(key: str) -> None:
    async with started(WAYS[key]) as pair:
        for order in ("goals", "batches", "feedback"):
            done, seconds = await pair.client.ask(order, 1)
            assert done == 1
            assert seconds > 0
        assert len(await pair.client.ask("goal_times", 2)) == 2
        assert all(0 < one < 60 for one in await pair.client.ask("feedback_times", 2))
        assert pair.client.resident > 10**6


@pytest.mark.asyncio
async def test_a_peer_that_does_not_start_is_left_out_and_the_others_are_measured(
    capsys: pytest.CaptureFixture[str],
) -> None:
    some = {"broken": BROKEN, "tasks": WAYS["tasks"]}
    without: dict[str, str] = {}

    async with AsyncExitStack() as stack:
        running = await suite.start_all(stack, some, without)

    assert set(running) == {"tasks"}
    assert "unknown contender" in without["broken"]
    assert capsys.readouterr().out.startswith("left out is broken peer: it did not start (")


@pytest.mark.asyncio
async def test_that_fibaction_itself_does_not_start_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="unknown contender"):
        async with AsyncExitStack() as stack:
            await suite.start_all(stack, {"broken": BROKEN._replace(is_ours=True)}, {})
