"""The stream of the history of a fleet, whose oldest records the brokers remove by themselves."""

from __future__ import annotations

from fibaction.words.errors import TransportError
from fibaction.words.goal_history import GoalHistory
from fibaction_transports.nats.broker.broker import BrokerAway, NoResponders
from fibaction_transports.nats.broker.client import NatsClient
from fibaction_transports.nats.broker.jetstream import (
    SECOND,
    ApiError,
    create_large_stream,
    update_stream,
)
from fibaction_transports.nats.names import FleetNames

HISTORY_BYTES = 2**28
"""Bytes that a new history reserves, or a half of it, and so on, where the broker has less storage.
"""
LEAST_AGE, MOST_AGE = SECOND // 10, 2**63 - 1
"""Nanoseconds for which brokers can keep a record."""


async def create_history_stream(
    client: NatsClient, names: FleetNames, history: GoalHistory, replicas: int, brokers: int
) -> None:
    """Make the stream of a history, or set the bounds of the one that is there.

    Raises:
        TransportError: A stream of this name is of something else, or cannot be made.
    """
    bounds = _bounds(history)
    wanted = {
        "name": names.history,
        "subjects": [names.all_past()],
        "retention": "limits",
        "storage": "file",
        "discard": "old",
        "max_msgs_per_subject": 1,
        "allow_direct": True,
        **bounds,
    }
    found = await create_large_stream(client, wanted, HISTORY_BYTES, replicas, brokers)
    if any(found.get(name) != value for name, value in bounds.items()):
        found.pop("duplicate_window", None)  # the broker chooses one that fits the age
        try:
            await update_stream(client, {**found, **bounds})
        except (ApiError, NoResponders, BrokerAway) as exc:
            raise TransportError(
                f"the bounds of the stream {names.history} cannot be set: {exc}"
            ) from exc


def _bounds(history: GoalHistory) -> dict[str, int]:
    """Return the bounds as settings of a stream, in which an age of 0 is none."""
    age = history.seconds * SECOND
    return {
        "max_age": int(max(age, LEAST_AGE)) if age < MOST_AGE else 0,
        "max_msgs": min(history.goals, MOST_AGE),
    }
