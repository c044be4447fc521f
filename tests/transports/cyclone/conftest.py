"""The environment of the tests with Cyclone DDS: a domain of their own, on this machine only."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.ros_domain import claim_domain

FOLDER = Path(__file__).parents[3] / "examples/ros2"


@pytest.fixture(autouse=True, scope="package")
def domain() -> Iterator[None]:
    """Take a domain that no other test run has, and the interface files of the examples."""
    number, claim = claim_domain(os.getpid())
    with claim, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("FIBACTION_SEARCH", str(FOLDER))
        for name in ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "AMENT_PREFIX_PATH"):
            patch.delenv(name, raising=False)
        yield


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"
