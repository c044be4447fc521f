"""How the tests with ROS 2 run: in a ROS domain of their own, and never hung or left out unseen.

They run where ROS 2 and the interfaces of the tests are installed, as `make test-ros` does it. They
are not even collected elsewhere. With FIBACTION_ROS=required that is an error, and so is a skip.
"""

from __future__ import annotations

import atexit
import faulthandler
import os
import socket
from collections.abc import Generator
from importlib.util import find_spec

import pytest

NEEDED = ("rclpy", "test_msgs", "geometry_msgs", "arduinobot_msgs", "fibaction_test_msgs")
MISSING = [name for name in NEEDED if find_spec(name) is None]
REQUIRED = os.environ.get("FIBACTION_ROS") == "required"

DOMAINS = 102
"""IDs 0 to 101 are those whose UDP ports are below the ones that Linux hands out by itself."""

ENDING = 30
"""Seconds after which a process is taken for hung that has run all tests and does not end."""

collect_ignore_glob = ["*"] if MISSING else []


def claim_domain(first: int) -> tuple[int, socket.socket]:
    """Take the first free ROS domain of this machine, looking from `first` on.

    It is taken as long as the socket is open. The kernel closes that however the process ends, and
    its name is no file, so nothing stays behind.
    """
    for step in range(DOMAINS):
        domain = (first + step) % DOMAINS
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0fibaction-test-ros-domain-{domain}")
        except OSError:
            claim.close()
        else:
            return domain, claim
    raise RuntimeError("all ROS domains of this machine are taken by test runs")


if MISSING:
    if REQUIRED:
        raise pytest.UsageError(f"FIBACTION_ROS=required, but there is no {', no '.join(MISSING)}")
else:
    # Before any test module is imported, as ROS reads some of it only once. What the shell says is
    # for robots: tests are not to meet those, nor other runs. The process ID changes the domain
    # from run to run, so what a killed run has left behind is not met either.
    DOMAIN, _CLAIM = claim_domain(os.getpid())
    atexit.register(_CLAIM.close)  # not all runs are configured to their end
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    for name in ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER"):
        os.environ.pop(name, None)
    if "PYTEST_XDIST_WORKER" in os.environ:
        # This process is measured, and those that it starts are not: some of them are killed.
        os.environ.pop("COVERAGE_PROCESS_START", None)
    # Lines of ROS's log that tests can look at: no colors, no time.
    os.environ["RCUTILS_COLORIZED_OUTPUT"] = "0"
    os.environ["RCUTILS_CONSOLE_OUTPUT_FORMAT"] = "[{severity}] [{name}]: {message}"


@pytest.fixture(scope="session", autouse=True)
def ros_log_files(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep the files of ROS's log out of the home folder."""
    os.environ["ROS_LOG_DIR"] = str(tmp_path_factory.mktemp("ros_log"))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give a test that says how long it may take so much time.

    Of others, what hangs in Python fails by a signal, as everywhere. What hangs in C, where no
    signal is handled, is shown and ended a little later, by the Makefile's `faulthandler_timeout`.
    """
    if item.get_closest_marker("timeout") is not None:
        faulthandler.cancel_dump_traceback_later()


def pytest_unconfigure() -> None:
    """Do not wait for ever for a thread that does not stop."""
    if not MISSING:
        faulthandler.dump_traceback_later(ENDING, exit=True)


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
