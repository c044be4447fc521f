"""Floods: as many messages of one kind as a connection takes, on one connection and on many."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

from fibaction.wire.messages import (
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelGoals,
    Close,
    Credit,
    Follow,
    ListActions,
    Ping,
    Received,
    WatchStatus,
    past_fields,
)
from fibaction.words.goal_query import PastPage
from tests.hostile.attack import MOST, attack, goal_id, sending
from tests.hostile.raw_client import Raw, Target, each, packed
from tests.support.fibonacci import FIBONACCI, Goal

SHORT = FIBONACCI.goal.encode(Goal(1))
TERMS = FIBONACCI.goal.encode(Goal(20))
SAME = goal_id()
WRONG = b"\x81\xa5order\xa3one"
PAST = past_fields(PastPage())
MESSAGES = 4000
"""Messages of a wave, over all connections."""

KINDS: dict[str, Callable[[int], Any]] = {
    "Ping": lambda id: Ping(),
    "Credit": lambda id: Credit(id, MOST),
    "Close": Close,
    "Received": Received,
    "ListActions": ListActions,
    "AskPeers": lambda id: AskPeers(id, "fibonacci"),
    "AskPlaces": lambda id: AskPlaces(id, "forever", MOST),
    "AwaitServer": lambda id: AwaitServer(id, "fibonacci"),
    "AwaitServer, not served": lambda id: AwaitServer(id, "nothing"),
    "CancelGoals of one": lambda id: CancelGoals(id, "fibonacci", goal_id(), None),
    "CancelGoals of all": lambda id: CancelGoals(id, "forever", None, None),
    "CancelGoals before a stamp": lambda id: CancelGoals(id, "forever", None, 2**63 - 1),
    "WatchStatus": lambda id: WatchStatus(id, "fibonacci", MOST),
    "WatchStatus of the past": lambda id: WatchStatus(id, "fibonacci", MOST, PAST),
    "Follow of none": lambda id: Follow(id, "fibonacci", goal_id(), None, True, MOST),
    "SendGoal": lambda id: sending(id, "fibonacci", SHORT),
    "SendGoal with feedback": lambda id: sending(id, "fibonacci", TERMS),
    "SendGoal of the same": lambda id: sending(id, "fibonacci", SHORT, name=SAME),
    "SendGoal, not served": lambda id: sending(id, "nothing", SHORT),
    "SendGoal of another type": lambda id: sending(id, "fibonacci", WRONG),
    "SendGoal that is rejected": lambda id: sending(id, "picky", b"\xa2no"),
    "SendGoal that fails": lambda id: sending(id, "fail", b"\xa2no"),
}
"""A message of each kind, with that ID."""


async def flood(target: Target, kind: str, connections: int, messages: int = MESSAGES) -> None:
    """Send messages of a kind in pieces; wait for an answer only after each piece."""
    make = KINDS[kind]

    async def one(raw: Raw) -> None:
        for _ in range(2):
            ids = [next(raw.ids) for _ in range(max(50, messages // connections // 2))]
            await raw.write(packed(*map(make, ids)))
            await raw.fence()
            if kind.startswith("SendGoal"):
                await raw.write(packed(*map(Received, ids)))

    async with target.dial_many(connections) as raws:
        await each(raws, one)


async def flood_unread(target: Target, kind: str) -> None:
    """Send messages of a kind, and read nothing, until the server ends the connection."""
    make = KINDS[kind]
    async with target.dial(reads=False) as raw:
        ids = count(1)
        for _ in range(20):
            await raw.write(packed(*(make(next(ids)) for _ in range(500))))


for _kind in KINDS:
    for _connections in (1, 3, 10, 50, 300):
        attack(f"{_kind} x {_connections}", above=96, long=True)(
            partial(flood, kind=_kind, connections=_connections)
        )
for _kind in ("ListActions", "SendGoal with feedback", "WatchStatus", "AwaitServer, not served"):
    attack(f"{_kind}, unread", above=96)(partial(flood_unread, kind=_kind))


async def flood_of_all(target: Target, prefixes: tuple[str, ...]) -> None:
    """Send fewer messages of each kind that begins so, on three connections: the short form."""
    for kind in KINDS:
        if kind.startswith(prefixes):
            await flood(target, kind, 3, 1500)


attack("messages without an answer")(
    partial(flood_of_all, prefixes=("Ping", "Credit", "Close", "Received"))
)
attack("requests", above=96)(
    partial(flood_of_all, prefixes=("List", "Ask", "Await", "Watch", "Follow"))
)
attack("cancels", above=96)(partial(flood_of_all, prefixes=("Cancel",)))
attack("goals", above=96)(partial(flood_of_all, prefixes=("SendGoal",)))
