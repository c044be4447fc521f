"""A session between a real server and a client whose messages are made by hand."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any, Literal

import anyio
from anyio.abc import TaskGroup

from fibaction._tasks import Background
from fibaction.abc import Endpoint
from fibaction.exceptions import ActionError
from fibaction.server import ActionServer
from fibaction.states import GoalStatus
from fibaction.testing import ScriptedServer
from fibaction.wire.auth import AccessPolicy
from fibaction.wire.framing import MAX_FRAME
from fibaction.wire.link import Link
from fibaction.wire.messages import (
    VERSION,
    Actions,
    Following,
    Hello,
    ListActions,
    SendGoal,
    StatusChanged,
    Welcome,
    decode_from_server,
)
from fibaction.wire.ownership import Owners
from fibaction.wire.session import Session
from fibaction.wire.settings import Limits, ServerSettings
from tests import fibonacci as fib
from tests.fibonacci import FIBONACCI
from tests.wire import memory
from tests.wire.memory import LONG

A, B = bytes([1] * 16), bytes([2] * 16)
ANY = 2**31 - 1
"""More credit than any goal here uses up."""
ANN, BOB = b"ann", b"bob"
GOAL = FIBONACCI.goal.encode(fib.Goal(3))
EXECUTING = GoalStatus.EXECUTING


def feedback(*numbers: int) -> list[fib.Feedback]:
    return [fib.Feedback([number]) for number in numbers]


def scripted(*steps: Any) -> ScriptedServer[fib.Goal, fib.Feedback, fib.Result]:
    """A server whose goals all go like that."""
    return ScriptedServer(FIBONACCI, steps)


def held() -> ScriptedServer[fib.Goal, fib.Feedback, fib.Result]:
    """A server whose goals never end by themselves."""
    return scripted(anyio.Event())


class Client(memory.Peer):
    """A client, and the session that serves it."""

    def __init__(self, channel: memory.MemoryChannel, session: Session) -> None:
        super().__init__(channel, decode_from_server)
        self.session = session
        self.error: ActionError | None = None

    async def ask(self, message: Any, kind: type[memory.T]) -> memory.T:
        await self.say(message)
        return await self.hear(kind)

    async def send(self, request: int, goal_id: bytes = A, credit: int | None = ANY) -> Following:
        """Send a goal, and hear that it is accepted and executing."""
        following = await self.ask(SendGoal(request, "fibonacci", goal_id, GOAL, credit), Following)
        if credit is not None:
            assert await self.hear(StatusChanged) == StatusChanged(request, EXECUTING)
        return following

    async def hear_by_id(self) -> dict[int, list[Any]]:
        """As `hear_all`, but the order between requests is nobody's business."""
        heard: dict[int, list[Any]] = {}
        for message in await self.hear_all():
            heard.setdefault(message.id, []).append(message)
        return heard

    async def is_served(self) -> bool:
        """Whether its session goes on."""
        answer = await self.ask(ListActions(99), Actions)
        return answer.id == 99


class Bench:
    """Sessions, and what they share."""

    def __init__(
        self,
        tasks: TaskGroup,
        endpoints: Mapping[str, Endpoint],
        terms: ServerSettings,
        orphans: Owners,
    ) -> None:
        self.endpoints = dict(endpoints)
        self.orphans = orphans
        self.superseded: list[bytes] = []
        self._tasks = tasks
        self._terms = terms

    def clients_of(self, action: str) -> list[str]:
        return [f"who uses {action}"]

    async def connect(self) -> Client:
        """A client that has said nothing yet."""
        end, other = memory.pair()
        link = Link(end, LONG, self._terms.limits.queue)
        session = Session(
            link,
            self.endpoints,
            self._terms,
            self.orphans,
            clients_of=self.clients_of,
            supersede=self.superseded.append,
        )
        client = Client(other, session)

        async def run() -> None:
            client.error = await session.run()
            await end.aclose()

        self._tasks.start_soon(run)
        return client

    async def greet(
        self, session: bytes = ANN, token: str = "", max_frame: int = MAX_FRAME
    ) -> Client:
        """A client that was let in."""
        client = await self.connect()
        hello = Hello(VERSION, LONG, token, session, max_frame)
        welcome = Welcome(VERSION, LONG, self._terms.limits.frame)
        assert await client.ask(hello, Welcome) == welcome
        return client


@asynccontextmanager
async def serving(
    *servers: ActionServer[Any, Any, Any],
    access: AccessPolicy | None = None,
    limits: Limits | None = None,
    grace: float = 10.0,
    then: Literal["keep", "cancel"] = "keep",
) -> AsyncGenerator[Bench, None]:
    async with AsyncExitStack() as stack:
        for server in servers:
            await stack.enter_async_context(server)
        tasks = await stack.enter_async_context(Background())
        endpoints = {server.info.name: server for server in servers}
        orphans = Owners(tasks, grace=grace, then=then)
        terms = ServerSettings(LONG, access or AccessPolicy(), limits or Limits(), then, grace)
        yield Bench(tasks, endpoints, terms, orphans)
