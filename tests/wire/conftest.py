"""The event loops on which the tests of the wire run, and the clock of its slices."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction.wire import link
from fibaction.wire.server import session_goals
from tests.support.slices import SliceClock


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture(autouse=True)
def slice_clock(monkeypatch: pytest.MonkeyPatch) -> SliceClock:
    """Let no slice end, however busy the machine is; tests of slices let the clock advance."""
    clock = SliceClock()
    for module in (link, session_goals):
        monkeypatch.setattr(module, "perf_counter", clock)
    return clock
