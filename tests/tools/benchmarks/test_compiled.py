"""The folder with compiled modules: what is copied, and what is compiled."""

from __future__ import annotations

from pathlib import Path

from tests.tools.benchmarks.compiled import MODULES, copy_to


def test_the_code_is_copied_with_all_modules_that_are_compiled(tmp_path: Path) -> None:
    copy_to(tmp_path / "compiled")

    assert [name for name in MODULES if not (tmp_path / "compiled" / name).is_file()] == []
    assert (tmp_path / "compiled/transports/fibaction_transports/inprocess.py").is_file()
