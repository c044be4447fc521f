"""The exit codes of the command, and the failures that lead to them."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Awaitable, Callable, Generator, Iterable
from contextlib import contextmanager
from enum import IntEnum
from typing import IO, Any, NoReturn, cast

import click

from fibaction.cli.output.escape import clean, clean_lines
from fibaction.cli.process import exit_at_once
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalTimeout,
    LimitReached,
    ProtocolError,
    ServerFailed,
    ServerNotFound,
    StoreError,
    TransportError,
    UnknownGoal,
)
from fibaction.words.goals import CancelAnswer, CancelCode


class ExitCode(IntEnum):
    """The exit code of the command."""

    SUCCEEDED = 0
    ABORTED = 1
    USAGE = 2
    CANCELED = 3
    REJECTED = 4
    TIMED_OUT = 5
    UNREACHABLE = 6
    """There is no such server or action, or the connection was lost."""
    STORE = 7
    """The file that keeps the goals cannot be used, or cannot be written to any more."""
    BUG = 70
    """`EX_SOFTWARE` of `sysexits.h`: an error of fibaction itself."""
    INTERRUPTED = exit_at_once.INTERRUPTED
    """As of a program that SIGINT has ended: Ctrl-C where no goal was to be canceled."""


_CODES: tuple[tuple[type[ActionError], ExitCode], ...] = (
    (GoalRejected, ExitCode.REJECTED),
    (GoalCanceled, ExitCode.CANCELED),
    (GoalAborted, ExitCode.ABORTED),
    (GoalTimeout, ExitCode.TIMED_OUT),
    (UnknownGoal, ExitCode.USAGE),
    (ServerNotFound, ExitCode.UNREACHABLE),
    (ConnectionLost, ExitCode.UNREACHABLE),
    (AuthenticationFailed, ExitCode.UNREACHABLE),
    (LimitReached, ExitCode.UNREACHABLE),
    (ServerFailed, ExitCode.UNREACHABLE),
    (TransportError, ExitCode.USAGE),  # all other transport errors: the URL cannot be used
    (ProtocolError, ExitCode.UNREACHABLE),
    (StoreError, ExitCode.STORE),
)

# Hints of the library for Python code.
_WAIT_HINT = re.compile(r", or wait for (it|one) with wait_for_server\(\)")
_CODE_HINT = re.compile(r" \(in code [^)]*\)")


class Failure(click.ClickException):
    """An error for the user: one sentence on stderr, and the exit code.

    The sentence is on one line, and text of a server in it cannot control the terminal.
    """

    def __init__(self, message: str, code: ExitCode = ExitCode.USAGE) -> None:
        super().__init__(clean(" ".join(line.strip() for line in message.splitlines())))
        self.exit_code = code  # type: ignore[misc]  # click, too, looks at the instance

    def show(self, file: IO[str] | None = None) -> None:
        if debugging():
            import traceback

            sys.stderr.write(clean_lines("".join(traceback.format_exception(self))))
        super().show(file)


def debugging() -> bool:
    """Return whether the user asks for tracebacks."""
    return bool(os.environ.get("FIBACTION_DEBUG"))


def failure_of(
    error: ActionError, advice: str = "or name another with --url or FIBACTION_URL"
) -> Failure:
    """Return the failure for an error. `advice` tells the user about another server to try."""
    code = next((code for kind, code in _CODES if isinstance(error, kind)), ExitCode.ABORTED)
    return Failure(message_of(error, advice), code)


@contextmanager
def advising(advice: str) -> Generator[None, None, None]:
    """Give the user this advice if the block finds no server.

    Raises:
        Failure: There is no server.
    """
    try:
        yield
    except ServerNotFound as exc:
        raise failure_of(exc, advice) from exc


def check_installed(module: str, what: str, extra: str) -> None:
    """Check that a module is installed, which an extra brings.

    Raises:
        Failure: It is not.
    """
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise Failure(f"{what} needs {module}: pip install 'fibaction[{extra}]'")


def reason_of(answer: CancelAnswer) -> str:
    """Return why goals are not canceled."""
    if answer.return_code is CancelCode.GOAL_TERMINATED:
        return "it has ended already"
    return answer.reason or "the server does not say why"


def message_of(error: ActionError | str, advice: str = "") -> str:
    """Return the message of an error without its hints for Python code.

    The hint to wait for the server becomes the `advice`.
    """
    text = _WAIT_HINT.sub(f", {advice}" if advice else "", str(error))
    return _CODE_HINT.sub("", text)


def run(
    verb: Callable[..., Awaitable[int]], *arguments: Any, uvloop: bool = False, **settings: Any
) -> NoReturn:
    """Run a verb's async function, and exit with the code that it returns.

    With `uvloop` it runs on uvloop, if that is installed: uvloop is faster, but starts more slowly.
    Such a verb handles signals by itself. Any other exits at once at Ctrl-C, unless it receives
    signals; also while it computes.

    Raises:
        click.exceptions.Exit: The function has ended.
    """
    from functools import partial
    from importlib.util import find_spec

    import anyio

    options = {"use_uvloop": uvloop and find_spec("uvloop") is not None}
    exits = signal.getsignal(signal.SIGINT) is signal.default_int_handler and not uvloop
    if exits:  # the event loop's own handler would wait for a task that computes
        signal.signal(signal.SIGINT, exit_at_once.exit_at_once)
    try:
        code = anyio.run(partial(verb, *arguments, **settings), backend_options=options)
    finally:
        if exits:
            signal.signal(signal.SIGINT, signal.default_int_handler)
    raise click.exceptions.Exit(code)


@contextmanager
def report_errors() -> Generator[None, None, None]:
    """Turn an error that ends a verb into a `Failure`, and an interruption into its exit code.

    Raises:
        Failure: The block ended with an `ActionError`, alone or in a group.
        click.exceptions.Exit: It was interrupted.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise click.exceptions.Exit(ExitCode.INTERRUPTED) from None
    except ActionError as exc:
        raise failure_of(exc) from exc
    except BaseExceptionGroup as group:
        raise _first(group) from group


def _first(group: BaseExceptionGroup[BaseException]) -> BaseException:
    """Return the first error of a task group that is for the user, or the first of all."""
    errors = list(_leaves(group))
    for error in errors:
        if isinstance(error, ActionError):
            return failure_of(error)
        if isinstance(error, click.ClickException | OSError):  # OSError: a pipe that is closed
            return error
    return errors[0]


def _leaves(error: Any) -> Iterable[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        for part in cast("BaseExceptionGroup[BaseException]", error).exceptions:
            yield from _leaves(part)
    else:
        yield error
