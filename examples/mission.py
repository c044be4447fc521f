"""A mission: a robot drives to a shelf, picks a thing and places it on a table.

Each of these is a goal of an action of its own, which the executor of the mission sends as a step.
If the thing cannot be picked, the mission compensates for what it has done: it brings the robot
back to its dock, and says why. A cancel of the mission reaches the step that runs.

Without arguments, a cup is fetched, and an anvil is not; then the steps of both missions are
listed. Name other things to fetch these. With `--url`, the robot and its missions are served there
until Ctrl-C or SIGTERM.

Exit codes: 0 the program has ended or was stopped, 2 the command line or the URL is invalid.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import AsyncGenerator, Iterable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from signal import SIGINT, SIGTERM
from typing import Any, TypeAlias

import anyio
from msgspec import Struct

from fibaction import (
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalRejected,
    Report,
    TransportError,
    action,
    serve,
)

METER = 0.1  # seconds that the robot needs for one
HEAVY = ("anvil", "piano")  # too heavy for the gripper


class Feedback(Struct):
    """The progress of a step or of a mission, for people."""

    text: str


class Result(Struct):
    """The work that was done, as a text for people."""

    text: str


Client: TypeAlias = ActionClient[Any, Feedback, Result]
Server: TypeAlias = ActionServer[Any, Feedback, Result]


@action
async def drive(report: Report[Feedback], what: str) -> Result:
    """Drive to a place."""
    for meter in range(1, 4):
        await anyio.sleep(METER)
        await report(Feedback(f"{meter} m on the way to the {what}"))
    return Result(f"at the {what}")


@action
async def pick(report: Report[Feedback], what: str) -> Result:
    """Pick a thing, unless it is too heavy."""
    await report(Feedback("closing the gripper"))
    await anyio.sleep(METER)
    if what in HEAVY:
        raise GoalAborted(f"the {what} is too heavy")
    return Result(f"holding the {what}")


@action
async def place(report: Report[Feedback], what: str) -> Result:
    """Place the thing that the gripper holds."""
    await report(Feedback("opening the gripper"))
    await anyio.sleep(METER)
    return Result(f"the {what} is on the table")


def on_fetch(goal: Any) -> None:
    """Accept a mission for a thing with a name.

    Raises:
        GoalRejected: It has none.
    """
    if not goal.what.strip():
        raise GoalRejected("name the thing to fetch")


class Missions:
    """The executor of missions, with the clients by which it sends the steps."""

    def __init__(self, drive: Client, pick: Client, place: Client) -> None:
        self.drive, self.pick, self.place = drive, pick, place

    @action
    async def fetch(self, report: Report[Feedback], goal: GoalHandle[object], what: str) -> Result:
        """Drive, pick and place; drive back if the thing cannot be picked."""
        async with self.drive.send_goal("shelf", step=goal.step("drive")) as driving:
            async for feedback in driving.feedback:
                await report(feedback)
            await report(Feedback((await driving.result()).text))
        try:
            held = await self.pick.call(what, step=goal.step("pick", wait_for_end=True))
        except GoalAborted as error:
            await report(Feedback("driving back"))
            back = await self.drive.call("dock", step=goal.step("drive back"))
            raise GoalAborted(f"{error.reason}; the robot is {back.text}") from error
        await report(Feedback(held.text))
        return await self.place.call(what, step=goal.step("place"))


@asynccontextmanager
async def robot() -> AsyncGenerator[tuple[Server, Server, Server, Server], None]:
    """Run the servers of the steps; give them, and that of the missions, which is to stop first."""
    steps = ActionServer(drive), ActionServer(pick), ActionServer(place)
    async with AsyncExitStack() as stack:
        for server in steps:
            await stack.enter_async_context(server)
        missions = Missions(*(ActionClient(server, server.action) for server in steps))
        yield *steps, ActionServer(missions.fetch, on_goal=on_fetch)


async def demo(things: Iterable[str]) -> None:
    """Fetch things one after another, and list the steps that were taken."""
    async with robot() as (*steps, missions), missions:
        client = ActionClient(missions, Missions.fetch)
        for thing in things:
            await fetch(client, thing, [ActionClient(server, server.action) for server in steps])


async def fetch(client: Client, thing: str, steps: Iterable[Client]) -> None:
    """Fetch a thing, and print how it goes; then print the steps, which name their mission."""
    print(f"fetch     {thing}", flush=True)
    try:
        async with client.send_goal(thing) as mission:
            async for feedback in mission.feedback:
                print(f"          {feedback.text}", flush=True)
            print(f"done      {(await mission.result()).text}", flush=True)
    except GoalRejected as error:
        print(f"rejected  {error.reason}", flush=True)
        return
    except GoalAborted as error:
        print(f"aborted   {error.reason}", flush=True)
    goals = [goal for step in steps for goal in await step.goals()]
    for goal in sorted(goals, key=lambda goal: goal.stamp):
        if goal.parent is not None and goal.parent.goal_id == mission.goal_id:
            print(f"step      {goal.parent.step}: {goal.status.name}", flush=True)


async def serve_at(url: str) -> None:
    """Serve the robot and its missions until a signal arrives, then end the goals.

    Raises:
        TransportError: The URL is invalid or cannot be served at.
    """
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with robot() as servers, serve(servers, url) as (where,):
            logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
            names = ", ".join(server.action.name for server in servers)
            print(f"serving {names} at {where}, Ctrl-C stops them", flush=True)
            await anext(signals)


if __name__ == "__main__":
    # Without a usage, an error is one line; --help still lists the options.
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("things", metavar="THING", nargs="*", help="a thing to fetch")
    parser.add_argument("--url", help="URL to serve at (default: a demonstration in one process)")
    arguments = parser.parse_args()
    if arguments.url and arguments.things:
        parser.error("things are fetched in the demonstration only: leave out --url, or the things")
    try:
        if arguments.url is None:
            with suppress(KeyboardInterrupt):
                anyio.run(demo, arguments.things or ["cup", "anvil"])
        else:
            anyio.run(serve_at, arguments.url)
    except TransportError as exc:
        parser.error(str(exc))
