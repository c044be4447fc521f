"""The event loops on which the tests of the wire run, and the clock of its slices."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction.wire import link
from fibaction.wire.server import session_goals


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture(autouse=True)
def time_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no slice end, however busy the machine is; tests of slices have clocks of their own."""
    for module in (link, session_goals):
        monkeypatch.setattr(module, "perf_counter", lambda: 0.0)
