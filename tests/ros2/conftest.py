"""The environment of the tests with ROS 2: a domain of their own, no hidden hang or skip.

They run where ROS 2 and the interfaces of the tests are installed, as by `make test-ros`. Elsewhere
they are not collected. With FIBACTION_ROS=required, that is an error, and so is a skip.
"""

from __future__ import annotations

import atexit
import faulthandler
import os
import uuid
from collections.abc import Generator, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.ros2.zenoh_peer import SCHEMES, router_for
from tests.support.ipv6 import has_ipv6
from tests.support.ros_domain import claim_domain, remove_left_ports

NEEDED = ("rclpy", "test_msgs", "geometry_msgs", "arduinobot_msgs", "fibaction_test_msgs")
MISSING = [name for name in NEEDED if find_spec(name) is None]
REQUIRED = os.environ.get("FIBACTION_ROS") == "required"

ENDING = 30
"""Seconds after all tests within which the process must end."""
OTHERS = 300.0
"""Seconds for which a process of pytest-xdist may wait for the others, whose files take longer."""

collect_ignore_glob = ["*"] if MISSING else [] if has_ipv6() else ["test_ipv6.py"]
if "FIBACTION_ZENOH_PEER" not in os.environ:
    collect_ignore_glob.append("test_zenoh_peer.py")
if "FIBACTION_RCLCPP_PEER" not in os.environ:
    collect_ignore_glob.append("test_rclcpp.py")


if MISSING:
    if REQUIRED:
        raise pytest.UsageError(f"FIBACTION_ROS=required, but not found: {', '.join(MISSING)}")
else:
    # Before any test module is imported, as ROS reads some of it only once. The shell's settings
    # may be those of a robot, which tests must not reach, nor other runs. The process ID changes
    # the domain from run to run, because a killed run may leave something behind.
    DOMAIN, _CLAIM = claim_domain(os.getpid())
    atexit.register(_CLAIM.close)  # not all runs are configured to their end
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    for name in ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER"):
        os.environ.pop(name, None)
    if "PYTEST_XDIST_WORKER" in os.environ:
        # This process is measured. Those that it starts are not, because some of them are killed.
        os.environ.pop("COVERAGE_PROCESS_START", None)
    # Lines of ROS's log that tests can look at: no colors, no time.
    os.environ["RCUTILS_COLORIZED_OUTPUT"] = "0"
    os.environ["RCUTILS_CONSOLE_OUTPUT_FORMAT"] = "[{severity}] [{name}]: {message}"


@pytest.fixture(scope="session", autouse=True)
def ros_log_files(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep the files of ROS's log out of the home folder."""
    os.environ["ROS_LOG_DIR"] = str(tmp_path_factory.mktemp("ros_log"))


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    """Run on asyncio, unless a module has asyncio and trio."""
    return "asyncio"


@pytest.fixture(params=["ros2", "dds"])
def scheme(request: pytest.FixtureRequest) -> str:
    """The way of our node: through rclpy, or over our own DDS."""
    return str(request.param)


@pytest.fixture(scope="module", params=SCHEMES)
def way(request: pytest.FixtureRequest) -> Iterator[str]:
    """The way of our end to stock nodes: through rclpy, over our own DDS, or over Zenoh
    where its peer is.
    """
    with router_for(request.param):
        yield request.param


@pytest.fixture
def url() -> str:
    """A URL with a namespace of its own."""
    return f"ros2://?namespace=/t{uuid.uuid4().hex}"


@pytest.fixture
def alone() -> Iterator[str]:
    """A domain with no other process, and nothing of earlier ones in shared memory."""
    domain, claim = claim_domain(500)
    with claim:
        remove_left_ports(domain)
        yield str(domain)


def participants() -> int:
    """Return the number of participants in the graph that this process has, with Fast DDS: each of
    them has one thread of this name.
    """
    count = 0
    for thread in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # it has just ended
            count += (thread / "comm").read_text().startswith("dds.ev.")
    return count


@pytest.fixture(autouse=True)
def graph_is_left_as_it_was() -> Iterator[None]:
    """Check that a test leaves no node in the graph, where later tests would find its actions."""
    before = participants()
    yield
    assert participants() <= before


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give a test with a timeout of its own as much time.

    Another test that hangs in Python fails by a signal, as everywhere. A test that hangs in C,
    where no signal is handled, is ended a little later by `faulthandler_timeout` of check.sh,
    which prints the stacks.
    """
    if item.get_closest_marker("timeout") is not None:
        faulthandler.cancel_dump_traceback_later()


def pytest_unconfigure() -> None:
    """End the process even if a thread does not stop."""
    if not MISSING:
        # A worker that has run all its files waits for the others first.
        waits = os.environ.get("PYTEST_XDIST_WORKER") is not None
        faulthandler.dump_traceback_later(OTHERS + ENDING if waits else ENDING, exit=True)


def required(report: pytest.TestReport | pytest.CollectReport) -> None:
    """Turn a skip into a failure, if ROS 2 is required."""
    if REQUIRED and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"with FIBACTION_ROS=required a skip is a failure: {report.longreprtext}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    required(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    required(report)
    return report
