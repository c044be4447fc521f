"""The group of verbs, exit codes, and errors as sentences."""

from __future__ import annotations

import ast
import errno
import inspect
import logging
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import click
import pytest

from fibaction import (
    ActionInfo,
    connect,
    serve,
)
from fibaction.cli import app
from fibaction.cli.ending import ExitCode, Failure
from fibaction_transports.tcp import TcpTransport
from tests.cli.conftest import Invoke, Run
from tests.cli.robot import servers

# The group


def test_help_lists_every_verb_with_what_it_is_for(invoke: Invoke) -> None:
    out = invoke("--help").output

    for verb, (_, _, use) in app.VERBS.items():
        assert f"  {verb}" in out
        assert use in out
    assert "FIBACTION_URL" in out


def test_a_verb_also_answers_to_its_hyphenated_spelling(invoke: Invoke) -> None:
    assert invoke("send-goal", "--help").output == invoke("send_goal", "--help").output


def test_a_misspelt_verb_suggests_the_near_one(invoke: Invoke) -> None:
    result = invoke("send_gaol")

    assert result.exit_code == ExitCode.USAGE
    assert "Did you mean 'send_goal'?" in result.output


def test_an_unknown_option_before_the_verb_is_a_usage_error(invoke: Invoke) -> None:
    result = invoke("--nonsense", "list")

    assert result.exit_code == ExitCode.USAGE
    assert "No such option '--nonsense'" in result.output


@pytest.mark.parametrize("verb", ["list", "info", "type", "find", "send_goal"])
def test_the_help_of_a_verb_has_an_example(invoke: Invoke, verb: str) -> None:
    out = invoke(verb, "--help").output

    assert "Example" in out
    assert f"  fibaction {verb} " in out


def test_help_is_there_soon(fibaction: Run) -> None:
    began = time.perf_counter()
    result = fibaction("--help")
    took = time.perf_counter() - began

    assert result.code == 0
    assert took < 5  # some twenty times what it takes: the machine may be busy


def test_a_verb_that_is_unknown_is_none_to_the_completion() -> None:
    context = click.Context(app.cli, resilient_parsing=True)

    assert app.cli.resolve_command(context, ["nonsense", "x"]) == (None, None, ["x"])


# The URL


def test_the_url_is_that_of_the_verb_or_of_the_group_or_of_the_environment(
    invoke: Invoke, tcp: str, nobody: str
) -> None:
    assert invoke("list", "-c", url=tcp).output == "6\n"
    assert invoke("-u", tcp, "list", "-c", url=nobody).output == "6\n"
    assert invoke("-u", nobody, "list", "-c", "--url", tcp).output == "6\n"


def test_without_a_url_it_is_the_default_of_the_tcp_transport(invoke: Invoke) -> None:
    settings = inspect.signature(TcpTransport).parameters

    assert f"tcp://{settings['host'].default}:{settings['port'].default}" == app.URL
    assert f"default: {app.URL}" in " ".join(invoke("--help").output.split())


def test_a_server_that_does_not_run_is_one_sentence(fibaction: Run, nobody: str) -> None:
    code, out, err = fibaction("list", url=nobody)

    assert (code, out) == (ExitCode.UNREACHABLE, "")
    assert err.startswith(f"Error: nobody listens at {nobody}")
    assert err.endswith(": start the server, or name another with --url or FIBACTION_URL\n")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("127.0.0.1:7400", "is not a URL: write it like tcp://"),
        ("nonsense://x", "no transport for nonsense:// is installed; installed are inproc://"),
        ("tcp://127.0.0.1:port", "port"),
        ("tcp://127.0.0.1:7400?nonsense=1", "nonsense"),
        ("unix:///nowhere/socket", "/nowhere/socket"),
    ],
)
def test_a_wrong_url_is_one_sentence(invoke: Invoke, url: str, text: str) -> None:
    result = invoke("-u", url, "list")

    assert result.exit_code in (ExitCode.USAGE, ExitCode.UNREACHABLE)
    assert text in result.stderr
    assert result.stderr.startswith("Error: ")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "verb",
    [
        *(["list"], ["info", "x"], ["type", "x"], ["find", "x"], ["send_goal", "x"], ["goals"]),
        *(["cancel", "--all"], ["attach", "5f"], ["echo", "x"], ["top"]),
    ],
    ids=lambda verb: verb[0],
)
def test_a_url_of_one_process_is_refused_by_all_that_would_reach_another(
    invoke: Invoke, verb: list[str]
) -> None:
    for result in (
        invoke("-u", "inproc://robot", *verb),
        invoke(*verb, "--url", "inproc://robot"),
        invoke(*verb, url="inproc://robot"),
    ):
        assert result.exit_code == ExitCode.USAGE
        assert result.output == (
            "Error: inproc://robot is for clients in the process of the server:"
            " between processes, use tcp:// or unix://\n"
        )


# Errors


@pytest.mark.parametrize(
    ("wanted", "installed", "loop"),
    [(True, True, "uvloop"), (True, False, "asyncio"), (False, True, "asyncio")],
)
def test_a_verb_that_serves_runs_on_uvloop_where_that_is_installed(
    monkeypatch: pytest.MonkeyPatch, wanted: bool, installed: bool, loop: str
) -> None:
    found: list[str] = []

    async def verb() -> int:
        # Not imported: it is only here that anyone wants to know what is below anyio.
        found.append(type(sys.modules["asyncio"].get_running_loop()).__module__)
        return 0

    monkeypatch.setattr(app, "find_spec", lambda name: name if installed else None)
    with pytest.raises(click.exceptions.Exit):
        app.run(verb, uvloop=wanted)

    assert found[0].startswith(loop)


def test_what_a_verb_returns_is_the_exit_code() -> None:
    async def verb(code: int, *, more: int) -> int:
        return code + more

    with pytest.raises(click.exceptions.Exit) as exit:
        app.run(verb, 2, more=3)

    assert exit.value.exit_code == 5


@pytest.fixture
def nobody_debugs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FIBACTION_DEBUG", raising=False)


def run_main_with(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the command line, whose verb ends with that error."""

    def verb(**_: object) -> None:
        raise error

    monkeypatch.setattr(app.cli, "main", verb)
    app.main()


@pytest.mark.usefixtures("nobody_debugs")
def test_a_bug_is_one_line_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit:
        run_main_with(ZeroDivisionError("oh\n\x1b"), monkeypatch)

    assert exit.value.code == ExitCode.BUG
    assert capsys.readouterr().err == (
        "Error: ZeroDivisionError: oh\\x0a\\x1b (this is a bug; FIBACTION_DEBUG=1 shows where)\n"
    )


@pytest.mark.usefixtures("nobody_debugs")
def test_output_that_has_no_room_is_no_bug(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit:
        run_main_with(OSError(errno.ENOSPC, "No space left on device"), monkeypatch)

    assert exit.value.code == ExitCode.ABORTED
    assert capsys.readouterr().err == (
        "Error: the output cannot be written: No space left on device\n"
    )


def test_a_bug_that_is_looked_for_has_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIBACTION_DEBUG", "1")

    with pytest.raises(ZeroDivisionError):
        run_main_with(ZeroDivisionError(), monkeypatch)


def test_a_stream_that_is_no_file_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    class Nowhere:
        def write(self, text: str) -> int:
            return len(text)

        def flush(self) -> None:
            pass

    monkeypatch.setattr(sys, "stdout", Nowhere())
    monkeypatch.setattr(sys, "argv", ["fibaction", "--version"])

    with pytest.raises(SystemExit) as exit:
        app.main()

    assert exit.value.code == 0


def test_a_reader_who_has_enough_is_no_error(tcp: str) -> None:
    command = f"{Path(sys.executable).with_name('fibaction')} -u {tcp} list | head -n 1"

    run = subprocess.run(
        ["sh", "-c", command], capture_output=True, text=True, timeout=30, check=True
    )

    assert run.stdout == "/arm/pick\n"
    assert run.stderr == ""


# Actions by name


@pytest.mark.asyncio
@pytest.mark.parametrize("name", ["fibonacci", "/fibonacci", "arm/pick", "/arm/pick"])
async def test_a_slash_in_front_of_a_name_is_optional(name: str) -> None:
    async with serve(servers(), "inproc://names"), connect("inproc://names") as connection:
        info = await app.find_action(connection, name)

    assert info.name == name.lstrip("/")


@pytest.mark.asyncio
async def test_a_misspelt_action_suggests_the_near_one() -> None:
    async with serve(servers(), "inproc://names"), connect("inproc://names") as connection:
        with pytest.raises(Failure) as failure:
            await app.find_action(connection, "fibonaci")

    assert failure.value.message == ("nobody serves the action /fibonaci; did you mean /fibonacci?")
    assert failure.value.exit_code == ExitCode.UNREACHABLE


@pytest.mark.parametrize(
    ("known", "text"),
    [
        ([], "nobody serves the action /x, nor any other"),
        (["jump", "run"], "nobody serves the action /x; there is /jump, /run"),
        (
            [f"jump{i:02}" for i in range(12)],
            "nobody serves the action /x; there is "
            + ", ".join(f"/jump{i:02}" for i in range(10))
            + ", ...",
        ),
    ],
)
def test_where_no_name_is_near_there_is_a_list(known: list[str], text: str) -> None:
    assert app.no_action("x", map(ActionInfo, known)).message == text


def test_a_private_name_is_shown_without_a_slash() -> None:
    assert app.shown("~/jump") == "~/jump"


# How it is built


def test_no_verb_is_imported_before_it_is_used() -> None:
    tree = ast.parse(Path(app.__file__).read_text(encoding="utf-8"))
    imported = {
        node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module
    }

    assert not imported & {module for module, _, _ in app.VERBS.values()}


def test_the_log_of_the_command_is_on_stderr_from_warnings_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: dict[str, Any] = {}
    monkeypatch.setattr(logging, "basicConfig", lambda **settings: told.update(settings))
    monkeypatch.setattr(sys, "argv", ["fibaction", "--version"])

    with pytest.raises(SystemExit):
        app.main()

    assert told["level"] == logging.WARNING
    (handler,) = told["handlers"]
    record = logging.makeLogRecord({"name": "fibaction.wire", "msg": "gone\x1b"})
    assert handler.format(record) == "fibaction: gone\\x1b"
