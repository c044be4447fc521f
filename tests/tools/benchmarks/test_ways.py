"""A peer that cannot be had is left out by name, with a sentence."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.tools.benchmarks import memory, suite
from tests.tools.benchmarks.ways import (
    IN_ONE,
    ROS,
    WAYS,
    Pair,
    Way,
    left_out,
    left_out_here,
    started,
)

BROKEN = Way("broken peer", IN_ONE, "nothing_of_that_name", is_ours=False, has_server=False)


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


class Bearing:
    """A client that bears so many active goals."""

    resident = 10**6

    def __init__(self, most: float) -> None:
        self._left = most

    async def ask(self, do: str, times: int = 1) -> Any:
        if do == "hold":
            self._left -= times
        if self._left < 0:
            raise RuntimeError("too many")
        return [times, times * 0.01]


@pytest.mark.asyncio
async def test_a_peer_that_does_not_bear_so_many_goals_is_left_out_and_the_others_are_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @asynccontextmanager
    async def started(way: Way) -> AsyncGenerator[Pair, None]:
        end: Any = Bearing(10**6 if way.is_ours else 1000)
        yield Pair(end if way.has_server else None, end)

    monkeypatch.setattr(memory, "started", started)
    without: dict[str, str] = {}
    found = await memory.measure(without, 1)
    assert without == {"grpc": "it failed with 10,000 active goals"}
    assert set(found["ways"]) == {"inproc", "tcp_server", "tcp_client"}
