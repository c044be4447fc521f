"""One goal as a stream of server-sent events, and the end of a goal that is waited for."""

from __future__ import annotations

import anyio

from fibaction.border.event_loop import Slices
from fibaction.border.streams import GoalStream
from fibaction.schema.payload import PayloadError
from fibaction.wire.channel import CHUNK
from fibaction.words.errors import ActionError, ConnectionLost
from fibaction.words.goals import Outcome
from fibaction_transports._http.exchange import Exchange
from fibaction_transports._http.problems import problem_of
from fibaction_transports.web.rest.goal_events import KEEP_ALIVE, GoalEvents

LONGEST_WAIT = 3600.0
"""Seconds that a request may wait for the end of a goal."""
BATCH = 64
"""Feedback messages that are taken at once."""
KEEP_ALIVE_AFTER = 15.0
"""Seconds without an event, after which a comment is sent."""
AT_ONCE = 0.01
"""Seconds in which short goals end. Only after them it is watched whether the client goes, which
costs a task."""


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
