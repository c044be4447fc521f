"""The names of `fibaction.observe`, which are imported when they are used."""

from __future__ import annotations

import pytest

from fibaction import observe


def test_each_name_is_imported_when_it_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in observe.__all__:
        monkeypatch.delattr(observe, name, raising=False)
        assert getattr(observe, name) is not None


def test_another_name_is_not_there() -> None:
    name = "metric"
    with pytest.raises(AttributeError, match="has no attribute 'metric'"):
        getattr(observe, name)
