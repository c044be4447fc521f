"""The goals of a fleet that were given up: listed from their records, and run again as new ones."""

from __future__ import annotations

import secrets
import time

from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import NotGivenUp, StoredGoal
from fibaction.words.errors import ConnectionLost, StoreError
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, PutError, PutFailure
from fibaction_transports.nats.names import FleetNames, action_of
from fibaction_transports.nats.records import (
    NONCE_SIZE,
    ROOM_TO_GROW,
    GoalEntry,
    encode,
    goal_entry,
)

SECOND = 1_000_000_000


async def given_up_goals(broker: Broker, names: FleetNames) -> dict[str, list[StoredGoal]]:
    """Return the goals of a fleet that were given up, by their actions, in the order of their ends.

    Raises:
        ConnectionLost: The brokers do not answer.
    """
    found: dict[str, list[StoredGoal]] = {}
    slices = Slices()
    try:
        async with broker.watch(names.goals, names.all_goals()) as watch:
            while (records := await watch.next()) is not None:
                for record in records:
                    goal = goal_entry(record.data).goal if record.data else None
                    if goal is not None and goal.is_given_up:
                        found.setdefault(action_of(record.subject), []).append(goal)
                    await slices.pause()
    except BrokerAway as exc:
        raise ConnectionLost(f"the goals of the fleet cannot be listed: {exc}") from exc
    for goals in found.values():
        goals.sort(key=lambda goal: goal.ended_at)
    return found


async def rerun_goal(broker: Broker, names: FleetNames, action: str, goal_id: GoalID) -> GoalID:
    """Store a new goal for one that was given up, and return its ID. A worker takes it, and
    runs it from the checkpoint of the old one, of which only the outcome is kept.

    Raises:
        NotGivenUp: The goal was not given up, or runs again already.
        StoreError: It cannot be stored.
        ConnectionLost: The brokers do not answer.
    """
    subject = names.goal(action, goal_id)
    try:
        record = await broker.get(names.goals, subject)
    except BrokerAway as exc:
        raise ConnectionLost(f"the record of goal {goal_id} cannot be read: {exc}") from exc
    entry = goal_entry(record.data) if record is not None and record.data else None
    if record is None or entry is None or not entry.goal.is_given_up:
        raise NotGivenUp(f"goal {goal_id} was not given up, or is not kept any more")
    new = entry.goal.as_new(time.time_ns())
    nonce = secrets.token_bytes(NONCE_SIZE) + bytes(ROOM_TO_GROW)
    to_run = names.goal(action, new.goal_id)
    stored = await _put(broker, to_run, GoalEntry(new, b"", nonce), 0)
    if isinstance(stored, PutError):
        if stored.kind is PutFailure.REFUSED:
            raise NotGivenUp(f"goal {goal_id} runs again already, as goal {new.goal_id}")
        raise StoreError(f"goal {goal_id} cannot be run again: {stored.text}")
    broker.add_note(names.left(action), bytes(new.goal_id))
    entry.goal.drop_request()
    await _put(broker, subject, entry, record.sequence)
    return new.goal_id


async def _put(broker: Broker, subject: str, entry: GoalEntry, expected: int) -> int | PutError:
    """Store a record, and return the answer."""
    goal = entry.goal
    ttl = max(1.0, (goal.keep_until - time.time_ns()) / SECOND) if goal.keep_until else None
    return await broker.put_and_wait(subject, encode(entry), expected=expected, ttl=ttl)
