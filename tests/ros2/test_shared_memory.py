"""Shared memory, through which Fast DDS sends on one machine.

Goals pass through it, and a process that ends removes its files in /dev/shm, however it ends.

A process whose files are looked at is alone in a domain, so that all files which it has open are
its own, but for the port of multicast, which all domains of the machine share.
"""

from __future__ import annotations

import re
import signal
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM

import pytest

from fibaction import connect
from fibaction_transports.ros2.on_rclpy.rcl import middleware
from tests.ros2.stock.ours import action
from tests.ros2.stock.process import Peer, peer
from tests.ros2.stock.waiting import eventually
from tests.support.fibonacci import Goal
from tests.support.ros_domain import PORT, remove_left_ports

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.skipif(
        "fastrtps" not in middleware(), reason="only Fast DDS has files in /dev/shm"
    ),
]

END = 10.0
"""Seconds that a program may take to end; it takes a tenth of one."""
OF_A_PROCESS = 5
"""A segment and a port, each with a file that is locked, and the mutex of the port."""
MAPPED = re.compile(r"/dev/shm/fast(?:dds|rtps)_(?!port70)\w+")
"""A file that Fast DDS of Kilted or of Jazzy maps into memory: a segment, or a port of a domain."""


def mapped_by(pid: int | str) -> set[Path]:
    """Return the files of Fast DDS that a process has mapped."""
    return {Path(name) for name in MAPPED.findall(Path(f"/proc/{pid}/maps").read_text())}


def files_of(process: Peer) -> set[Path]:
    """Return the files of Fast DDS that a process has mapped, with what lies beside them."""
    mapped = mapped_by(process.process.pid)
    beside = {
        other
        for path in mapped
        for other in (path.with_name(f"{path.name}_el"), path.with_name(f"sem.{path.name}_mutex"))
    }
    return {path for path in mapped | beside if path.exists()}


async def until_mapped(process: Peer) -> set[Path]:
    """Return the files of a process when it has a segment and a port."""

    async def look() -> set[Path]:
        return files_of(process)

    return await eventually(look, lambda files: len(files) >= OF_A_PROCESS)


@pytest.mark.parametrize("url", ["ros2://", "dds://"])
async def test_a_goal_is_executed_by_a_stock_server_with_shared_memory(url: str) -> None:
    async with peer("server") as stock, connect(url) as connection:
        assert mapped_by(stock.process.pid) != set()
        assert url == "dds://" or mapped_by("self") != set()
        client = connection.client(action("stock"))
        async with client.send_goal(Goal(order=4)) as goal:
            feedback = [one.partial_sequence async for one in goal.feedback]
            result = await goal.result()

    assert feedback == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]
    assert result.sequence == [0, 1, 1, 2, 3]


async def test_with_the_range_of_this_machine_no_setting_turns_shared_memory_off(
    alone: str,
) -> None:
    environment = {
        "ROS_DOMAIN_ID": alone,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }
    async with peer("ours", "serve_it", "tidy", "asyncio", **environment) as process:
        await until_mapped(process)
        process.signal(SIGTERM)
        await process.ended(END)


@pytest.mark.parametrize(("number", "code"), [(SIGINT, 128 + SIGINT), (SIGTERM, 0)])
@pytest.mark.parametrize("way", ["serve_it", "look_for"])
async def test_a_process_that_is_told_to_end_leaves_no_files(
    alone: str, way: str, number: signal.Signals, code: int
) -> None:
    async with peer("ours", way, "tidy", "asyncio", ROS_DOMAIN_ID=alone) as process:
        files = await until_mapped(process)
        process.signal(number)
        assert await process.ended(END) == code, process.complaints()
    assert {path for path in files if path.exists()} == set()


async def test_a_port_outlives_its_reader_if_a_process_that_sent_to_it_was_killed(
    alone: str,
) -> None:
    environment = {"ROS_DOMAIN_ID": alone}
    async with peer("ours", "serve_it", "outlived", "asyncio", **environment) as process:
        files = await until_mapped(process)
        async with peer("ours", "wait", "outlived", "asyncio", **environment) as sender:
            sender.signal(SIGKILL)
            await sender.ended(END)
            left = files_of(process) - files
        process.signal(SIGTERM)
        await process.ended(END)
    [port] = {path for path in files if path.exists() and PORT.fullmatch(path.name)}

    remove_left_ports(int(alone))

    assert not port.exists()
    for path in left:
        path.unlink(missing_ok=True)


async def test_a_port_that_is_read_is_not_removed(alone: str) -> None:
    async with peer("ours", "serve_it", "read", "asyncio", ROS_DOMAIN_ID=alone) as process:
        files = await until_mapped(process)
        remove_left_ports(int(alone))
        assert {path for path in files if not path.exists()} == set()


async def test_a_killed_process_leaves_its_files_and_the_next_one_removes_the_port(
    alone: str,
) -> None:
    arguments = ("ours", "serve_it", "untidy", "asyncio")
    async with peer(*arguments, ROS_DOMAIN_ID=alone) as process:
        files = await until_mapped(process)
        process.signal(SIGKILL)
        await process.ended(END)
    try:
        assert {path for path in files if path.exists()} == files
        async with peer(*arguments, ROS_DOMAIN_ID=alone) as process:
            await until_mapped(process)
            process.signal(SIGTERM)
            await process.ended(END)
        left = {path.name for path in files if path.exists()}
        assert len(left) == 2
        assert not any("port" in name for name in left)
    finally:
        for path in files:
            path.unlink(missing_ok=True)
