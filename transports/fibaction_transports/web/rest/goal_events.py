"""One goal as a stream of server-sent events, and the end of a goal that is waited for.

The ID of an event is the cursor of the feedback up to there, so a browser that comes back with it
as `Last-Event-ID` gets the feedback after it: `17`, or `2.17` in the second attempt at the goal.
The result has the ID `end`: there is nothing after it, which the answer 204 says, and then a
browser asks no more.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass

import anyio
import msgspec

from fibaction.border.event_loop import Slices
from fibaction.border.http_access import Refused
from fibaction.border.streams import FeedbackItem, GoalStream, GoalUpdate
from fibaction.schema.payload import JsonCodec, PayloadError
from fibaction.wire.channel import CHUNK
from fibaction.words.errors import ActionError, ConnectionLost
from fibaction.words.goals import Outcome
from fibaction_transports._http.exchange import Exchange
from fibaction_transports._http.problems import Problem, problem_of
from fibaction_transports.web.rest.goal_list import facts_of

END = "end"
"""The ID of the last event of a goal."""
KEEP_ALIVE = b":\n\n"
"""A comment, which keeps proxies from ending a stream without events."""

_CURSOR = re.compile(r"(?:([1-9]\d{0,8})\.)?(\d{1,18})", re.ASCII)
LONGEST_WAIT = 3600.0
"""Seconds that a request may wait for the end of a goal."""
BATCH = 64
"""Feedback messages that are taken at once."""
KEEP_ALIVE_AFTER = 15.0
"""Seconds without an event, after which a comment is sent."""
AT_ONCE = 0.01
"""Seconds in which short goals end. Only after them it is watched whether the client goes, which
costs a task."""


@dataclass(frozen=True)
class Cursor:
    """A position in the feedback of a goal."""

    number: int = 0
    attempt: int = 1

    def __str__(self) -> str:
        return str(self.number) if self.attempt == 1 else f"{self.attempt}.{self.number}"


def cursor_of(text: str) -> Cursor | None:
    """Return the cursor in the ID of an event; None for that of the last event.

    Raises:
        Refused: It is not the ID of an event.
    """
    if text == END:
        return None
    found = _CURSOR.fullmatch(text)
    if found is None:
        raise Refused(400, "the ID of an event is like 17, or 2.17 in the second attempt")
    return Cursor(int(found[2]), int(found[1] or 1))


def event(name: str, data: str, event_id: str = "") -> str:
    """Return one event; the data is JSON on one line."""
    first = f"id: {event_id}\n" if event_id else ""
    return f"{first}event: {name}\ndata: {data}\n\n"


@dataclass(frozen=True)
class GoalEvents:
    """The events of the goals of one action."""

    feedback: JsonCodec
    result: JsonCodec
    has_times: bool = False
    """True if the data of feedback has the time at which it was reported."""

    def accepted(self, stream: GoalStream) -> str:
        """Return the first event of a goal, with the newest status of it."""
        return event("accepted", _json(facts_of(stream.info)))

    def update(self, stream: GoalStream, update: GoalUpdate) -> str:
        """Return the event of an update.

        Raises:
            PayloadError: JSON cannot express the message.
        """
        if isinstance(update, FeedbackItem):
            cursor = Cursor(update.number, update.attempt)
            data = self.feedback.to_text(update.payload)
            if self.has_times:
                data = f'{{"at":"{update.at}","feedback":{data}}}'
            return event("feedback", data, str(cursor))
        if isinstance(update, Outcome):
            members = self.outcome_members(update) | {"feedback_dropped": stream.dropped}
            return event("result", _json(members), END)
        return event("status", _json({"status": update.name}))

    def failure(self, problem: Problem) -> str:
        """Return the last event of a stream that cannot continue."""
        return event("failure", problem.body.decode())

    def outcome_members(self, outcome: Outcome[bytes]) -> dict[str, object]:
        """Return the end of a goal as members of an object. If JSON cannot express the result, or
        it was stored in another encoding, the reason says so.
        """
        return outcome.readable(
            lambda result: msgspec.Raw(self.result.to_text(result).encode())
        ).members

    def checkpoint_members(self, checkpoint: bytes | None) -> dict[str, object]:
        """Return the checkpoint of a goal that was given up, as `GoalStream.checkpoint`, as a
        member of an object: null if there is none, or none that JSON can express.
        """
        if checkpoint is None:
            return {}
        text = "null"
        with suppress(PayloadError):
            text = self.result.to_text(checkpoint) if checkpoint else text
        return {"checkpoint": msgspec.Raw(text.encode())}


def _json(members: dict[str, object]) -> str:
    return msgspec.json.encode(members).decode()


async def tell_goal(
    exchange: Exchange,
    events: GoalEvents,
    stream: GoalStream,
    status: int,
    *headers: tuple[str, str],
) -> bool:
    """Answer with the events of a goal; return whether the client has taken all of them.

    What is there at once costs one write.
    """
    told = False
    async with exchange.until_gone():
        try:
            exchange.begin_events(status, *headers)
            await exchange.write(events.accepted(stream).encode())
            await _tell_updates(exchange, events, stream)
            await exchange.end()
            told = True
        except ConnectionLost:
            pass
    return told


async def _tell_updates(exchange: Exchange, events: GoalEvents, stream: GoalStream) -> None:
    slices = Slices()
    while True:
        text, has_ended = _next_events(events, stream)
        if text:
            await exchange.write(text.encode())
            await slices.pause()
        if has_ended:
            return
        if not text:
            with anyio.move_on_after(KEEP_ALIVE_AFTER) as waiting:
                await stream.news.wait()
            if waiting.cancelled_caught:
                await exchange.write(KEEP_ALIVE)


def _next_events(events: GoalEvents, stream: GoalStream) -> tuple[str, bool]:
    """Return the events that there are now, as many as fill a write, and whether they are all."""
    parts: list[str] = []
    size = 0
    try:
        while size < CHUNK and (updates := stream.take(BATCH)):
            for update in updates:
                parts.append(events.update(stream, update))
                size += len(parts[-1])
            if isinstance(updates[-1], Outcome):
                return "".join(parts), True
    except (ActionError, PayloadError) as exc:
        return "".join([*parts, events.failure(problem_of(exc))]), True
    return "".join(parts), False


async def wait_for_end(
    exchange: Exchange, stream: GoalStream, seconds: float
) -> Outcome[bytes] | None:
    """Wait for the end of a goal; return None if it has not ended in time.

    Raises:
        ConnectionLost: The client has gone; or the rest of the goal cannot be followed.
        ActionError: As for `GoalStream.outcome`.
    """
    with anyio.move_on_after(min(seconds, AT_ONCE)):
        return await stream.outcome()
    outcome: Outcome[bytes] | None = None
    error: ActionError | None = None
    async with exchange.until_gone() as gone:
        with anyio.move_on_after(seconds - AT_ONCE):
            try:
                outcome = await stream.outcome()
            except ActionError as exc:  # raised below, and not in an exception group
                error = exc
    if error is not None:
        raise error
    if gone.cancelled_caught:
        raise ConnectionLost(f"{exchange.peer} has gone")
    return outcome
