"""The command itself: its group of verbs, errors that no verb expects, and what its extra has."""

from __future__ import annotations

import ast
import errno
import io
import logging
import os
import re
import signal
import subprocess
import sys
from contextlib import redirect_stderr
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

import fibaction.cli
from fibaction.cli import app
from fibaction.cli.process.exit_at_once import INTERRUPTED, exit_at_once
from fibaction.cli.process.exit_codes import ExitCode
from fibaction_transports import _command
from tests.cli.conftest import Invoke, Run

# The group


def test_help_lists_the_verbs_with_their_use_below_what_a_user_wants(invoke: Invoke) -> None:
    first, _, sections = invoke("--help").output.partition("\nServe:\n")

    assert "ROS" not in first.partition(".")[0]
    assert "FIBACTION_URL" in first
    rows = re.findall(r"^(?:(\S.*):|(  [a-z_]+ {2,})(\S.*))$", f"Serve:\n{sections}", re.MULTILINE)
    expected = [
        row
        for title, verbs in app.GROUPS.items()
        for row in ((title, ""), *((verb, use) for verb, (_, _, use) in verbs.items()))
    ]
    listed = [(title or verb.strip(), use) for title, verb, use in rows]
    assert listed[: len(expected)] == expected
    assert len({len(verb) for _, verb, use in rows if use}) == 1, "one column"


@pytest.mark.parametrize("verb", app.VERBS)
def test_the_help_of_a_verb_has_an_example(invoke: Invoke, verb: str) -> None:
    out = invoke(verb, "--help").output

    assert "Example" in out
    assert f"  fibaction {verb}" in out


# Errors


def run_main_with(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the command line, whose verb ends with that error."""

    def verb(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(app.cli, "main", verb)
    app.main()


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (
            ZeroDivisionError("oh\n\x1b"),
            ExitCode.BUG,
            "ZeroDivisionError: oh\\x0a\\x1b (this is a bug; FIBACTION_DEBUG=1 shows where)",
        ),
        (
            OSError(errno.ENOSPC, "No space left on device"),
            ExitCode.ABORTED,
            "the output cannot be written: No space left on device",
        ),
    ],
)
def test_an_unexpected_error_is_one_line(
    error: Exception,
    code: ExitCode,
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("FIBACTION_DEBUG", raising=False)
    with pytest.raises(SystemExit) as exit:
        run_main_with(error, monkeypatch)

    assert exit.value.code == code
    assert capsys.readouterr().err == f"Error: {text}\n"


def test_a_bug_that_is_looked_for_has_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIBACTION_DEBUG", "1")

    with pytest.raises(ZeroDivisionError):
        run_main_with(ZeroDivisionError(), monkeypatch)


def test_a_reader_who_has_enough_is_no_error(tcp: str) -> None:
    command = f"{Path(sys.executable).with_name('fibaction')} -u {tcp} list | head -n 1"

    run = subprocess.run(
        ["sh", "-c", command], capture_output=True, text=True, timeout=30, check=True
    )

    assert run.stdout == "/arm/pick\n"
    assert run.stderr == ""


def test_a_verb_handles_ctrl_c_by_itself(invoke: Invoke) -> None:
    signal.signal(signal.SIGINT, exit_at_once)
    invoke("--help")
    assert signal.getsignal(signal.SIGINT) is exit_at_once
    invoke("gen", "--help")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


# How it is built


def test_no_verb_is_imported_before_it_is_used() -> None:
    tree = ast.parse(Path(app.__file__).read_text(encoding="utf-8"))
    imported = {
        node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module
    }

    assert not imported & {f"fibaction.cli.verbs.{module}" for module, _, _ in app.VERBS.values()}


def test_the_log_of_the_command_is_on_stderr_from_warnings_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: dict[str, Any] = {}
    stdout = io.StringIO()  # no file with an encoding, and left as it is
    monkeypatch.setattr(logging, "basicConfig", lambda **settings: told.update(settings))
    monkeypatch.setattr(sys, "stdout", stdout)
    monkeypatch.setattr(sys, "argv", ["fibaction", "--version"])

    with pytest.raises(SystemExit):
        app.main()

    assert stdout.getvalue().startswith("fibaction ")
    assert told["level"] == logging.WARNING
    (handler,) = told["handlers"]
    record = logging.makeLogRecord({"name": "fibaction.wire", "msg": "gone\x1b"})
    later = io.StringIO()  # as that of rich while a line is drawn again and again
    with redirect_stderr(later):
        handler.handle(record)
    assert later.getvalue() == "fibaction: gone\\x1b\n"


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
