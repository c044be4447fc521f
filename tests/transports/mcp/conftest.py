"""Short pauses for the tests of the bridge for agents."""

from __future__ import annotations

import pytest

from fibaction.observe import followed_servers
from fibaction_transports.mcp import calls


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(followed_servers, "PERIOD", 0.01)
    monkeypatch.setattr(followed_servers, "NEXT_CONNECTION", 0.01)
    monkeypatch.setattr(calls, "PROGRESS_PERIOD", 0.01)
