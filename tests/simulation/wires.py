"""`Wire`: one connection of a hostile client, which checks what the server sends.

What it checks are the rules of docs/protocol.md, and that the client is told nothing that it has no
permission for.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TypeAlias

import anyio

from fibaction import GoalID
from fibaction._runtime.notify import Notifier
from fibaction.wire.auth import Permission
from fibaction.wire.frames import MAX_FRAME, FrameReader, framed
from fibaction.wire.messages import (
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Close,
    Credit,
    Feedback,
    Follow,
    Following,
    FromClient,
    FromServer,
    GoalChanged,
    Goodbye,
    ListActions,
    Ping,
    Places,
    Received,
    SendGoal,
    Watching,
    WatchStatus,
    Welcome,
    decode_from_server,
    encode,
)
from fibaction.words.errors import ProtocolError
from tests.simulation.invariants import Record
from tests.simulation.scenario import HostilePlan
from tests.simulation.streams import SimulatedStream

Request: TypeAlias = (
    SendGoal | Follow | CancelGoals | WatchStatus | AwaitServer | ListActions | AskPeers | AskPlaces
)
GONE = (OSError, anyio.BrokenResourceError, anyio.ClosedResourceError, anyio.EndOfStream)
"""The errors of a connection that has ended."""
SLOW = 0.05
"""Seconds between two reads of a client that reads slowly."""
PIECE = 200
"""Bytes that such a client reads at once."""
SILENCE = 25.0
"""Seconds without a byte after which the server counts as gone: five of its longest heartbeats."""
HEARTBEAT = 0.5
"""Seconds between two heartbeats of a client that stays."""


class Wire:
    """One connection, with the requests that were made on it and their answers."""

    def __init__(self, record: Record, plan: HostilePlan, stream: SimulatedStream) -> None:
        self._record = record
        self._plan = plan
        self._stream = stream
        self._reader = FrameReader(MAX_FRAME)
        self._has_news = Notifier()
        self._scope = anyio.CancelScope()
        self.requests: dict[int, Request] = {}
        self.unanswered: dict[int, Request] = {}
        self._credit: dict[int, int] = {}
        self.is_open = True
        self.is_cut_short = False
        """True if the last message was not sent to its end, so that none can follow."""

    async def run(self, heartbeats: bool) -> None:
        """Read as the plan says, and send heartbeats, until the connection ends."""
        try:
            with self._scope:
                async with anyio.create_task_group() as tasks:
                    if heartbeats:
                        tasks.start_soon(self._beat)
                    with suppress(*GONE):
                        await self._read()
                    tasks.cancel_scope.cancel()
        finally:
            self._end()

    async def _read(self) -> None:
        if self._plan.reads == "never":
            await anyio.sleep_forever()
        slowly = self._plan.reads == "slowly"
        while True:
            data = b""
            with anyio.move_on_after(SILENCE):
                data = await self._stream.receive(PIECE if slowly else 2**16)
            if not data:  # the server's process has died without a word
                return
            for frame in self._reader.feed(data):
                try:
                    self._take(decode_from_server(frame))
                except ProtocolError as error:
                    self._fail(str(error))
            self._has_news.notify()
            if slowly:
                await anyio.sleep(SLOW)

    async def _beat(self) -> None:
        while True:
            await anyio.sleep(HEARTBEAT)
            if not self.is_cut_short:
                with suppress(*GONE):
                    await self.send(Ping())

    def _end(self) -> None:
        self.is_open = False
        self._stream.close_now()
        self._has_news.notify()

    async def settled(self) -> None:
        """Wait until all requests are answered, or the connection has ended."""
        while self.is_open and self.unanswered and not self.is_cut_short:
            await self._has_news.wait()

    async def send(self, message: FromClient) -> None:
        """Send a message.

        Raises:
            OSError, BrokenResourceError, ClosedResourceError: The connection has ended.
        """
        if isinstance(message, Request):
            self.requests[message.id] = self.unanswered[message.id] = message
            self._credit[message.id] = getattr(message, "credit", 0) or 0
        elif isinstance(message, Credit):
            self._credit[message.id] = self._credit.get(message.id, 0) + message.count
        elif isinstance(message, Received) or (
            isinstance(message, Close) and isinstance(self.requests.get(message.id), AwaitServer)
        ):
            self.unanswered.pop(message.id, None)  # it asks for no answer any more
        await self.send_bytes(framed([encode(message)]))

    async def send_bytes(self, data: bytes) -> None:
        """Send bytes.

        Raises:
            OSError, BrokenResourceError, ClosedResourceError: The connection has ended.
        """
        if self.is_open:
            try:
                await self._stream.send(data)
            except GONE:
                self.is_open = False
                raise

    async def leave(self, manner: str) -> None:
        """End the connection: with a goodbye, or by closing it, or without a word."""
        if self.is_open and manner == "goodbye" and not self.is_cut_short:
            with anyio.move_on_after(1), suppress(*GONE):
                await self.send(Goodbye("on purpose"))
        self._scope.cancel()
        await anyio.lowlevel.checkpoint()

    # What the server sends

    def _fail(self, text: str) -> None:
        self._record.fail("hostile", f"{self._plan.name}: {text}")

    def _take(self, message: FromServer) -> None:
        if isinstance(message, Ping | Goodbye):
            return
        server = self._record.scenario.server
        if server.asks_for_tokens and not self._plan.has_token:
            self._leak(f"got {message} without a token")
        if isinstance(message, Welcome):
            return
        request = self.requests.get(message.id)
        if request is None:
            self._fail(f"got {message}, and has not asked")
            return
        self.unanswered.pop(message.id, None)
        self._check_credit(message)
        self._check_permission(request, message)

    def _check_credit(self, message: FromServer) -> None:
        if isinstance(message, Feedback | GoalChanged):
            self._credit[message.id] -= 1
            if self._credit[message.id] < 0:
                self._fail(f"got {type(message).__name__} without credit")

    def _leak(self, text: str) -> None:
        self._record.fail("access", f"{self._plan.name} {text}")

    def _check_permission(self, request: Request, message: FromServer) -> None:
        may = self._plan.may
        if isinstance(message, Watching) and Permission.OBSERVE not in may:
            self._leak("follows the statuses, and may not observe")
        elif isinstance(message, Places) and Permission.OBSERVE not in may:
            self._leak("was told the places of goals, and may not observe")
        elif isinstance(message, CancelAnswered) and Permission.CANCEL not in may:
            self._leak("was answered a cancel, and may not cancel")
        elif isinstance(message, Following) and isinstance(request, SendGoal | Follow):
            if isinstance(request, SendGoal) and Permission.SEND not in may:
                self._leak("has sent a goal, and may not send")
            self._check_follower(GoalID(request.goal_id), message.stamp)

    def _check_follower(self, goal_id: GoalID, stamp: int) -> None:
        truth = self._record.truth(goal_id, stamp)
        if truth is None or self._plan.name in truth.sender:
            return
        if Permission.OBSERVE not in self._plan.may:
            self._leak(f"follows a goal of {truth.sender}, and may not observe")
