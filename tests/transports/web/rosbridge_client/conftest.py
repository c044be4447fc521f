"""What the tests of rosbridge's clients have in common."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import pytest

from tests.transports.hearing import Hearing, hearing


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture
def log() -> Generator[Hearing, None, None]:
    with hearing("fibaction.web") as found:
        yield found
