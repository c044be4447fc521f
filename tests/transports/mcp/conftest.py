"""Short pauses for the tests of the bridge for agents."""

from __future__ import annotations

import pytest
from fibaction_transports.mcp import _agent_goals, _robot_actions


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_robot_actions, "PERIOD", 0.01)
    monkeypatch.setattr(_robot_actions, "NEXT_CONNECTION", 0.01)
    monkeypatch.setattr(_agent_goals, "PROGRESS_PERIOD", 0.01)
