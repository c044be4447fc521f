"""The environment of the tests with Cyclone DDS: a domain of their own, on this machine only."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.support.ros_domain import claim_domain


@pytest.fixture(autouse=True, scope="session")
def domain() -> Iterator[None]:
    """Take a domain that no other test run has."""
    number, claim = claim_domain(os.getpid())
    with claim, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        for name in ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS"):
            patch.delenv(name, raising=False)
        yield


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"
