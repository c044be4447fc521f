"""How a command ends: its exit code, and errors as one sentence."""

from __future__ import annotations

import os
import re
import sys
import traceback
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from enum import IntEnum
from typing import IO, Any, cast

import click

from fibaction.cli.escaping import clean, clean_lines
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    LimitReached,
    ProtocolError,
    ServerFailed,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)


class ExitCode(IntEnum):
    """What the shell is told."""

    SUCCEEDED = 0
    ABORTED = 1
    USAGE = 2
    CANCELED = 3
    REJECTED = 4
    TIMED_OUT = 5
    UNREACHABLE = 6
    """There is no such server or action, or the connection was lost."""
    BUG = 70
    """`EX_SOFTWARE` of `sysexits.h`: an error of fibaction itself."""
    INTERRUPTED = 130
    """As for a program that SIGINT has ended: Ctrl-C where no goal was to be canceled."""


_CODES: tuple[tuple[type[ActionError], ExitCode], ...] = (
    (GoalRejected, ExitCode.REJECTED),
    (GoalCanceled, ExitCode.CANCELED),
    (GoalAborted, ExitCode.ABORTED),
    (UnknownGoal, ExitCode.USAGE),
    (ServerNotFound, ExitCode.UNREACHABLE),
    (ConnectionLost, ExitCode.UNREACHABLE),
    (AuthenticationFailed, ExitCode.UNREACHABLE),
    (LimitReached, ExitCode.UNREACHABLE),
    (ServerFailed, ExitCode.UNREACHABLE),
    (TransportError, ExitCode.USAGE),  # what is left of it: a URL that cannot be used
    (ProtocolError, ExitCode.UNREACHABLE),
)


_FOR_PROGRAMS = re.compile(r", or wait for (it|one) with wait_for_server\(\)")
"""What transports advise if nobody is there."""


class Failure(click.ClickException):
    """One sentence for the user on stderr, and the exit code. It is on one line, and what a server
    has said in it cannot control the terminal.
    """

    def __init__(self, message: str, code: ExitCode) -> None:
        super().__init__(clean(" ".join(line.strip() for line in message.splitlines())))
        self.exit_code = code  # type: ignore[misc]  # click, too, looks at the instance

    def show(self, file: IO[str] | None = None) -> None:
        if debugging():
            sys.stderr.write(clean_lines("".join(traceback.format_exception(self))))
        super().show(file)


def debugging() -> bool:
    """Whether tracebacks are wanted."""
    return bool(os.environ.get("FIBACTION_DEBUG"))


def failure_of(
    error: ActionError, advice: str = "or name another with --url or FIBACTION_URL"
) -> Failure:
    """What the user is told of an error, with `advice` on what else to do if nobody listens."""
    code = next((code for kind, code in _CODES if isinstance(error, kind)), ExitCode.ABORTED)
    return Failure(sentence_of(error, advice), code)


def sentence_of(error: ActionError, advice: str = "") -> str:
    """What an error says, without what it advises to programs: who types a command can do something
    else, which is the `advice`.
    """
    return _FOR_PROGRAMS.sub(f", {advice}" if advice else "", str(error))


@contextmanager
def telling_errors() -> Generator[None, None, None]:
    """Turn what can end a verb early into what the user is told, and an exit code.

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
    """The error behind a group of tasks that ended with it: the first that is for the user."""
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
