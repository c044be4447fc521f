"""The console script, with and without what the extra brings."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import fibaction.cli
from fibaction.cli import app
from fibaction.cli.process.exit_at_once import INTERRUPTED, exit_at_once
from fibaction.cli.process.exit_codes import ExitCode
from fibaction_transports import _command
from tests.cli.conftest import Run


def test_the_command_says_its_version(fibaction: Run) -> None:
    code, out, err = fibaction("--version")

    assert (code, out, err) == (0, f"fibaction {version('fibaction')}\n", "")


def fibaction_main() -> None:
    _command.main()


def test_ctrl_c_before_the_command_line_has_begun_ends_as_shells_expect(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(fibaction.cli, "main", interrupted)
    with pytest.raises(SystemExit) as exit:
        fibaction_main()

    assert exit.value.code == INTERRUPTED == _command.INTERRUPTED


def test_ctrl_c_while_fibaction_is_imported_exits_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    monkeypatch.setattr(fibaction.cli, "main", lambda: signal.raise_signal(signal.SIGINT))
    fibaction_main()

    assert codes == [INTERRUPTED]


def test_without_the_extra_one_line_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("click", "rich", "yaml"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(SystemExit) as exit:
        fibaction_main()

    assert exit.value.code == 2
    needs = "The command fibaction needs click, rich, yaml: pip install 'fibaction[cli]'\n"
    assert capsys.readouterr().err == needs


def test_ctrl_c_in_the_moment_in_which_a_verb_begins_ends_as_shells_expect(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        raise KeyboardInterrupt

    monkeypatch.setattr(app, "main", interrupted)
    with pytest.raises(SystemExit) as exit:
        fibaction_main()

    assert exit.value.code == INTERRUPTED == ExitCode.INTERRUPTED
    assert signal.getsignal(signal.SIGINT) is exit_at_once, "the exit takes time, too"


def test_the_handler_of_a_verb_that_has_ended_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    def ending() -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    monkeypatch.setattr(app, "main", ending)
    fibaction_main()

    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_ctrl_c_without_a_verb_exits_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    exit_at_once(signal.SIGINT, None)
    assert codes == [INTERRUPTED]


@pytest.mark.parametrize("module", ["anyio", "msgspec", "click", "yaml"])
def test_ctrl_c_while_modules_are_imported_is_quiet(
    fibaction: Run, tmp_path: Path, nobody: str, module: str
) -> None:
    (tmp_path / f"{module}.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
    )
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))

    assert fibaction("goals", url=nobody, env={"PYTHONPATH": path}) == (130, "", "")


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
