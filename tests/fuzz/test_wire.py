"""The fuzz target, without what it needs."""

from __future__ import annotations

import pytest

from tests.fuzz import wire


def test_without_atheris_it_says_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "find_spec", lambda name: None)

    with pytest.raises(SystemExit, match="atheris is not installed: `make fuzz` installs it"):
        wire.main()
