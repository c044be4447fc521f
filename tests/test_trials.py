"""The trials of each night: their runs, and the command lines of their programs."""

from __future__ import annotations

import subprocess
from importlib import import_module
from typing import Any

import pytest

from tests import trials
from tests.fuzz.fuzzer import CORPUS

PROGRAMS = ["trials", "soak.__main__", "kills.__main__", "fleet.__main__", "hostile.__main__"]
PROGRAMS += ["lossy.__main__", "soak.peers"]


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_help_of_a_program_says_what_it_is_for(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    program = import_module(f"tests.{name}")
    with pytest.raises(SystemExit) as exit:
        program.main("--help")

    assert exit.value.code == 0
    assert program.__doc__ is not None
    assert program.__doc__.strip() in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [
        ["soak", "--seconds", "0"],
        ["kills", "--clients", "0"],
        ["fleet", "workers", "--goals", "0"],
        ["hostile", "no such attack"],
        ["lossy", "no such pair"],
    ],
    ids=" ".join,
)
def test_what_cannot_be_tried_is_an_error(words: list[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        import_module(f"tests.{words[0]}.__main__").main(*words[1:])

    assert exit.value.code == 2


def test_all_runs_of_a_trial_are_made_and_one_that_fails_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        made.append(command[1:])
        return subprocess.CompletedProcess(command, len(made) == 1)

    monkeypatch.setattr(trials.subprocess, "run", run)  # type: ignore[attr-defined]  # as it is imported there
    assert trials.main("soak", "lossy") == 1
    modules = ["tests.soak", "tests.soak", "tests.soak.peers", "tests.lossy"]
    assert [command[1] for command in made] == modules
    assert capsys.readouterr().out.endswith("failed: python -m tests.soak --keep\n")
    assert trials.main("lossy") == 0


def test_each_target_of_the_fuzzer_is_tried() -> None:
    tried = {run.split()[0].removeprefix("tests.fuzz.") for run in trials.TRIALS["fuzz"]}
    assert tried == {folder.name for folder in CORPUS.iterdir() if folder.is_dir()}
