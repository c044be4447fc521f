"""The real peer of `zenoh://`: nodes of rclpy on `rmw_zenoh_cpp`, where it is installed.

Nobody publishes `rmw_zenoh_cpp` as a wheel, so `make test-ros` has none, and these tests are left
out there. FIBACTION_ZENOH_PEER names the prefix of an installation that fits the ROS 2 of this
environment, with `lib/librmw_zenoh_cpp.so` and `share/rmw_zenoh_cpp`; then the tests of stock ends
run over Zenoh, too, and so does `test_zenoh_peer`. CONTRIBUTING tells how to make one.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PREFIX = os.environ.get("FIBACTION_ZENOH_PEER", "")
SCHEMES = ("ros2", "dds", "zenoh") if PREFIX else ("ros2", "dds")
"""The ways of our end to nodes of rclpy: through rclpy, over our own DDS, and over Zenoh."""


def middleware(scheme: str) -> dict[str, str]:
    """Return the environment of a node of rclpy that this way reaches."""
    if scheme != "zenoh":
        return {}
    libraries = [f"{PREFIX}/lib", f"{sys.prefix}/lib", *_of_wheels()]
    return {
        "RMW_IMPLEMENTATION": "rmw_zenoh_cpp",
        "RUST_LOG": "off",  # its log goes to standard output, where the answers are
        "AMENT_PREFIX_PATH": f"{PREFIX}:{os.environ.get('AMENT_PREFIX_PATH') or sys.prefix}",
        "LD_LIBRARY_PATH": ":".join(libraries),
        # The wheels' library of rcl is linked with another middleware, so this one is loaded first.
        "LD_PRELOAD": f"{PREFIX}/lib/librmw_zenoh_cpp.so",
    }


def url_of(scheme: str, node: str) -> str:
    """Return the URL of a node of ours; over Zenoh, the router has the place of the host."""
    return f"{scheme}:///{node}" if scheme == "zenoh" else f"{scheme}://{node}"


@contextmanager
def router_for(scheme: str) -> Iterator[None]:
    """Run the router that a way needs, if any; nodes that are started meanwhile connect to it."""
    if scheme == "zenoh":
        from tests.support.zenoh_router import own_router  # rclpy's tests need no library of Zenoh

        with own_router():
            yield
    else:
        yield


def _of_wheels() -> list[str]:
    return [str(one) for one in Path(sys.prefix).glob("lib/python3.*/site-packages/ros_*.libs")]
