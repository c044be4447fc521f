"""Two ends of a connection in memory: both real, or one real and one in the hands of a test."""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any, Literal

import anyio
import msgspec

from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Connection, Endpoint, ForwardingEndpoint
from fibaction.server import ActionServer, Schedule
from fibaction.testing import ScriptedServer
from fibaction.wire.channel import Channel
from fibaction.wire.client.connection import open_connection
from fibaction.wire.frames import MAX_FRAME
from fibaction.wire.messages import (
    VERSION,
    Actions,
    Follow,
    Following,
    Goodbye,
    Hello,
    ListActions,
    Received,
    SendGoal,
    StatusChanged,
    Watching,
    WatchStatus,
    Welcome,
    decode_from_client,
    decode_from_server,
)
from fibaction.wire.settings import ClientSettings, Limits, WireSettings
from fibaction.wire.wire_server import WireServer, open_server
from fibaction.words.errors import ServerNotFound, TransportError
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus
from tests.support import fibonacci as fib
from tests.support.fibonacci import FIBONACCI
from tests.wire import memory
from tests.wire.memory import LONG, Peer, Running

A, B, C = (bytes([number] * 16) for number in (1, 2, 3))
GOAL_ID = GoalID(A)
ANY = 2**31 - 1
"""More credit than any goal of a test uses up."""
ANN, BOB = b"ann".ljust(16), b"bob".ljust(16)
GOAL = FIBONACCI.goal.encode(fib.Goal(3))
RESULT = FIBONACCI.result.encode(fib.Result([]))
EXECUTING = GoalStatus.EXECUTING
SUCCEEDED = GoalStatus.SUCCEEDED
WHERE = "memory://robot"
WINDOW = 4
PATIENT = ClientSettings(heartbeat=LONG, window=WINDOW, reconnect_timeout=30)
ONCE = ClientSettings(heartbeat=LONG, window=WINDOW, reconnect=False)
AWAY = ServerNotFound("the server is away")

Server = ActionServer[fib.Goal, fib.Feedback, fib.Result]


def feedback(*numbers: int) -> list[fib.Feedback]:
    return [fib.Feedback([number]) for number in numbers]


def scripted(*steps: Any) -> ScriptedServer[fib.Goal, fib.Feedback, fib.Result]:
    """A server whose goals all go like that."""
    return ScriptedServer(FIBONACCI, steps)


def held() -> ScriptedServer[fib.Goal, fib.Feedback, fib.Result]:
    """A server whose goals never end by themselves."""
    return scripted(anyio.Event())


def one_by_one() -> Server:
    """A server that runs one goal, which never ends by itself, and lets others wait."""
    return running(anyio.Event(), schedule=Schedule(concurrency=1, queue=10))


def running(*steps: Any, **settings: Any) -> Server:
    """A server whose goals all go like that, with settings."""

    async def executor(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        for step in steps:
            if isinstance(step, anyio.Event):
                await step.wait()
            else:
                yield step

    return ActionServer(FIBONACCI, executor, **settings)


def talking() -> Server:
    """A server whose goals give more feedback than their client takes, and succeed."""
    return running(*feedback(*range(100)), fib.Result([]))


def send(request: int, goal_id: bytes = A, credit: int | None = ANY) -> SendGoal:
    return SendGoal(request, "fibonacci", goal_id, GOAL, credit)


def follow(
    after: int | None,
    *,
    own: bool = True,
    request: int = 1,
    credit: int | None = ANY,
    attempt: int = 1,
) -> Follow:
    return Follow(request, "fibonacci", A, after, own, credit, attempt)


def kinds(messages: list[Any]) -> list[type]:
    return [type(message) for message in messages]


# A real server, and clients whose messages a test makes


class Client(Peer):
    """A client in the hands of a test."""

    def __init__(self, channel: memory.MemoryChannel) -> None:
        super().__init__(channel, decode_from_server)

    async def ask(self, message: Any, kind: type[memory.T]) -> memory.T:
        await self.say(message)
        return await self.hear(kind)

    async def ask_all(self, *messages: Any) -> list[Any]:
        """All that is told until nothing moves any more, but for statuses."""
        await self.say(*messages)
        heard = await self.hear_all()
        return [message for message in heard if not isinstance(message, StatusChanged)]

    async def send(self, request: int, goal_id: bytes = A, credit: int | None = ANY) -> Following:
        """Send a goal, and hear that it is accepted and executing."""
        following = await self.ask(send(request, goal_id, credit), Following)
        if credit is not None:
            assert await self.hear(StatusChanged) == StatusChanged(request, EXECUTING)
        return following

    async def hear_by_id(self) -> dict[int, list[Any]]:
        """As `hear_all`; the order between requests does not matter."""
        heard: dict[int, list[Any]] = {}
        for message in await self.hear_all():
            heard.setdefault(message.id, []).append(message)
        return heard

    async def is_served(self) -> bool:
        """Return whether its session goes on, and has nothing else to tell."""
        return (await self.ask(ListActions(99), Actions)).id == 99


class Served:
    """A real server's half, and its clients."""

    def __init__(self, wire: WireServer, endpoints: dict[str, Endpoint], frame: int) -> None:
        self.wire = wire
        self.endpoints = endpoints
        self._frame = frame

    def serve(self, channel: Channel) -> None:
        self.wire.start(channel)

    def connect(self, name: str = "the client") -> Client:
        """A client that has said nothing yet."""
        end, other = memory.pair(name)
        self.serve(end)
        return Client(other)

    async def greet(
        self,
        session: bytes = ANN,
        token: str = "",
        max_frame: int = MAX_FRAME,
        *,
        name: str = "the client",
        heartbeat: float = LONG,
        batches: bool = False,
    ) -> Client:
        """A client that was let in."""
        client = self.connect(name)
        hello = Hello(VERSION, heartbeat, token, session, max_frame, batches)
        assert (await client.ask(hello, Welcome)).max_frame == self._frame
        return client


@asynccontextmanager
async def serving(
    *servers: ActionServer[Any, Any, Any] | ForwardingEndpoint,
    access: WireSettings | None = None,
    limits: Limits | None = None,
    heartbeat: float = LONG,
    grace: float = 10.0,
    then: Literal["keep", "cancel"] = "keep",
) -> AsyncGenerator[Served, None]:
    """A real server's half, in front of servers that run in the block."""
    limits = limits or Limits(heartbeat=LONG)
    async with AsyncExitStack() as stack:
        for server in servers:
            await stack.enter_async_context(server)
        endpoints: dict[str, Endpoint] = {server.info.name: server for server in servers}
        terms = msgspec.structs.replace(
            access or WireSettings(), heartbeat=heartbeat, limits=limits, orphans=then, grace=grace
        )
        wire = await stack.enter_async_context(open_server(endpoints, terms))
        yield Served(wire, endpoints, limits.frame)


# A real client, and a server whose messages a test makes


class Network:
    """Where connections are opened, one after the other."""

    def __init__(self) -> None:
        self.refusal: TransportError | None = None
        self.hangs = False
        self.closes = True
        """True if servers close a connection when the client has said goodbye, as real ones do."""
        self.dialed = 0
        self._waiting: deque[Peer] = deque()
        self._more = Notifier()

    async def dial(self) -> memory.MemoryChannel:
        self.dialed += 1
        await anyio.lowlevel.checkpoint()
        if self.hangs:
            await anyio.sleep_forever()
        if self.refusal is not None:
            raise self.refusal
        end, other = memory.pair(other=WHERE)
        if self.closes:
            end.close_after(lambda frame: isinstance(decode_from_client(frame), Goodbye))
        self._waiting.append(Peer(end, decode_from_client))
        self._more.notify()
        return other

    async def reached(self) -> tuple[Peer, Hello]:
        """Take the next connection, and the first message on it."""
        with anyio.fail_after(60):
            while not self._waiting:
                await self._more.wait()
        server = self._waiting.popleft()
        return server, await server.hear(Hello)

    async def answer(self, *messages: Any) -> Peer:
        """Take the next connection, and answer the client's Hello with that."""
        server, _ = await self.reached()
        await server.say(*messages)
        return server

    async def accept(self, heartbeat: float = LONG, max_frame: int = MAX_FRAME) -> Peer:
        """Take the next connection in."""
        return await self.answer(Welcome(VERSION, heartbeat, max_frame))


@asynccontextmanager
async def reached(
    network: Network | None = None,
    settings: ClientSettings = PATIENT,
    heartbeat: float = LONG,
    max_frame: int = MAX_FRAME,
) -> AsyncGenerator[tuple[Connection, Peer], None]:
    """A real client's connection, and the server that a test speaks for."""
    network = network or Network()
    async with Running(lambda: network.accept(heartbeat, max_frame)) as accepting:
        async with open_connection(network.dial, WHERE, settings) as connection:
            yield connection, await accepting.answer()


def endpoint_of(connection: Connection) -> Endpoint:
    return connection.endpoint(FIBONACCI)


async def asked_again(network: Network, server: Peer, kind: type[memory.T]) -> tuple[Peer, Any]:
    """Cut the line, and take what the client asks for on the next."""
    server.channel.cut()
    server = await network.accept()
    return server, await server.hear(kind)


CALLS: dict[str, Callable[[Connection], Awaitable[Any]]] = {
    "actions": lambda connection: connection.actions(),
    "send_goal": lambda connection: endpoint_of(connection).send_goal(GOAL_ID, b"goal"),
    "feedback": lambda connection: endpoint_of(connection).feedback(GOAL_ID),
    "get_result": lambda connection: endpoint_of(connection).get_result(GOAL_ID),
    "cancel_goals": lambda connection: endpoint_of(connection).cancel_goals(),
    "status": lambda connection: endpoint_of(connection).status(),
}
"""All that a client can ask for, and that does not wait for a server."""


def following(message: SendGoal | Follow, **changes: Any) -> Following:
    """The answer to a goal that was sent or is followed."""
    values: dict[str, Any] = {"stamp": 7, "status": 2, "latest": False, "place": 0, **changes}
    return Following(message.id, **values)


@asynccontextmanager
async def goal_of(
    connection: Connection, server: Peer, *, feedback: bool = True, **changes: Any
) -> AsyncGenerator[tuple[Any, int], None]:
    """A goal that was accepted, and its ID on the connection."""
    endpoint = endpoint_of(connection)
    async with Running(lambda: endpoint.send_goal(GOAL_ID, b"goal", feedback=feedback)) as sending:
        sent = await server.hear(SendGoal)
        await server.say(following(sent, **changes))
        yield await sending.answer(), sent.id


async def observed(connection: Connection, server: Peer, **changes: Any) -> tuple[Any, int]:
    """The goal of another client, which is followed."""
    async with Running(lambda: endpoint_of(connection).feedback(GOAL_ID)) as asking:
        asked = await server.hear(Follow)
        await server.say(following(asked, **changes))
        return await asking.answer(), asked.id


async def watched(connection: Connection, server: Peer, known: int = 0) -> tuple[Any, int]:
    """The statuses of the goals."""
    async with Running(endpoint_of(connection).status) as asking:
        asked = await server.hear(WatchStatus)
        await server.say(Watching(asked.id, known))
        return await asking.answer(), asked.id


async def is_used(connection: Connection, server: Peer) -> None:
    """A call goes to the server, and its answer comes back."""
    async with Running(connection.actions) as asking:
        await server.say(Actions((await server.hear(ListActions)).id, []))
        assert await asking.answer() == []


async def numbers_of(goal: Any, count: int | None = None) -> list[int]:
    """The numbers of the next feedback, which is there, or of all of it to the end."""
    numbers: list[int] = []
    with anyio.fail_after(30):
        while count is None or len(numbers) < count:
            if (item := await goal.receive()) is None:
                break
            numbers.append(item.number)
    return numbers


async def update_of(goal: Any) -> Any:
    """What happens next to a goal."""
    with anyio.fail_after(30):
        return await anext(aiter(goal))


async def outcome_of(goal: Any) -> Any:
    with anyio.fail_after(30):
        return await goal.outcome()


# Both real


class Lines:
    """All connections to one server; a test may spoil them."""

    def __init__(self) -> None:
        self.ends: list[memory.MemoryChannel] = []

    @property
    def end(self) -> memory.MemoryChannel:
        """The server's end of the newest connection."""
        return self.ends[-1]


@asynccontextmanager
async def real(
    *steps: Any,
    server: ActionServer[Any, Any, Any] | None = None,
    lines: Lines | None = None,
    settings: ClientSettings = PATIENT,
    limits: Limits | None = None,
) -> AsyncGenerator[Endpoint, None]:
    """A server of such goals, over the wire."""
    lines = lines or Lines()
    async with serving(server or scripted(*steps), limits=limits) as served:

        async def dial() -> memory.MemoryChannel:
            end, other = memory.pair(other=WHERE)
            lines.ends.append(end)
            served.serve(end)
            await anyio.lowlevel.checkpoint()
            return other

        async with open_connection(dial, WHERE, settings) as connection:
            yield endpoint_of(connection)


def received(messages: list[Any]) -> list[int]:
    """The goals whose ends the client says to have heard of."""
    return [message.id for message in messages if isinstance(message, Received)]
