"""What the soak says of itself."""

from __future__ import annotations

import sys

import pytest

from tests import soak


def test_the_help_is_laid_out_and_says_what_there_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["soak", "--help"])

    with pytest.raises(SystemExit) as exit:
        soak.main()

    assert exit.value.code == 0
    out = capsys.readouterr().out
    assert soak.__doc__ is not None
    assert soak.__doc__.strip() in out
    assert "how long it takes; 600 if not given" in " ".join(out.split())
