"""`python -m fibaction` is the command `fibaction`."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys

import pytest

import fibaction


def test_the_package_runs_as_the_command() -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "fibaction", "--version"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        check=True,
        text=True,
        timeout=30,
    )
    assert shown.stdout == f"fibaction {fibaction.__version__}\n"


def test_it_runs_when_it_is_run_and_not_when_it_is_imported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runs: list[str] = []
    monkeypatch.setattr("fibaction.cli.main", lambda: runs.append("run"))
    # Another test may have imported it, and `runpy` warns of that.
    monkeypatch.delitem(sys.modules, "fibaction.__main__", raising=False)

    runpy.run_module("fibaction.__main__", run_name="imported")
    assert runs == []
    runpy.run_module("fibaction", run_name="__main__")
    assert runs == ["run"]
