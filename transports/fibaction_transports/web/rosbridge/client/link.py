"""`ServerLink`: one connection to a rosbridge server, with the goals and calls that wait there.

Theory of operation
-------------------

The link belongs to one WebSocket, and ends with it. Whatever waits then ends with an error: a
rosbridge server forgets which client has sent a goal, so another connection could not continue.

Requests are written in their order. `send` returns when its message has been written, so a slow
server makes its callers wait, and nothing piles up here. What arrives is handled at once: feedback
goes into the log of its goal, which keeps a limited number of messages.

The server is asked for a pong twice in each heartbeat, and is dead after four heartbeats without a
byte.

*What is wrong.* Text that is not JSON, or a message that is too large, ends the connection, with
the code of WebSocket that says so.
Everything else concerns one goal or call, if it says which; otherwise it is ignored, and logged
once.
"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from itertools import count
from typing import Any

import anyio
import msgspec
from anyio import CancelScope, create_task_group

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import REASON, clean_logger, excerpt
from fibaction.wire.channel import LEAVE, Line
from fibaction.wire.link import PING, Heartbeat
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    ProtocolError,
    ServerNotFound,
    TransportError,
    copy_of,
)
from fibaction_transports.web.rosbridge.client.goal import OutgoingGoal
from fibaction_transports.web.rosbridge.operations import (
    ActionFeedback,
    ActionResult,
    ClientID,
    Fragment,
    Ignored,
    ServerOperation,
    ServiceResponse,
    StatusMessage,
    Wrong,
    read_from_server,
)
from fibaction_transports.web.rosbridge.text_messages import INVALID, OPENED, partial_messages

MOST_NOTES = 20
"""Different lines about the server that one connection writes into the log."""

logger = clean_logger("fibaction.web")


class CallFailed(TransportError):
    """An error for a call of a service that the server has answered with an error."""


class NoAnswer(ServerNotFound):
    """An error for a call of a service without an answer in time."""


class _ServiceCall:
    """A call of a service that waits for its answer."""

    def __init__(self) -> None:
        self.values: Any = None
        self.error: ActionError | None = None
        self.is_answered = anyio.Event()


class ServerLink:
    """One connection to a rosbridge server."""

    def __init__(self, line: Line, heartbeat: float, limit: int, fate: str) -> None:
        """Take a line that is connected.

        Args:
            line: The line; its messages are frames of a `RosbridgeClientFraming`.
            heartbeat: The seconds between signs of life of the server.
            limit: The bytes of the largest message of the server.
            fate: The sentence about goals whose connection is lost.
        """
        self.error: ActionError | None = None
        """The error that the connection has ended with; None while it lasts."""
        self._line = line
        self._heartbeat = Heartbeat(line.peer, heartbeat)
        self._heartbeat.agree(heartbeat)
        self._fate = fate
        self._fragments = partial_messages(limit)
        self._goals: dict[ClientID, OutgoingGoal] = {}
        self._calls: dict[ClientID, _ServiceCall] = {}
        self._numbers = count(1)
        self._is_open = False
        self._waiting: deque[bytes] = deque()
        self._taken = self._written = self._asked = 0
        self._changed = Notifier()
        self._has_heard = False
        self._scope = CancelScope()
        self._notes: set[str] = set()

    # Requests

    async def opened(self) -> None:
        """Wait until the server has accepted the WebSocket.

        Raises:
            ActionError: It has not, or the connection has ended since.
        """
        while not self._is_open or self.error is not None:
            self._check()
            await self._changed.wait()

    async def send_goal(self, goal: OutgoingGoal, message: bytes) -> None:
        """Send a goal, which hears of its feedback and its end from now on.

        Raises:
            ActionError: The connection has ended.
        """
        self._check()
        self._goals[goal.request] = goal
        await self._send(message)

    def has(self, goal: OutgoingGoal) -> bool:
        """Return whether a goal was sent here, and has not ended."""
        return self._goals.get(goal.request) is goal

    async def cancel(self, goal: OutgoingGoal) -> None:
        """Ask the server to cancel a goal; rosbridge has no answer to that.

        Raises:
            ActionError: The connection has ended.
        """
        message = {"op": "cancel_action_goal", "id": goal.request, "action": goal.action}
        await self._send(msgspec.json.encode(message))

    async def call(self, service: str, args: dict[str, Any], timeout: float) -> Any:
        """Call a service, and return the values of its answer.

        Raises:
            CallFailed: The answer is an error.
            NoAnswer: There is no answer within `timeout` seconds.
            ActionError: The connection has ended.
        """
        request = f"call_service:{service}:{next(self._numbers)}"
        call = self._calls[request] = _ServiceCall()
        try:
            with anyio.move_on_after(timeout):
                message = {"op": "call_service", "id": request, "service": service, "args": args}
                await self._send(msgspec.json.encode(message))
                await call.is_answered.wait()
        finally:
            del self._calls[request]
        if not call.is_answered.is_set():
            raise NoAnswer(
                f"{self._line.peer} has not answered a call of {service} within {timeout:g} s"
            )
        if call.error is not None:
            raise copy_of(call.error)
        return call.values

    async def _send(self, message: bytes) -> None:
        """Send a message, and wait until it is written.

        Raises:
            ActionError: The connection has ended.
        """
        self._check()
        self._waiting.append(message)
        self._asked += 1
        number = self._asked
        self._line.wake_writer()
        while self._written < number:
            self._check()
            await self._changed.wait()

    def _check(self) -> None:
        if self.error is not None:
            raise copy_of(self.error)

    # The connection

    async def run(self) -> None:
        """Move messages until the connection ends, or `close` is called."""
        error: ActionError = ConnectionLost(f"the connection to {self._line.peer} was closed here")
        try:
            with self._scope:
                error = await self._run_parts()
        finally:
            self._end(error)
            with CancelScope(shield=True):
                await self._leave(error)

    async def _leave(self, error: ActionError) -> None:
        """Close the line; the close says it if a message of the server was the error."""
        if isinstance(error, ProtocolError):
            with anyio.move_on_after(LEAVE), suppress(ConnectionLost):
                await self._line.send([INVALID])
        await self._line.aclose()

    async def _run_parts(self) -> ActionError:
        errors: list[ActionError] = []

        async def move() -> None:
            try:
                await self._line.run(self._on_frames, self._next_frames)
            except ActionError as exc:
                errors.append(exc)
                tasks.cancel_scope.cancel()

        async def watch() -> None:
            try:
                await self._watch()
            except ConnectionLost as exc:
                errors.append(exc)
                tasks.cancel_scope.cancel()

        async with create_task_group() as tasks:
            tasks.start_soon(move)
            tasks.start_soon(watch)
        return self._named(errors[0])

    def _named(self, error: ActionError) -> ActionError:
        """Return the error with the address of the server in its text."""
        text, peer = str(error), self._line.peer
        return error if peer in text else type(error)(f"{peer}: {text}")

    async def _watch(self) -> None:
        """Ask for signs of life.

        Raises:
            ConnectionLost: There is none.
        """
        progress = self._line.progress
        while True:
            step = self._heartbeat.step
            await anyio.sleep(step)
            is_stuck = self._written < self._taken and self._line.progress == progress
            progress = self._line.progress
            heard, self._has_heard = self._has_heard, False
            self._heartbeat.tick(step, has_heard=heard, has_said=False, is_stuck=is_stuck)
            # Nothing else makes a server say anything, so it is asked at each step.
            if PING not in self._waiting:
                self._waiting.append(PING)
                self._asked += 1
                self._line.wake_writer()

    def close(self, error: ActionError) -> None:
        """End the connection here; everything that waits ends with this error."""
        self._end(error)
        self._scope.cancel()

    def _end(self, error: ActionError) -> None:
        if self.error is not None:
            return
        self.error = error
        self._fragments.close()
        self._waiting.clear()
        goals, self._goals = self._goals, {}
        for goal in goals.values():
            goal.lose(type(error)(f"{error}; {self._fate}"))
        for call in self._calls.values():
            call.error = error
            call.is_answered.set()
        self._changed.notify()

    def _next_frames(self) -> list[bytes]:
        self._written = self._taken
        frames = list(self._waiting)
        self._waiting.clear()
        self._taken += len(frames)
        self._changed.notify()
        return frames

    # What arrives

    def _on_frames(self, frames: list[bytes]) -> list[bytes]:
        self._has_heard = True
        for frame in frames:
            if frame == OPENED:
                self._is_open = True
                self._changed.notify()
            else:
                self._handle(read_from_server(frame.decode()))
        return []

    def _handle(self, message: ServerOperation) -> None:
        if isinstance(message, Fragment):
            text = self._fragments.add_fragment(message)
            if text is not None:
                message = read_from_server(text)
                if isinstance(message, Fragment):
                    raise ProtocolError("it sent a fragment within fragments")
                self._handle(message)
        elif isinstance(message, Ignored):
            self._note(f"the operation {message.op!r} of rosbridge is not known: ignored")
        elif message.id in self._goals:
            self._tell_goal(self._goals[message.id], message)
        elif message.id in self._calls:
            self._answer(self._calls[message.id], message)
        elif isinstance(message, StatusMessage):
            self._note(f"{excerpt(message.level)}: {excerpt(message.msg)}")
        # Anything else is about what has ended here: a call without patience, for example.

    def _tell_goal(self, goal: OutgoingGoal, message: ServerOperation) -> None:
        if isinstance(message, ActionFeedback):
            goal.take_feedback(message)
        elif isinstance(message, ActionResult):
            goal.take_result(message)
        elif isinstance(message, StatusMessage) and message.level == "error":
            self._note(f"{goal.request}: {excerpt(message.msg)}")
            goal.reject(message.msg)
        elif isinstance(message, Wrong):
            goal.lose(_wrong(message))
        if goal.is_over:
            del self._goals[goal.request]

    def _answer(self, call: _ServiceCall, message: ServerOperation) -> None:
        if isinstance(message, ServiceResponse) and message.result:
            call.values = message.values
        elif isinstance(message, ServiceResponse):
            call.error = CallFailed(_text(message.values))
        elif isinstance(message, StatusMessage) and message.level == "error":
            call.error = CallFailed(_text(message.msg))
        elif isinstance(message, Wrong):
            call.error = _wrong(message)
        else:
            return
        call.is_answered.set()

    def _note(self, text: str) -> None:
        if text not in self._notes and len(self._notes) < MOST_NOTES:
            self._notes.add(text)
            logger.warning("%s: %s", self._line.peer, text)


def _wrong(message: Wrong) -> ProtocolError:
    return ProtocolError(f"the {message.op} of the server is invalid: {excerpt(message.why)}")


def _text(values: object) -> str:
    return excerpt(values, REASON) if isinstance(values, str) else "no reason is given"
