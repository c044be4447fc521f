"""rosbridge servers for tests: one that says what a test wants, and one that behaves as the real
ones do.

`RosbridgeServer` is made after the sources of rosbridge_suite: the capabilities `send_action_goal`
and `call_service`, the class `SendGoal`, and `fragmentation`.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import aclosing, asynccontextmanager, suppress
from typing import Any, TypeAlias

import anyio
from anyio.abc import SocketAttribute, SocketStream, TaskGroup
from wsproto import ConnectionType, WSConnection
from wsproto.events import (
    AcceptConnection,
    BytesMessage,
    CloseConnection,
    Event,
    Ping,
    Request,
    TextMessage,
)
from wsproto.utilities import LocalProtocolError

from fibaction._runtime.notify import Notifier
from tests.support.processes import PATIENCE
from tests.transports.proxy import BROKEN

BROKEN_OR_ENDED: tuple[type[Exception], ...] = (*BROKEN, anyio.EndOfStream)
REJECTED = "Action goal was rejected"
NO_SERVER = "No action server available"
FIBONACCI = "arduinobot_msgs/action/Fibonacci"
SHOW = "camera_msgs/action/Show"
NO_ANSWER = object()
"""The values of a service that does not answer."""


class Peer:
    """One client of a server of tests."""

    def __init__(self, stream: SocketStream) -> None:
        self.stream = stream
        self.request: Request
        self.texts: list[Any] = []
        """The messages of the client, read as JSON."""
        self.pings = 0
        self.answers_pings = True
        self.closed: int | None = None
        """The code of the close of the client."""
        self._socket = WSConnection(ConnectionType.SERVER)
        self._pieces: list[str] = []
        self.news = Notifier()

    async def read(self) -> AsyncGenerator[Any, None]:
        """Yield each message of the client."""
        while True:
            try:
                data = await self.stream.receive()
            except BROKEN_OR_ENDED:
                break
            self._socket.receive_data(data)
            for event in self._socket.events():
                if isinstance(event, Request):
                    self.request = event
                    await self.send(AcceptConnection())
                elif isinstance(event, TextMessage):
                    self._pieces.append(event.data)
                    if event.message_finished:
                        self.texts.append(json.loads("".join(self._pieces)))
                        self._pieces.clear()
                        yield self.texts[-1]
                elif isinstance(event, Ping):
                    self.pings += 1
                    if self.answers_pings:
                        await self.send(event.response())
                elif isinstance(event, CloseConnection):
                    self.closed = int(event.code)
                    with suppress(LocalProtocolError, *BROKEN):  # it may be the reply to ours
                        await self.send(event.response())
                self.news.notify()
        self.news.notify()

    async def say(self, message: Any = None, **members: Any) -> None:
        """Send a message; text and bytes as they are."""
        if isinstance(message, bytes):
            await self.send(BytesMessage(data=message))
        elif isinstance(message, str):
            await self.send(TextMessage(data=message))
        else:
            await self.send(TextMessage(data=json.dumps(message or members)))

    async def send(self, event: Event) -> None:
        await self.stream.send(self._socket.send(event))

    async def send_half(self, text: str) -> None:
        """Send the first half of a message of WebSocket, as bytes."""
        data = self._socket.send(TextMessage(data=text))
        await self.stream.send(data[: len(data) // 2])

    async def hear(self, op: str, number: int = 1) -> Any:
        """Wait for a message of the client with that operation; the first one, or a later one."""
        with anyio.fail_after(PATIENCE):
            while len(found := [one for one in self.texts if one["op"] == op]) < number:
                await self.news.wait()
        return found[number - 1]

    async def pinged(self, number: int) -> None:
        """Wait until the client has sent so many pings."""
        with anyio.fail_after(PATIENCE):
            while self.pings < number:
                await self.news.wait()


OnText: TypeAlias = Callable[[Peer, Any], Awaitable[None]]


class SilentServer:
    """A server that accepts WebSockets, and says what a test lets it say."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.peers: list[Peer] = []
        self.news = Notifier()

    async def peer(self, number: int = 1) -> Peer:
        """Wait for a client: the first one, or a later one."""
        with anyio.fail_after(PATIENCE):
            while len(self.peers) < number:
                await self.news.wait()
        return self.peers[number - 1]

    async def accept(self, stream: SocketStream) -> None:
        async with stream:
            peer = Peer(stream)
            self.peers.append(peer)
            self.news.notify()
            async with aclosing(peer.read()) as messages:
                async for message in messages:
                    await self.handle(peer, message)

    async def handle(self, peer: Peer, message: Any) -> None:
        """Answer a message of a client."""


def typedef(name: str, *fields: tuple[str, str, int, str]) -> dict[str, Any]:
    """A definition of rosapi, as rosbridge_suite makes it from the classes of ROS."""
    names, kinds, lengths, examples = map(list, zip(*fields, strict=True)) if fields else [[]] * 4
    return {
        "type": name,
        "fieldnames": names,
        "fieldtypes": kinds,
        "fieldarraylen": lengths,
        "examples": examples,
        "constnames": ["SLOT_TYPES", *names],
        "constvalues": ["(<rosidl_parser.definition.BasicType object at 0x7f>,)", *examples],
    }


POSE = [
    typedef("geometry_msgs/Point", *[(one, "double", -1, "0.0") for one in "xyz"]),
    typedef(
        "geometry_msgs/Quaternion",
        *[(one, "double", -1, "1.0" if one == "w" else "0.0") for one in "xyzw"],
    ),
]
DETAILS = {
    ("/rosapi/action_goal_details", FIBONACCI): [
        typedef("arduinobot_msgs/Fibonacci_Goal", ("order", "int32", -1, "0"))
    ],
    ("/rosapi/action_feedback_details", FIBONACCI): [
        typedef("arduinobot_msgs/Fibonacci_Feedback", ("partial_sequence", "int32", 0, "[]"))
    ],
    ("/rosapi/action_result_details", FIBONACCI): [
        typedef("arduinobot_msgs/Fibonacci_Result", ("sequence", "int32", 0, "[]"))
    ],
    ("/rosapi/action_goal_details", SHOW): [
        typedef(
            "camera_msgs/Show_Goal",
            ("pixels", "uint8", 0, "[]"),
            ("mask", "octet", 0, "[]"),
            ("few", "arra/array", 0, "[]"),
            ("at", "geometry_msgs/Point", -1, "{}"),
            ("turned", "geometry_msgs/Quaternion", -1, "{}"),
        ),
        *POSE,
    ],
    ("/rosapi/action_feedback_details", SHOW): [typedef("camera_msgs/Show_Feedback")],
    ("/rosapi/action_result_details", SHOW): [
        typedef("camera_msgs/Show_Result", ("pixels", "uint8", 0, "[]"), ("few", "uint8", 0, "[]"))
    ],
}
"""What rosapi tells of the types of the actions. The bound of `few` is not told: old ones have
`arra/array` for it, and new ones `uint8`."""


class RosbridgeServer(SilentServer):
    """A rosbridge_server with the actions `/fibonacci` and `/show`, and with rosapi.

    The goals of `/fibonacci` end as their order says: a negative one is rejected, one of 50 or more
    goes on until it is canceled, and 6 is aborted. Those of `/show` come back as their results.
    """

    tasks: TaskGroup
    max_message_size = 1_000_000
    """Characters of a message, above which it goes in fragments."""
    tells_rejections = True
    """False for servers before 2026, whose clients wait for ever."""
    tells_status = True
    """False for servers before 2.0, whose results have no status."""
    logs_to_client = False
    """True for servers that tell errors as a `status`, as that of ROS 1 did."""
    has_rosapi = True
    describes_types = True
    """False for servers before 2025, whose rosapi tells no details of actions."""
    answers: Mapping[str, Any] = {}
    """Other values for services, by their names; a text for a call that fails."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.handlers: dict[str, anyio.Event] = {}

    async def handle(self, peer: Peer, message: Any) -> None:
        operations: dict[str, OnText] = {
            "send_action_goal": self._start,
            "cancel_action_goal": self._cancel,
            "call_service": self._call,
        }
        assert message["op"] in operations
        await operations[message["op"]](peer, message)

    async def _start(self, peer: Peer, message: Any) -> None:
        self.tasks.start_soon(self._send_goal, peer, message)

    async def _send_goal(self, peer: Peer, message: Any) -> None:
        if not message["action_type"]:
            if not self.logs_to_client:
                return await self._fail(peer, message, "The type string is empty")
            text = "send_action_goal: The type string is empty"
            await self.send(peer, {"op": "status", "level": "error", "msg": text}, message)
            return None
        if message["action"] == "/show":
            return await self._show(peer, message)
        if message["action"] != "/fibonacci" or message["action_type"] != FIBONACCI:
            return await self._fail(peer, message, NO_SERVER)
        wrong = set(message["args"]) - {"order"}
        if wrong:
            text = f"Message type {FIBONACCI} does not have a field {min(wrong)}"
            return await self._fail(peer, message, text)
        order = message["args"]["order"]
        if order < 0:
            if self.tells_rejections:
                await self._fail(peer, message, REJECTED)
            return None
        if message.get("feedback", False):
            values = {"partial_sequence": [0, order]}
            await self.send(peer, {"op": "action_feedback", "values": values}, message)
        status, values = 4, {"sequence": [order]}
        if order == 6:
            status, values = 6, {"sequence": []}
        if order >= 50:
            canceled = self.handlers[message["id"]] = anyio.Event()
            await canceled.wait()
            status = 5
        answer = {"op": "action_result", "values": values, "result": True}
        if self.tells_status:
            answer["status"] = status
        return await self.send(peer, answer, message)

    async def _show(self, peer: Peer, message: Any) -> None:
        args = message["args"]
        pixels, mask, few = (args.get(name, []) for name in ("pixels", "mask", "few"))
        if not (isinstance(mask, list) and isinstance(few, list)):
            text = "camera_msgs/Show_Goal message requires a sequence<octet> for field mask"
            return await self._fail(peer, message, text)
        data = base64.b64decode(pixels) if isinstance(pixels, str) else bytes(pixels)
        values = {"pixels": base64.b64encode(data).decode(), "few": few}
        answer = {"op": "action_result", "values": values, "status": 4, "result": True}
        return await self.send(peer, answer, message)

    async def _cancel(self, peer: Peer, message: Any) -> None:
        if message["id"] in self.handlers:
            self.handlers[message["id"]].set()

    async def _fail(self, peer: Peer, message: Any, text: str) -> None:
        answer = {"op": "action_result", "values": text, "status": 0, "result": False}
        await self.send(peer, answer, message)

    async def _call(self, peer: Peer, message: Any) -> None:
        service, args = message["service"], message["args"]
        names = {"/fibonacci": FIBONACCI, "/show": SHOW}
        values: Any = {
            "/rosapi/action_servers": {"action_servers": ["/fibonacci", "/arm/pick", "/show"]},
            "/rosapi/action_type": {"type": names.get(args.get("action"), "")},
            "/fibonacci/_action/cancel_goal": {
                "return_code": 0,
                "goals_canceling": [
                    {"goal_id": {"uuid": [7] * 16}, "stamp": {"sec": 5, "nanosec": 6}}
                ],
            },
        }.get(service)
        if self.describes_types and service == "/rosapi/interfaces":
            values = {"interfaces": ["geometry_msgs/msg/Point", *names.values()]}
        elif self.describes_types and service.endswith("_details"):
            values = {"typedefs": DETAILS[service, args["type"]]}  # of others rosapi may end
        is_there = values is not None and (self.has_rosapi or "rosapi" not in service)
        if not is_there:
            values = f"Service {service} does not exist"
        if service in self.answers:
            values = self.answers[service]
            is_there = not isinstance(values, str)
        if values is NO_ANSWER:
            return
        await self.send(
            peer, {"op": "service_response", "values": values, "result": is_there}, message
        )

    async def send(self, peer: Peer, answer: dict[str, Any], to: Any) -> None:
        """Send an answer, with the ID and the name of what it answers to."""
        names = {name: to[name] for name in ("id", "action", "service") if name in to}
        text = json.dumps(answer | names)
        size = self.max_message_size
        with suppress(*BROKEN):
            if len(text) <= size:
                await peer.say(text)
                return
            total = (len(text) - 1) / size + 1  # not a whole number, as the real ones have it
            for num in range(math.floor(total)):
                data = text[num * size : (num + 1) * size]
                await peer.say(op="fragment", id=to["id"], data=data, num=num, total=total)


@asynccontextmanager
async def serving(
    kind: type[SilentServer] = RosbridgeServer, accept: Any = None, **settings: Any
) -> AsyncGenerator[Any, None]:
    """Run a server; `settings` are attributes of it, and `accept` serves streams in its place."""
    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        port = listener.extra(SocketAttribute.local_port)
        server = kind(f"rosbridge://127.0.0.1:{port}")
        for name, value in settings.items():
            setattr(server, name, value)
        async with anyio.create_task_group() as tasks:
            if isinstance(server, RosbridgeServer):
                server.tasks = tasks
            tasks.start_soon(listener.serve, accept or server.accept)
            with anyio.fail_after(30):
                yield server
            tasks.cancel_scope.cancel()
