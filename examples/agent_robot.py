"""An agent that moves things: a language model drives a robot, and a person says yes or no.

The model here is a short list of what a model would do, so that the program needs no account of
one. It calls tools through the client of the Model Context Protocol's SDK, as assistants do, and
gets the robot's reasons, so that it can do better. The person is asked before each goal, and sees
all of it.

It needs the extra `mcp`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import anyio
from mcp import Client
from mcp_types import ElicitResult, TextContent
from msgspec import Struct

from fibaction import ActionServer, GoalRejected, Report, action, serve
from fibaction_transports.mcp import AgentPolicy, McpBridge

ROBOT = "inproc://robot"
ON_THE_TABLE = {"pen", "cup", "knife"}

# The robot


class Put(Struct):
    """A thing on the table, and the place for it."""

    thing: str
    place: str


class Done(Struct):
    """The end of it."""

    text: str


def on_goal(goal: Put) -> None:
    """Accept a thing that is there.

    Raises:
        GoalRejected: It is not.
    """
    if goal.thing not in ON_THE_TABLE:
        raise GoalRejected(f"there is no {goal.thing}, but {', '.join(sorted(ON_THE_TABLE))}")


@action
async def put(report: Report[str], goal: Put) -> Done:
    """Take a thing, and put it somewhere."""
    for step in (f"grasps the {goal.thing}", f"moves to the {goal.place}", "opens the hand"):
        await report(step)
        await anyio.sleep(0.05)
    ON_THE_TABLE.remove(goal.thing)
    return Done(f"the {goal.thing} is in the {goal.place}")


# The person and the model


async def person(context: Any, params: Any) -> ElicitResult:
    """Say yes, but not to a knife."""
    consents = "knife" not in params.message
    print(f"{' '.join(params.message.split())}\nperson: {'yes' if consents else 'no'}")
    return ElicitResult(action="accept" if consents else "decline", content={})


async def tidy(model: Client) -> None:
    """Tidy the table, as a model would: by what the answers say."""
    print("tools:", *(tool.name for tool in (await model.list_tools()).tools))
    for goal in (
        {"thing": "pencil", "place": "box"},
        {"thing": "pen", "place": "box"},
        {"thing": "knife", "place": "drawer"},
        {"thing": "cup", "place": "sink"},
    ):
        await call_put(model, goal)


async def call_put(model: Client, goal: Mapping[str, str]) -> None:
    """Call the tool, and print its progress and its answer."""

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        print("robot:", message)

    answer = await model.call_tool("put", dict(goal), progress_callback=on_progress)
    text, *_ = answer.content
    assert isinstance(text, TextContent)
    print("answer:", text.text)


async def main() -> None:
    """Serve the robot, and let the model tidy the table."""
    async with (
        serve(ActionServer(put, on_goal=on_goal), ROBOT),
        McpBridge(ROBOT, AgentPolicy(allow=("put",))) as bridge,
        Client(bridge.server, elicitation_callback=person) as model,
    ):
        await tidy(model)
    print("left:", *ON_THE_TABLE)


if __name__ == "__main__":
    anyio.run(main)
