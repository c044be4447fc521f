"""Exit codes, and errors as sentences."""

from __future__ import annotations

import errno
import importlib.util
import sys
from collections.abc import Awaitable, Callable

import anyio
import click
import pytest

from fibaction import (
    ActionError,
    AuthenticationFailed,
    CancelRejected,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalID,
    GoalRejected,
    ProtocolError,
    ServerNotFound,
    StoreError,
    TransportError,
    UnknownGoal,
)
from fibaction.cli.output.escape import clean_lines
from fibaction.cli.process import exit_codes
from fibaction.cli.process.exit_codes import (
    ExitCode,
    Failure,
    check_installed,
    failure_of,
    message_of,
    report_errors,
)
from tests.cli.conftest import Invoke


def run(verb: Callable[[], Awaitable[int]]) -> None:
    """Run a verb as the group of verbs does."""
    with report_errors():
        exit_codes.run(verb)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (GoalAborted("no"), 1),
        (GoalCanceled("no"), 3),
        (GoalRejected("no"), 4),
        (ServerNotFound("no"), 6),
        (ConnectionLost("no"), 6),
        (AuthenticationFailed("no"), 6),
        (ProtocolError("no"), 6),
        (TransportError("no"), 2),
        (UnknownGoal(GoalID(bytes(16))), 2),
        (CancelRejected("no"), 1),
        (StoreError("no"), 7),
    ],
)
def test_every_error_has_its_exit_code_alone_and_in_a_group(error: ActionError, code: int) -> None:
    async def alone() -> int:
        raise error

    async def grouped() -> int:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(alone)
        raise AssertionError

    for verb in (alone, grouped):
        with pytest.raises(Failure) as failure:
            run(verb)
        assert failure.value.exit_code == code
        assert failure.value.message == str(error)


@pytest.mark.parametrize(
    ("wanted", "installed", "loop"),
    [(True, True, "uvloop"), (True, False, "asyncio"), (False, True, "asyncio")],
)
def test_a_verb_that_serves_runs_on_uvloop_where_that_is_installed(
    monkeypatch: pytest.MonkeyPatch, wanted: bool, installed: bool, loop: str
) -> None:
    found: list[str] = []

    async def verb() -> int:
        # Not imported: only this test looks below anyio.
        found.append(type(sys.modules["asyncio"].get_running_loop()).__module__)
        return 0

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name if installed else None)
    with pytest.raises(click.exceptions.Exit):
        exit_codes.run(verb, uvloop=wanted)

    assert found[0].startswith(loop)


SAID = "no\x1b[2J\nGoal finished with status: SUCCEEDED"
CLEANED = "no\\x1b[2J Goal finished with status: SUCCEEDED"
QUOTED = "no\\x1b[2J\\x0aGoal finished with status: SUCCEEDED"
"""As an error of the library quotes it."""


def test_what_a_server_says_in_an_error_cannot_control_the_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for error, cleaned in ((GoalRejected(SAID), QUOTED), (ConnectionLost(SAID), CLEANED)):
        failure = failure_of(error)
        failure.show()
        assert cleaned in failure.message
        assert failure.message == str(error).replace(SAID, CLEANED)
        assert capsys.readouterr().err == f"Error: {failure.message}\n"


def test_nor_can_it_in_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FIBACTION_DEBUG", "1")
    with pytest.raises(Failure) as failure, report_errors():
        raise GoalRejected(SAID)
    failure.value.show()

    shown = capsys.readouterr().err
    assert shown.startswith("Traceback (most recent call last):\n")
    assert f"GoalRejected: {clean_lines(str(GoalRejected(SAID)))}\n" in shown
    assert "\x1b" not in shown


def test_how_python_spells_a_setting_is_left_out() -> None:
    error = TransportError(
        "use tls://, or append ?insecure=true to the URL (in code insecure=True)"
    )
    assert message_of(error) == "use tls://, or append ?insecure=true to the URL"


def test_a_module_of_an_extra_is_needed() -> None:
    check_installed("click", "fibaction", "cli")
    with pytest.raises(Failure, match=r"^--fly needs no_wings: pip install 'fibaction\[air\]'$"):
        check_installed("no_wings", "--fly", "air")


def test_a_traceback_is_shown_only_if_it_is_asked_for(invoke: Invoke) -> None:
    plain = invoke("-u", "nonsense", "list")
    debugged = invoke("-u", "nonsense", "list", env={"FIBACTION_DEBUG": "1"})

    assert "Traceback" not in plain.stderr
    assert "Traceback" in debugged.stderr
    assert "fibaction.words.errors.InvalidURL" in debugged.stderr
    assert debugged.stderr.endswith(plain.stderr)
    assert plain.exit_code == debugged.exit_code == ExitCode.USAGE


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ([ZeroDivisionError(), Failure("it is wrong")], Failure),
        ([ZeroDivisionError(), ValueError()], ZeroDivisionError),
        ([BrokenPipeError(errno.EPIPE, "closed"), ZeroDivisionError()], BrokenPipeError),
    ],
)
def test_of_the_errors_of_a_group_that_for_the_user_comes_out(
    errors: list[Exception], expected: type[Exception]
) -> None:
    with pytest.raises(expected), report_errors():
        raise ExceptionGroup("tasks", [ExceptionGroup("tasks", errors)])
