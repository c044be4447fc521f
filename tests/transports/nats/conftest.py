"""One broker for all tests of this folder that do not disturb it; each test has its own fleet."""

from __future__ import annotations

import gc
import secrets
from collections.abc import Generator

import pytest

from tests.support.nats_server import IS_LEFT_OUT, NatsServer, nats_server
from tests.transports.hearing import Hearing, hearing


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"  # nats:// is made for it


@pytest.fixture(autouse=True)
def collected() -> Generator[None, None, None]:
    """What a test leaves open is found in that test, not in one that comes later."""
    yield
    gc.collect()


@pytest.fixture
def log() -> Generator[Hearing, None, None]:
    with hearing("fibaction.nats") as found:
        yield found


def broker() -> Generator[NatsServer, None, None]:
    if IS_LEFT_OUT:
        pytest.skip("nats-server is not installed: see the extra `broker`")
    with nats_server() as server:
        yield server


shared_broker = pytest.fixture(scope="session", name="shared_broker")(broker)
own_broker = pytest.fixture(name="own_broker")(broker)
"""A broker to kill."""


@pytest.fixture
def fleet() -> str:
    return secrets.token_hex(4)
