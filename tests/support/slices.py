"""Slices of bulk work of another length, for tests of what happens between two of them."""

from __future__ import annotations

import pytest

from fibaction._runtime import slices


def let_slices_last(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Let each slice last so long; with less than 0, it is over before it begins."""
    monkeypatch.setattr(slices, "SLICE", seconds)
