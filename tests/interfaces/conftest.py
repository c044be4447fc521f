from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fibaction.interfaces import packages


@pytest.fixture
def no_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine on which ROS is not installed."""
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "venv"))
    forget = packages._store.cache_clear
    forget()
    yield
    forget()


@pytest.fixture
def lift(tmp_path: Path) -> Path:
    """The path of an action that is not written yet."""
    return tmp_path / "Lift.action"
