"""What the tests of these transports have in common."""

from __future__ import annotations

import gc
from collections.abc import Generator
from typing import Any

import pytest

from tests.transports.hearing import Hearing, hearing


@pytest.fixture(autouse=True)
def collected() -> Generator[None, None, None]:
    """What a test leaves open is found in that test, not in one that comes later."""
    yield
    gc.collect()


@pytest.fixture
def heard() -> Generator[Hearing, None, None]:
    with hearing() as found:
        yield found


@pytest.fixture
def log() -> Generator[Hearing, None, None]:
    with hearing("fibaction.web") as found:
        yield found


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param
