"""Slices of time: of another length, or by a clock of the test."""

from __future__ import annotations

import pytest

from fibaction.border import event_loop


def let_slices_last(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Let each slice last so long; with less than 0, it is over before it begins."""
    monkeypatch.setattr(event_loop, "SLICE", seconds)


class SliceClock:
    """A clock for slices, which advances by a step at each look; at first it stands still."""

    def __init__(self) -> None:
        self.step = 0.0
        self._now = 0.0

    def __call__(self) -> float:
        self._now += self.step
        return self._now
