"""The things that a server holds for its clients: how much at a time, and what is left in the end.

It looks into the tables of the product, since no client can see them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sized
from typing import Any

from fibaction import ActionServer
from fibaction.server.scheduling.goal_dispatcher import GoalDispatcher
from fibaction.wire.frames import HEADER
from fibaction.wire.link import OVERFULL
from fibaction.wire.server.session import Session
from fibaction.wire.settings import Limits
from fibaction.wire.wire_server import WireServer

FIRST_FRAME = 4096
"""Bytes of the largest first message of a client, as docs/protocol.md says."""
ANSWER = 2**16
"""Bytes of the largest answer in these scenarios: it may come on top of a queue that is full."""


def excesses(session: Session, limits: Limits) -> Iterator[str]:
    """Yield what a server holds for one connection in excess of its limits."""
    link, goals = session._link, session._goals.open.values()
    follows = Counter(one.stream.goal_id for one in goals if one.stream is not None)
    frame = limits.frame if session.client.is_known else FIRST_FRAME
    yield from _above("goals", len(goals), limits.goals)
    yield from _above("requests", len(session._waiting), limits.requests)
    yield from _above("follows of one goal", max(follows.values(), default=0), limits.follows)
    yield from _above("bytes to send", link._queued, OVERFULL * limits.queue + ANSWER)
    reader = link._line._framing  # type: ignore[attr-defined]  # each line of a test has one
    yield from _above("bytes of a message", len(reader._buffer), frame + HEADER)


def _above(what: str, number: int, limit: int) -> Iterator[str]:
    if number > limit:
        yield f"{number} {what}, and the limit is {limit}"


def holders(session: Session) -> Iterator[Any]:
    """Yield the streams of a connection that an executor waits for."""
    for subscription in session._goals.open.values():
        if getattr(subscription.stream, "holding", False):
            yield subscription.stream


def left_for_clients(server: WireServer) -> Iterator[str]:
    """Yield the goals and requests that are held for the clients of a server."""
    for one in server._owners._owned:
        yield f"an orphan: {one!r}"
    for session in server._sessions:
        peer = session._link.peer
        yield from (f"a goal of {peer}: {one}" for one in session._goals.open)
        yield from (f"a request of {peer}: {one}" for one in session._waiting)


def left_without_clients(server: WireServer, actions: ActionServer[Any, Any, Any]) -> Iterator[str]:
    """Yield the tables and the counters that are not empty although all clients have left, no goal
    is active, and all results have expired.
    """
    parts = actions._parts
    runs, admission = parts.runs, parts.admission
    tables: dict[str, Sized] = {
        "connections": server._sessions,
        "connections without a hello": server._unknown,
        "sessions": server._latest,
        "large messages": server.frames._held,
        "owners": server._owners._owned,
        "active goals": runs._runs,
        "goals of the registry": runs._registry._active,
        "undecided goals": runs._registry._undecided,
        "waits for decisions": admission._decisions,
        "followers of statuses": parts.logs._statuses._cursors,
    }
    dispatcher = parts.dispatcher
    if isinstance(dispatcher, GoalDispatcher):
        scheduler = dispatcher._shared.scheduler
        tables |= {
            "places": scheduler._entries,
            "keys": scheduler._groups,
            "goals that wait": scheduler._waiting,
            "goals that may take too long": scheduler._timed.running,
            "goals with successors": scheduler._timed.told,
            "goals that clean up": scheduler._timed.interrupted,
            "waits for successors": dispatcher._successor_news,
        }
        yield from (f"{count} goals run" for count in (scheduler._running,) if count)
    yield from (f"{len(table)} {name}" for name, table in tables.items() if len(table))
    counters = {"messages": server.memory.used, "goals": runs._registry.budget.used}
    yield from (f"{count} bytes of {name}" for name, count in counters.items() if count)
