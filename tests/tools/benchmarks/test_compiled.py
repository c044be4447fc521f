"""The folder with compiled modules: what is copied, and what is compiled."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tools.benchmarks.compiled import MODULES, copy_to, main


def test_the_code_is_copied_with_all_modules_that_are_compiled(tmp_path: Path) -> None:
    copy_to(tmp_path / "compiled")

    assert [name for name in MODULES if not (tmp_path / "compiled" / name).is_file()] == []
    assert (tmp_path / "compiled/transports/fibaction_transports/inprocess.py").is_file()


def test_a_folder_that_exists_is_left_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(str(tmp_path))
    assert "exists already: name a new folder, or remove it" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
