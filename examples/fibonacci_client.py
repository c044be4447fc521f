"""A client that sends one Fibonacci goal and prints its progress. Ctrl-C cancels the goal.

Exit codes: 0 succeeded, 1 aborted, 3 canceled, 4 rejected, 6 no server or connection lost,
2 the command line or the URL is invalid.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import AsyncIterator, Iterable
from importlib.util import find_spec
from signal import SIGINT, SIGTERM, Signals

import anyio
from fibonacci import FIBONACCI, URL, Feedback, Goal, Result

from fibaction import (
    ActionClient,
    CancelAnswer,
    ConnectionLost,
    GoalID,
    GoalRejected,
    GoalStatus,
    ServerNotFound,
    TransportError,
    connect,
)

UNUSABLE, CANCELED, REJECTED, UNREACHABLE = 2, 3, 4, 6
EXIT_CODES = {
    GoalStatus.SUCCEEDED: 0,
    GoalStatus.ABORTED: 1,
    GoalStatus.UNKNOWN: 1,  # the server has forgotten the goal
    GoalStatus.CANCELED: CANCELED,
}


async def run_goal(
    client: ActionClient[Goal, Feedback, Result],
    order: int,
    *,
    cancel_after: int | None = None,
    goal_id: GoalID | None = None,
) -> int:
    """Send one goal, print its events, and return the exit code for its end.

    With `cancel_after`, the goal is canceled after that many feedback messages.

    Raises:
        ServerNotFound: No server serves the action.
        ConnectionLost: The connection ended before the goal did.
    """
    tell("goal", f"order {order}")
    try:
        async with client.send_goal(Goal(order), goal_id=goal_id) as goal:
            tell("accepted", goal.goal_id)
            if cancel_after == 0:
                tell_cancel(await goal.cancel())
            received = 0
            async for feedback in goal.feedback:
                tell("feedback", numbers(feedback.partial_sequence))
                received += 1
                if received == cancel_after:
                    tell_cancel(await goal.cancel())
            outcome = await goal.outcome()
    except GoalRejected as exc:
        tell("rejected", exc.reason)
        return REJECTED
    tell(outcome.status.name.lower(), outcome.reason)
    if outcome.result is not None:
        tell("result", numbers(outcome.result.sequence))
    return EXIT_CODES[outcome.status]


def tell_cancel(answer: CancelAnswer) -> None:
    """Print the server's answer to a cancel."""
    reason = answer.reason or answer.return_code.name
    tell("cancel", "accepted" if answer.accepted else f"rejected: {reason}")


def tell(what: str, more: object = "") -> None:
    """Print one line without delay."""
    print(f"{what:<10}{more}".rstrip(), flush=True)


def numbers(sequence: Iterable[int]) -> str:
    """Return the numbers as text, with spaces between them."""
    return " ".join(map(str, sequence))


async def main(url: str, order: int, cancel_after: int | None) -> int:
    """Run one goal at the URL, and return the exit code."""
    code = CANCELED
    goal_id = GoalID.random()
    try:
        async with connect(url, FIBONACCI) as client, anyio.create_task_group() as tasks:
            # Until the connection is open, Ctrl-C ends the program as usual.
            with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
                tasks.start_soon(cancel_on_signal, signals, client, goal_id, tasks.cancel_scope)
                code = await run_goal(client, order, cancel_after=cancel_after, goal_id=goal_id)
                tasks.cancel_scope.cancel()
    except* (ServerNotFound, ConnectionLost) as unreachable:
        code = UNREACHABLE
        complain(unreachable)
    except* TransportError as unusable:
        code = UNUSABLE
        complain(unusable)
    return code


async def cancel_on_signal(
    signals: AsyncIterator[Signals],
    client: ActionClient[Goal, Feedback, Result],
    goal_id: GoalID,
    scope: anyio.CancelScope,
) -> None:
    """Cancel the goal at the first signal, and stop waiting for its end at the second."""
    await anext(signals)
    tell_cancel(await client.cancel_goals(goal_id))
    await anext(signals)
    scope.cancel()


def complain(errors: ExceptionGroup[TransportError]) -> None:
    """Print the first error on one line. The tasks of the goal and of the signals may both fail."""
    print(f"error: {errors.exceptions[0]}", file=sys.stderr)


def int32(text: str) -> int:
    """Read an integer that fits the `int32 order` of the ROS 2 action.

    Raises:
        ValueError: The text is something else.
    """
    value = int(text)
    if not -(2**31) <= value < 2**31:
        raise ValueError(text)
    return value


def count(text: str) -> int:
    """Read an integer, 0 or more.

    Raises:
        ValueError: The text is something else.
    """
    value = int(text)
    if value < 0:
        raise ValueError(text)
    return value


if __name__ == "__main__":
    # Without a usage, an error is one line; --help still lists the options.
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("--url", default=URL, help="URL of the server (default: %(default)s)")
    parser.add_argument(
        "--order", type=int32, default=10, help="index of the last number (default: %(default)d)"
    )
    parser.add_argument(
        "--cancel-after", type=count, metavar="N", help="cancel after N feedback messages"
    )
    arguments = parser.parse_args()
    goal = (arguments.url, arguments.order, arguments.cancel_after)
    options = {"use_uvloop": find_spec("uvloop") is not None}
    try:
        sys.exit(anyio.run(main, *goal, backend_options=options))
    except KeyboardInterrupt:
        sys.exit(CANCELED)
