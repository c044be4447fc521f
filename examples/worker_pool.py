"""A render farm: four workers, a bounded queue, urgent shots first, and deadlines.

Goals run on four workers at once, and six more may wait. A waiting goal is ACCEPTED: it can be
followed and canceled. Any other goal is rejected as busy, and its client tries again.

Without arguments, a studio orders one shot more than the farm has room for, and a preview that it
can use for a short time only. With `--url`, the farm is served there until Ctrl-C or SIGTERM.

Exit codes: 0 the program has ended or was stopped, 2 the command line or the URL is invalid.
"""

from __future__ import annotations

import argparse
import logging
import sys
from contextlib import suppress
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
from msgspec import Struct

from fibaction import (
    ActionClient,
    ActionError,
    ActionServer,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
    Report,
    Retry,
    Schedule,
    TransportError,
    action,
    connect,
    serve,
)

HERE = "inproc://farm"
FRAME = 0.1  # seconds that one frame takes
URGENT, USUAL = 5, 1
PATIENT = Retry(attempts=10, delay=0.4)  # only while the farm is busy


class Goal(Struct):
    """An order to render the frames of a shot; the larger its urgency, the sooner it starts."""

    shot: str
    frames: int
    urgency: int = USUAL


class Feedback(Struct):
    """The number of frames that are rendered."""

    frames: int


class Result(Struct):
    """The number of frames that were rendered, also if the order was canceled."""

    frames: int


def on_goal(goal: Goal) -> None:
    """Accept an order of at least one frame.

    Raises:
        GoalRejected: There is nothing to render.
    """
    if goal.frames < 1:
        raise GoalRejected(f"a shot has 1 frame or more, not {goal.frames}")


@action
async def render(report: Report[Feedback], handle: GoalHandle[object], goal: Goal) -> Result:
    """Render one frame after another, unless the client's deadline comes before the last one."""
    seconds_left = handle.deadline - anyio.current_time()
    if goal.frames * FRAME > seconds_left:
        raise GoalAborted(f"it takes too long for the {seconds_left:.1f} s that are left")
    frames = 0
    try:
        while frames < goal.frames:
            await anyio.sleep(FRAME)  # for real work: `await anyio.to_process.run_sync(...)`
            frames += 1
            await report(Feedback(frames))
    except anyio.get_cancelled_exc_class():
        raise GoalCanceled(result=Result(frames)) from None
    return Result(frames)


def make_server(workers: int, queue: int) -> ActionServer[Any, Feedback, Result]:
    """Return a farm with so many workers, where so many goals may wait.

    Raises:
        ValueError: A number is out of range.
    """
    schedule = Schedule(
        concurrency=workers,
        queue=queue,
        priority=lambda goal: goal.urgency,
        run_timeout=3600,  # a shot that hangs does not keep its worker for ever
    )
    return ActionServer(render, on_goal=on_goal, schedule=schedule)


async def demo(workers: int, queue: int) -> None:
    """Serve a farm, and order one shot more than there is room for."""
    async with (
        serve(make_server(workers, queue), HERE),
        connect(HERE, render) as client,
        anyio.create_task_group() as tasks,
    ):
        for number in range(1, workers + queue - 1):
            tasks.start_soon(order, client, Goal(f"shot {number}", frames=4 + number % 3))
        tasks.start_soon(order, client, Goal("preview", frames=4), 0.6)
        tasks.start_soon(order, client, Goal("trailer", frames=4, urgency=URGENT))
        tasks.start_soon(order, client, Goal("credits", frames=2))


async def order(
    client: ActionClient[Any, Feedback, Result], goal: Goal, timeout: float | None = None
) -> None:
    """Order a shot that is of use for so many seconds, and print how it goes."""

    def tell(what: object) -> None:
        print(f"{goal.shot:<9}{what}", flush=True)

    def on_feedback(feedback: Feedback) -> None:
        if feedback.frames == 1:
            tell("has begun")

    tell("is ordered")
    try:
        result = await client.call(goal, on_feedback=on_feedback, timeout=timeout, retry=PATIENT)
    except ActionError as error:
        tell(error)
    else:
        tell(f"is done: {result.frames} frames")


async def serve_at(url: str, workers: int, queue: int) -> None:
    """Serve a farm until a signal arrives, then end the goals.

    Raises:
        TransportError: The URL is invalid or cannot be served at.
    """
    server = make_server(workers, queue)
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with serve(server, url) as (where,):
            print(f"serving {render.name} at {where}, Ctrl-C stops it", flush=True)
            await anext(signals)


if __name__ == "__main__":
    # Without a usage, an error is one line; --help still lists the options.
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("--url", help="URL to serve at (default: a demonstration in one process)")
    parser.add_argument(
        "--workers", type=int, default=4, help="goals that run at once (default: %(default)d)"
    )
    parser.add_argument(
        "--queue", type=int, default=6, help="goals that may wait (default: %(default)d)"
    )
    arguments = parser.parse_args()
    try:
        if arguments.url is None:
            # Attempts after the first are told in this log only.
            logging.basicConfig(stream=sys.stdout, format="log      %(message)s")
            logging.getLogger("fibaction.client").setLevel(logging.INFO)
            with suppress(KeyboardInterrupt):
                anyio.run(demo, arguments.workers, arguments.queue)
        else:
            logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
            anyio.run(serve_at, arguments.url, arguments.workers, arguments.queue)
    except (TransportError, ValueError) as exc:
        parser.error(str(exc))
