"""A robot for agents, and a client of the SDK that talks to its skills over HTTP."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from typing import Any
from uuid import uuid4

import anyio
import httpx
from a2a.client import A2ACardResolver, Client, ClientConfig, ClientFactory
from a2a.client.client import ClientCallContext
from a2a.types import (
    AgentCard,
    CancelTaskRequest,
    GetTaskRequest,
    Message,
    Part,
    Role,
    SendMessageConfiguration,
    SendMessageRequest,
    StreamResponse,
    SubscribeToTaskRequest,
    Task,
    TaskState,
)
from google.protobuf.json_format import MessageToDict, ParseDict
from google.protobuf.struct_pb2 import Value

from fibaction import (
    Action,
    ActionServer,
    GoalHandle,
    serve,
)
from fibaction_transports.a2a import A2aHttpTransport
from tests.support.processes import PATIENCE
from tests.transports.driving_robot import DrivingRobot

TOKEN = "tW4x9c-tW4x9c"
GOOD = {"Authorization": f"Bearer {TOKEN}"}


SAY = Action("say", goal=str, feedback=int, result=str)


class Robot(DrivingRobot):
    """A robot that drives, and speaks."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = anyio.Semaphore(0)
        """The meters that a drive of 100 m or more may go on."""
        self.listens = anyio.Event()
        """Set when it has been told to say "...", which only a cancel ends."""
        self.say = ActionServer(SAY, self._say)

    async def _meters(self, meters: int) -> AsyncIterator[int]:
        for meter in range(1, meters + 1):
            if meters >= 100:
                await self.steps.acquire()
            yield meter

    async def _say(self, goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
        if goal.request == "...":
            self.listens.set()
            await anyio.sleep_forever()
        yield goal.request.upper()

    def go(self, meters: int) -> None:
        """Let a long drive go on."""
        for _ in range(meters):
            self.steps.release()


def message(goal: Any = None, *, skill: str = "", task: str = "", text: str = "") -> Message:
    """Return the message of an agent with a goal, or with a text."""
    part = Part(text=text) if text else Part(data=ParseDict(goal, Value()))
    made = Message(message_id=str(uuid4()), role=Role.ROLE_USER, parts=[part], task_id=task)
    if skill:
        made.metadata["skill"] = skill
    return made


class Talk:
    """A client of the SDK."""

    def __init__(self, client: Client, url: str, card: AgentCard, http: httpx.AsyncClient) -> None:
        self.client = client
        self.url = url
        self.card = card
        self.http = http

    async def send(
        self, goal: Any = None, /, *, at_once: bool = False, made: Message | None = None, **of: Any
    ) -> Task:
        """Send a message without a stream, and return the task."""
        made = made or message(goal, **of)
        request = SendMessageRequest(
            message=made, configuration=SendMessageConfiguration(return_immediately=at_once)
        )
        config = ClientConfig(streaming=False, httpx_client=self.http)
        with anyio.fail_after(PATIENCE):
            client = ClientFactory(config).create(self.card)
            (response,) = [one async for one in client.send_message(request)]
            return response.task

    def stream(self, goal: Any = None, /, **of: Any) -> AsyncIterator[StreamResponse]:
        """Send a message, and return its updates."""
        return self.client.send_message(SendMessageRequest(message=message(goal, **of)))

    def subscribe(self, task_id: str, after: str | None = None) -> AsyncIterator[StreamResponse]:
        """Return the updates of a task behind a position."""
        context = None
        if after is not None:
            context = ClientCallContext(service_parameters={"Last-Event-ID": after})
        return self.client.subscribe(SubscribeToTaskRequest(id=task_id), context=context)

    async def get(self, task_id: str) -> Task:
        """Return a task as it is now."""
        with anyio.fail_after(PATIENCE):
            return await self.client.get_task(GetTaskRequest(id=task_id))

    async def cancel(self, task_id: str) -> Task:
        """Cancel a task."""
        with anyio.fail_after(PATIENCE):
            return await self.client.cancel_task(CancelTaskRequest(id=task_id))


def told(update: StreamResponse) -> str:
    """Return an update as a short text: its number and data, or its state."""
    if update.HasField("task"):
        return f"task {state_of(update.task)}"
    if update.HasField("artifact_update"):
        return f"result {data_of(update.artifact_update.artifact.parts)}"
    event = update.status_update
    if "number" in event.metadata:
        number = MessageToDict(event.metadata)["number"]
        return f"{number:.0f}: {data_of(event.status.message.parts)}"
    name = TaskState.Name(event.status.state).removeprefix("TASK_STATE_")
    text = "".join(part.text for part in event.status.message.parts)
    return f"{name}: {text}" if text else name


def data_of(parts: Any) -> Any:
    """Return the data of the first part; those after it are the same as text."""
    return MessageToDict(parts[0].data)


def state_of(task: Task) -> str:
    """Return the name of the state of a task."""
    return TaskState.Name(task.status.state).removeprefix("TASK_STATE_")


def text_of(task: Task) -> str:
    """Return the text of the status of a task."""
    return "".join(part.text for part in task.status.message.parts)


@asynccontextmanager
async def talking(url: str, token: str = TOKEN) -> AsyncGenerator[Talk, None]:
    """A client of the SDK for the server at a URL."""
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(headers=headers, trust_env=False, timeout=PATIENCE) as http:
        card = await A2ACardResolver(http, url).get_agent_card()
        client = ClientFactory(ClientConfig(httpx_client=http)).create(card)
        yield Talk(client, url, card, http)


@asynccontextmanager
async def robot_and_talk(**settings: Any) -> AsyncGenerator[tuple[Robot, Talk], None]:
    """A robot that is served, and a client of it; no user is asked, if nothing else is said."""
    robot = Robot()
    settings = {"unasked": ["*"], "token": TOKEN, **settings}
    async with (
        serve((robot.drive, robot.say), A2aHttpTransport(port=0, **settings)) as (url,),
        talking(url) as talk,
    ):
        yield robot, talk
