"""Topics, services and parameters beside a stock node of rclcpp, which is compiled here.

There is no wheel of rclcpp: FIBACTION_RCLCPP_PEER names the prefix of an installation that fits the
ROS 2 of this environment, with its libraries in `lib`. These tests are not in the check.
"""

from __future__ import annotations

import os
import subprocess
import sys
import uuid
from collections.abc import AsyncGenerator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction_transports.ros2 import Node, open_node
from tests.ros2.test_topics import TYPES, plain, some_values
from tests.support.until import until

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(900)]

PATIENCE = 60.0
RCLCPP = os.environ.get("FIBACTION_RCLCPP_PEER", "")
SOURCE = Path(__file__).with_name("rclcpp_peer.cpp")
LIBRARIES = (
    *("rclcpp", "rcl", "rcutils", "rmw", "rosidl_runtime_c", "tracetools"),
    *("libstatistics_collector", "rosidl_typesupport_cpp"),
    *(
        f"{package}_msgs__rosidl_typesupport_cpp"
        for package in ("geometry", "nav", "std", "test", "trajectory", "statistics")
    ),
    *("rcl_interfaces__rosidl_typesupport_cpp", "rosgraph_msgs__rosidl_typesupport_cpp"),
)
STRING, BASIC = "std_msgs/msg/String", "test_msgs/srv/BasicTypes"
ECHOED = (
    *("Arrays", "BasicTypes", "UnboundedSequences", "WStrings"),
    *("PoseStamped", "Odometry", "JointTrajectory"),
)
"""The types that it sends back."""
RUN = """
import ctypes, sys
words = [word.encode() for word in sys.argv]
ctypes.CDLL(sys.argv[1]).run(len(words), (ctypes.c_char_p * len(words))(*words))
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Compile the node, and find its libraries."""
    made = tmp_path_factory.mktemp("rclcpp") / "peer.so"
    prefixes = [Path(RCLCPP), Path(sys.prefix)]
    headers = [f"-I{one}" for prefix in prefixes for one in prefix.glob("include/*")]
    # CMake would look for all that the libraries need where the wheels were built.
    libraries = ["-Wl,--unresolved-symbols=ignore-in-shared-libs"]
    libraries += [f"-L{prefix}/lib" for prefix in prefixes]
    libraries += [f"-l{one}" for one in LIBRARIES]
    words = ["-std=c++17", "-shared", "-fPIC", "-O0", "-w", *headers, str(SOURCE), *libraries]
    subprocess.run(["c++", *words, "-o", str(made)], check=True)
    with pytest.MonkeyPatch.context() as patch:
        found = [*(f"{prefix}/lib" for prefix in prefixes), os.environ.get("LD_LIBRARY_PATH", "")]
        patch.setenv("LD_LIBRARY_PATH", os.pathsep.join(found))
        yield made


@asynccontextmanager
async def beside_rclcpp(scheme: str, program: Path) -> AsyncGenerator[Node, None]:
    """Open a node of ours in the namespace of one of rclcpp, for as long as the block lasts."""
    space = f"/t{uuid.uuid4().hex}"
    words = [sys.executable, "-c", RUN, str(program), "--ros-args", "-r", f"__ns:={space}"]
    with anyio.fail_after(PATIENCE):
        async with (
            await anyio.open_process(words, stdout=None, stderr=None) as stock,
            open_node(f"{scheme}://ours", namespace=space, arguments=[]) as node,
        ):
            try:
                yield node
            finally:
                stock.kill()


async def test_types_with_each_primitive_go_both_ways(scheme: str, program: Path) -> None:
    types = {one.rpartition("/")[2]: one for one in TYPES}
    async with beside_rclcpp(scheme, program) as node:
        for name in ECHOED:
            there, back = f"there/{name}", f"back/{name}"
            type_ = types[name]
            with node.subscribe(back, type_) as heard, node.publisher(there, type_) as told:
                await until(lambda: told.reader_count() and heard.publisher_count())
                for value in some_values(type_):
                    await told.publish(value)
                    assert plain(await heard.next()) == plain(value), type_


async def test_a_late_reader_gets_what_is_kept(scheme: str, program: Path) -> None:
    async with beside_rclcpp(scheme, program) as node:
        found = await node.next("map", STRING, qos="transient_local")
        assert found.data == "kept"


async def test_services_are_called_and_served(scheme: str, program: Path) -> None:
    def answer(request: Any) -> dict[str, Any]:
        return {"string_value": request.string_value.upper()}

    async with beside_rclcpp(scheme, program) as node:
        for number in range(20):
            request = {"int64_value": number, "string_value": "é"}
            found = await node.call("served", BASIC, request, timeout=PATIENCE)
            assert (found.int64_value, found.string_value) == (-number, "é")
        told, ask = node.subscribe("told", STRING), node.publisher("ask", STRING)
        with node.serve_service("asked", BASIC, answer):
            await until(lambda: node._ros.count_callers(node.full_name("asked")))
            await until(lambda: ask.reader_count() and told.publisher_count())
            for text in ("a", "b"):
                await ask.publish({"data": text})
                assert (await told.next()).data == text.upper()


async def test_parameters_are_read_set_refused_and_watched(scheme: str, program: Path) -> None:
    async with beside_rclcpp(scheme, program) as node:
        theirs = node.parameters("stock", timeout=PATIENCE)
        assert {"speed", "names", "use_sim_time"} <= {*await theirs.list()}
        assert await theirs.get("speed", "names") == {"speed": 0.5, "names": ["a", "b"]}
        with pytest.raises(ValueError, match=r"stock refuses .*speed"):
            await theirs.set({"speed": 9.0})
        changes = theirs.watch()
        async with anyio.create_task_group() as tasks:

            async def set_again() -> None:
                while True:
                    await theirs.set({"speed": 1.5})

            tasks.start_soon(set_again)
            assert await anext(changes) == {"speed": 1.5}
            tasks.cancel_scope.cancel()
        await changes.aclose()
