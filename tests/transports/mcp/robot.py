"""A robot for agents, a client of the SDK that is connected to its bridge, and what was said."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, Literal, TypeAlias, cast

import anyio
from mcp import Client
from mcp_types import (
    CallToolResult,
    ElicitRequestFormParams,
    ElicitResult,
    InputRequiredResult,
    TextContent,
)

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    ClientGoal,
    GoalHandle,
    serve,
)
from fibaction_transports.mcp import AgentPolicy, McpBridge
from tests.support.processes import PATIENCE
from tests.transports.driving_robot import DRIVE, Arrived, Drive, Driven, DrivingRobot

Mode = Literal["legacy", "auto"]
MODES: tuple[Mode, ...] = ("legacy", "auto")
"""The protocol with a handshake, and the one without."""
Answer: TypeAlias = Literal["accept", "decline", "cancel"] | Callable[..., Any] | None
UNASKED = AgentPolicy(unasked=("*",))


COUNT = Action("count", goal=int, feedback=int, result=str)


class Robot(DrivingRobot):
    """A robot that drives, and counts."""

    def __init__(self) -> None:
        super().__init__()
        self.waits = anyio.Event()
        """Set when a goal of 100 m or more has begun; only a cancel ends it."""
        self.count = ActionServer(COUNT, self._count)

    async def _meters(self, meters: int) -> AsyncIterator[int]:
        yield 1
        if meters >= 100:
            self.waits.set()
            await anyio.sleep_forever()

    async def _count(self, goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        yield "x" * goal.request


class Talk:
    """A client of the SDK, and what came of it."""

    def __init__(self) -> None:
        self.client: Client
        self.bridge: McpBridge
        self.asked: list[str] = []
        """The questions to the user."""
        self.progress: list[tuple[float, str | None]] = []
        self.totals: list[float | None] = []
        """The totals of the progress."""
        self.told = anyio.Event()
        """Set at each change of the list of tools."""

    async def call(self, name: str, /, **arguments: Any) -> CallToolResult:
        """Call a tool."""
        with anyio.fail_after(PATIENCE):
            return await self.client.call_tool(
                name, arguments, progress_callback=self._note_progress
            )

    async def error(self, name: str, /, **arguments: Any) -> str:
        """Call a tool that does not work, and return its text."""
        result = await self.call(name, **arguments)
        assert result.is_error
        return text_of(result)

    async def data(self, name: str, /, **arguments: Any) -> Any:
        """Call a tool that works, and return its data."""
        result = await self.call(name, **arguments)
        assert not result.is_error, text_of(result)
        return result.structured_content

    async def tools(self) -> list[str]:
        """Return the names of the tools."""
        return [tool.name for tool in (await self.client.list_tools(cache_mode="bypass")).tools]

    async def _note_progress(
        self, progress: float, total: float | None, message: str | None
    ) -> None:
        self.progress.append((progress, message))
        self.totals.append(total)


def text_of(result: CallToolResult) -> str:
    """Return the text of an answer."""
    (content,) = result.content
    assert isinstance(content, TextContent)
    return content.text


@asynccontextmanager
async def talk(bridge: McpBridge, mode: Mode, answer: Answer = None) -> AsyncGenerator[Talk, None]:
    """Connect a client; with `answer`, it can ask its user, who answers so, or by it."""
    made = Talk()
    made.bridge = bridge

    async def ask(context: Any, params: Any) -> ElicitResult:
        assert isinstance(params, ElicitRequestFormParams)
        made.asked.append(params.message)
        assert isinstance(answer, str)
        return ElicitResult(action=answer, content={} if answer == "accept" else None)

    async def note(message: Any) -> None:
        if type(message).__name__ == "ToolListChangedNotification":
            made.told.set()

    callback: Any = ask if isinstance(answer, str) else answer
    made.client = Client(
        bridge.server,
        mode=mode,
        elicitation_callback=callback,
        message_handler=note,
    )
    async with made.client:
        yield made


@asynccontextmanager
async def robot_and_talk(
    mode: Mode,
    policy: AgentPolicy | None = None,
    answer: Answer = None,
) -> AsyncGenerator[tuple[Robot, Talk], None]:
    """A robot that is served, a bridge to it, and a client of that."""
    robot = Robot()
    async with (
        serve((robot.drive, robot.count), robot.here),
        McpBridge(robot.here, policy) as bridge,
        talk(bridge, mode, answer) as made,
    ):
        yield robot, made


async def sent_by_others(robot: Robot, meters: int) -> ClientGoal[Driven, Arrived]:
    """Send a goal that is not one of the bridge."""
    return await ActionClient(robot.drive, DRIVE).send_goal(Drive(meters))


class Rounds:
    """Calls of tools, round by round."""

    def __init__(self, made: Talk) -> None:
        self._session = made.client.session

    async def ask(self, meters: int = 3) -> str:
        """Make a first call, and return the state for the second."""
        result = await self.call(meters)
        assert isinstance(result, InputRequiredResult)
        assert result.request_state
        assert set(result.input_requests or ()) == {"consent"}
        return result.request_state

    async def call(self, meters: int = 3, **settings: Any) -> CallToolResult | InputRequiredResult:
        """Make one call."""
        result = await self._session.call_tool(
            "arm-drive", {"meters": meters}, allow_input_required=True, **settings
        )
        return cast("CallToolResult | InputRequiredResult", result)


YES = {"consent": ElicitResult(action="accept", content={})}
