"""The console script, with and without what the extra brings."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

import pytest

import fibaction.cli
from tests.cli.conftest import Run


def test_the_command_says_its_version(fibaction: Run) -> None:
    code, out, err = fibaction("--version")

    assert (code, out, err) == (0, f"fibaction {version('fibaction')}\n", "")


def test_main_runs_the_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["fibaction", "--version"])

    with pytest.raises(SystemExit) as exit:
        fibaction_main()

    assert exit.value.code == 0
    assert capsys.readouterr().out.startswith("fibaction ")


def fibaction_main() -> None:
    fibaction.cli.main()


def test_without_the_extra_one_line_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fibaction.cli, "NEEDED", ("click", "nosuchmodule"))

    with pytest.raises(SystemExit) as exit:
        fibaction_main()

    assert exit.value.code == 2
    assert capsys.readouterr().err == (
        "The command fibaction needs nosuchmodule: pip install 'fibaction[cli]'\n"
    )


def test_what_is_needed_is_what_the_extra_brings_and_help_imports_little_of_it() -> None:
    script = (
        "import sys, runpy; sys.argv = ['fibaction', '--help']\n"
        "from fibaction.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print({'rich', 'yaml', 'jsonschema', 'textual'} & set(sys.modules), file=sys.stderr)\n"
    )

    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=30)

    assert run.stderr == "set()\n"
