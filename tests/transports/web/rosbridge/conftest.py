"""What the tests of rosbridge have in common: most run over a socket and through an application."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import pytest

from tests.transports.hearing import Hearing, hearing
from tests.transports.web.rosbridge.clients import Serving, over_asgi, over_sockets


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture(params=[over_sockets, over_asgi])
def serving(request: pytest.FixtureRequest) -> Serving:
    found: Serving = request.param
    return found


@pytest.fixture
def log() -> Generator[Hearing, None, None]:
    with hearing("fibaction.web") as found:
        yield found
