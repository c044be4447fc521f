"""`fibaction send_goal`: send a goal, print its events, and exit with the code for its end."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import anyio
import click
import msgspec
from anyio import get_cancelled_exc_class

from fibaction._api import ClientConnection, connect
from fibaction._runtime.text import printable
from fibaction.border.abc import Endpoint, GoalStream
from fibaction.border.event_loop import Background
from fibaction.cli.arguments.completion import ACTION, TYPE_OR_GOAL, namespace_option
from fibaction.cli.arguments.goal_text import PAIR, Pairs, read_goal, shell_meta
from fibaction.cli.arguments.names import Namespace, find_action, is_type, shown
from fibaction.cli.arguments.options import (
    NumberType,
    full_option,
    json_option,
    labels_option,
    url_option,
)
from fibaction.cli.output.goal_table import ordinal
from fibaction.cli.output.lines import note, say
from fibaction.cli.output.render import goal_printer, print_goal
from fibaction.cli.process.exit_codes import ExitCode, Failure, message_of, run
from fibaction.cli.process.signals import SAME_SIGNAL, SignalReceiver
from fibaction.schema.payload import JsonCodec
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import ActionError, ConnectionLost, GoalRejected, ServerNotFound
from fibaction.words.goal_query import Labels
from fibaction.words.goals import CancelCode, GoalID

_TYPE_NAME = re.compile(
    r"/?(\w+)(/|\.|::)action\2(\w+)|(\w+_(?:msgs|interfaces|actions?))(?:/|\.|::)([A-Z]\w*)",
    re.ASCII,
)


class SendTimes(NamedTuple):
    """The seconds that the command waits."""

    cancel: float = 5.0
    """For a goal to be canceled and to end after its --timeout, and for a cancel without which the
    command could end."""
    queue: float = 0.5
    """Until the command tells that a goal waits in a queue."""
    announce: float = 0.25
    """Until a goal is printed that the server has not decided."""
    same_signal: float = SAME_SIGNAL
    """Within which two signals count as one."""


USUAL_TIMES = SendTimes()


class SendOptions(msgspec.Struct, frozen=True):
    """The options of `send_goal`."""

    feedback: bool = False
    timeout: float | None = None
    detach: bool = False
    as_json: bool = False
    full: bool = False
    labels: Labels = ()


@click.command(
    "send_goal",
    epilog="""\b
Examples:
  fibaction send_goal drive meters=3 speed=1.5
  fibaction send_goal fibonacci "order: 10" -f
  fibaction send_goal fibonacci arduinobot_msgs/action/Fibonacci "{order: 10}" --json
  fibaction send_goal arm/pick --goal-file pick.yaml --timeout 30
  echo "order: 10" | fibaction send_goal fibonacci --stdin

Ctrl-C cancels the goal and waits for its end; a second Ctrl-C leaves at once.""",
)
@click.argument("name", type=ACTION)
@click.argument("rest", nargs=-1, metavar="[TYPE] [GOAL | FIELD=VALUE...]", type=TYPE_OR_GOAL)
@click.option("-f", "--feedback", is_flag=True, help="Print the feedback as it comes.")
@click.option("--stdin", "from_stdin", is_flag=True, help="Read the goal from stdin.")
@click.option("--goal-file", type=click.Path(path_type=Path), help="Read the goal from a file.")
@click.option(
    "-t",
    "--timeout",
    type=NumberType(),
    metavar="SECONDS",
    help="Cancel the goal if it has not ended by then.",
)
@click.option("--detach", is_flag=True, help="Print the goal's ID, and do not wait for its end.")
@labels_option("Give the goal this label, to find it again; may be given several times.")
@namespace_option
@full_option
@json_option
@url_option
def send_goal_command(
    name: str,
    rest: tuple[str, ...],
    feedback: bool,
    from_stdin: bool,
    goal_file: Path | None,
    timeout: float | None,
    detach: bool,
    labels: Labels,
    namespace: Namespace,
    full: bool,
    as_json: bool,
    url: str,
) -> None:
    """Send a goal to the action NAME, and follow it to its end.

    GOAL is YAML or JSON, or one FIELD=VALUE for each field; pose.x=1 is a field in a field. Fields
    with a default are optional; without GOAL all of them have their defaults. The goal is checked
    before it is sent. TYPE, as in package/action/Type, is optional.
    """
    type_name, text = _type_and_text(rest)
    text = _text_from(text, from_stdin, goal_file)
    if detach and feedback:
        raise click.UsageError("--detach does not wait for feedback: use attach instead")
    options = SendOptions(feedback, timeout, detach, as_json, full, labels)
    run(send, url, namespace.absolute(name), type_name, text, options)


def _type_and_text(rest: tuple[str, ...]) -> tuple[str, str | Pairs | None]:
    """Tell TYPE and GOAL apart if only one of them is given."""
    pairs = rest[1:] if rest and _TYPE_NAME.fullmatch(rest[0]) else rest
    if pairs and all(map(PAIR.fullmatch, pairs)):
        return _type_and_text(rest[: len(rest) - len(pairs)])[0], pairs
    match rest:
        case ():
            return "", None
        case (one,):
            found = _TYPE_NAME.fullmatch(one)
            return (
                (f"{found[1] or found[4]}/action/{found[3] or found[5]}", None)
                if found
                else ("", one)
            )
        case (field, text) if field.endswith(":"):
            return "", f"{field} {text}"  # YAML without its quotes
        case (type_name, text):
            return type_name, text
        case _:
            raise click.UsageError(
                f"{rest[2]!r} is too much after NAME, TYPE and GOAL: put the goal into quotes, or"
                f" write each field as FIELD=VALUE"
            )


def _text_from(text: str | Pairs | None, from_stdin: bool, file: Path | None) -> str | Pairs:
    """Return the goal's text, from the one place that was given."""
    if (text is not None) + from_stdin + (file is not None) > 1:
        raise click.UsageError("the goal is given twice: as GOAL, by --stdin or by --goal-file")
    try:
        if file is not None:
            return file.read_text(encoding="utf-8-sig")
        if from_stdin:
            return sys.stdin.buffer.read().decode("utf-8-sig")
    except OSError as exc:
        raise Failure(f"{file}: {exc.strerror}") from exc
    except UnicodeDecodeError as exc:
        raise Failure(f"{file or 'stdin'} is not UTF-8 text: {exc}") from exc
    return text or ""


async def send(
    url: str,
    name: str,
    type_name: str,
    text: str | Pairs,
    options: SendOptions,
    times: SendTimes = USUAL_TIMES,
) -> int:
    """Send a goal, print its events until it ends, and return the exit code.

    Raises:
        Failure, ActionError: It cannot be sent, or cannot be followed to its end.
    """
    return await _GoalSender(options, times).run(url, name, type_name, text)


def goal_for(info: ActionInfo, type_name: str, text: str | Pairs) -> Any:
    """Return the goal, checked against the schema of the action.

    Raises:
        Failure: The text is not such a goal, or the action is of another type.
    """
    if type_name and not info.type_name:
        note(f"the server of {shown(info.name)} does not say its type, so it is not checked")
    elif type_name and not is_type(type_name, info.type_name):
        raise Failure(
            f"the action {shown(info.name)} is of the type {info.type_name}, not {type_name}"
        )
    return read_goal(text, info.goal)


class _GoalSender:
    """Sends one goal, and ends it early at Ctrl-C or at the timeout."""

    def __init__(self, options: SendOptions, times: SendTimes) -> None:
        self._options = options
        self._times = times
        self._printer = goal_printer(
            feedback=options.feedback, as_json=options.as_json, full=options.full
        )
        self._all = anyio.CancelScope()
        self._withdrawal = anyio.CancelScope(shield=True)
        self._endpoint: Endpoint
        self._goal_id = GoalID.random()
        self._phase: Literal["preparing", "sent", "accepted"] = "preparing"
        self._late = False
        self._is_announced = False
        self._deadline = math.inf

    async def run(self, url: str, name: str, type_name: str, text: str | Pairs) -> int:
        with SignalReceiver(self._left) as signals:
            async with Background() as tasks:
                tasks.start_soon(self._handle_signals, signals)
                if self._options.timeout is not None:
                    self._deadline = anyio.current_time() + self._options.timeout
                    tasks.start_soon(self._limit, self._options.timeout)
                with self._all:
                    async with connect(url) as connection:
                        code = await self._send(connection, name, type_name, text)
                        return ExitCode.TIMED_OUT if self._late else code
        return self._left()

    async def _send(
        self, connection: ClientConnection, name: str, type_name: str, text: str | Pairs
    ) -> ExitCode:
        info = await find_action(connection, name)
        goal = goal_for(info, type_name, text)
        action = Action.untyped(info)
        payload = action.goal.encode(goal)
        self._endpoint = connection.endpoint(action)
        left_out = [] if self._options.detach else JsonCodec(info.goal).left_out(goal)
        async with Background() as tasks:
            tasks.start_soon(self._announce_later, goal, left_out)
            try:
                stream = await self._deliver(payload)
            except GoalRejected as exc:
                self._announce(goal, left_out)
                self._printer.rejected(exc)
                return ExitCode.REJECTED
            self._announce(goal, left_out)
        if self._options.detach and not self._options.as_json:
            say(str(self._goal_id))
        else:
            self._printer.accepted(self._goal_id, stream.stamp)
        if self._options.detach:
            return ExitCode.SUCCEEDED
        try:
            live = self._options.feedback and not self._options.full
            async with Background() as tasks:
                if not self._options.as_json:
                    tasks.start_soon(self._tell_place)
                return await print_goal(stream, action, self._printer, live=live)
        except (ConnectionLost, ServerNotFound):
            note(f"The goal {self._goal_id} was accepted, and it is not known whether it goes on:")
            note(f"when its server is back, `fibaction attach {self._goal_id}` tells its end.")
            raise
        except OSError:
            with anyio.move_on_after(self._times.cancel):
                await self._cancel()  # the reader of the output has gone
            raise

    async def _deliver(self, payload: bytes) -> GoalStream:
        self._phase = "sent"
        feedback = (self._options.feedback or self._printer.wants_all) and not self._options.detach
        try:
            stream = await self._endpoint.send_goal(
                self._goal_id,
                payload,
                feedback=feedback,
                timeout=self._time_left(),
                meta=shell_meta(self._options.labels, is_detached=self._options.detach),
                checked=True,
            )
        except get_cancelled_exc_class():
            # It may have arrived, and no client would know of it.
            self._withdrawal.deadline = anyio.current_time() + self._times.cancel
            with self._withdrawal, suppress(ActionError):
                await self._endpoint.cancel_goals(self._goal_id)
            raise
        self._phase = "accepted"
        return stream

    async def _announce_later(self, goal: Any, left_out: Sequence[str]) -> None:
        """Announce the goal while its server decides: a goal that cannot be sent fails before."""
        await anyio.sleep(self._times.announce)
        self._announce(goal, left_out)

    def _announce(self, goal: Any, left_out: Sequence[str]) -> None:
        """Print the goal, if that was not done."""
        if self._is_announced or self._options.detach:
            return
        self._is_announced = True
        self._printer.sending(goal)
        if left_out:
            note(f"The server fills in: {printable(', '.join(left_out))}")

    async def _tell_place(self) -> None:
        """Print the goal's place if it still waits in a queue after a while."""
        await anyio.sleep(self._times.queue)
        with suppress(ActionError):  # the client may not observe, for example
            with await self._endpoint.status() as statuses:
                infos = await statuses.listed()
            place = next((one for one in infos if one.goal_id == self._goal_id and one.place), None)
            if place is not None:
                note(f"The goal waits, {ordinal(place.place)} of {place.queue_length}.")

    def _time_left(self) -> float | None:
        """Return the seconds until the goal is given up; None if it is not."""
        left = self._deadline - anyio.current_time()
        return None if left == math.inf else left

    # Ending it early

    async def _handle_signals(self, signals: SignalReceiver) -> None:
        """Cancel the goal at the first Ctrl-C, and leave at the second."""
        await signals.next()
        first = latest = anyio.current_time()
        async with anyio.create_task_group() as meanwhile:
            if self._phase == "accepted":
                note("Canceling goal... (Ctrl-C again leaves it running)")
                meanwhile.start_soon(self._cancel)  # while the line is broken, it gets no answer
            else:
                self._all.cancel()
            while latest - first <= self._times.same_signal:
                await signals.next()
                latest = anyio.current_time()
            meanwhile.cancel_scope.cancel()
        self._withdrawal.cancel()
        self._all.cancel()

    async def _limit(self, seconds: float) -> None:
        await anyio.sleep(seconds)
        self._late = True
        if self._phase == "accepted":
            note(f"The goal has not ended within {seconds:g} s. Canceling goal...")
            with anyio.move_on_after(self._times.cancel):
                if await self._cancel():
                    await anyio.sleep_forever()
        self._all.cancel()

    async def _cancel(self) -> bool:
        """Ask the server to cancel the goal, and return whether its end can be expected."""
        try:
            answer = await self._endpoint.cancel_goals(self._goal_id)
        except ActionError as exc:
            note(f"It could not be canceled: {message_of(exc)}")
            return False
        if answer.return_code is CancelCode.REJECTED:
            note(f"The server does not cancel it: {answer.reason or 'it does not say why'}")
            return False
        return True

    def _left(self) -> ExitCode:
        """Print what is left behind, and return the exit code."""
        if self._phase == "accepted":
            note(f"The goal {self._goal_id} was left, and may continue.")
            return ExitCode.TIMED_OUT if self._late else ExitCode.INTERRUPTED
        if self._late:
            what = "accepted the goal" if self._phase == "sent" else "answered"
            note(f"The server has not {what} within {self._options.timeout:g} s.")
            return ExitCode.TIMED_OUT
        if self._phase == "sent":
            note("The goal was canceled before the server had accepted it.")
            return ExitCode.CANCELED
        return ExitCode.INTERRUPTED
