"""The event loop on which the tests of a fleet run: nats-py needs asyncio."""

from __future__ import annotations

import pytest


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"
