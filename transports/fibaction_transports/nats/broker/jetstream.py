"""Requests to JetStream: streams, and the answers to writes.

They are JSON in requests of `NatsClient`.
"""

from __future__ import annotations

import re
from datetime import datetime
from typing import Any

import anyio
import msgspec

from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import TransportError
from fibaction.words.goal_query import GoalHistory
from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    BrokerStream,
    NoResponders,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.broker.client import NatsClient
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import MANY

MARKER_TTL = 60
"""Seconds for which the marker of a deleted or expired record is kept."""
LEAST_VERSION = (2, 11)
"""The first version whose records have a time to live."""
API_TIMEOUT = 5.0
"""Seconds for requests that all brokers have to agree on."""
ELECTION = 15.0
"""Seconds within which several brokers agree on a leader."""
PLACEMENT = 5.0
"""Seconds in which new brokers have heard of each other, so that replicas can be placed."""
INFO_TIMEOUT = 1.0
"""Seconds for a first request, which brokers without a leader do not answer."""
TRY_AGAIN = 0.2
"""Seconds until a request is made again that no leader has answered."""
SECOND = 10**9

STREAM_NOT_FOUND, NAME_IN_USE = 10059, 10058
NO_LEADER, OFFLINE = 10008, 10009
WRONG_SEQUENCE = (10071, 10164)
TOO_LARGE = (10054,)
FULL = (10023, 10028, 10047, 10077)
"""Numbers of errors, as in nats-server's server/errors.json."""
NO_PEERS, NO_CLUSTER = 10005, 10074
NO_ROOM_FOR_REPLICAS = (NO_PEERS, NO_CLUSTER)
NO_STORAGE = "insufficient storage"
"""A part of the text of each error that says so; their numbers have other meanings as well."""

GOAL_BYTES = 2**30
"""Bytes that a new fleet reserves for the records of goals: see `create_large_stream`."""
SHARE, MOST_OTHER_BYTES = 16, 2**23
"""It reserves this part of them for the leases of its workers, and for its notes; and the most."""
LEAST_BYTES = 2**18
"""The least bytes of each of the three."""
HISTORY_BYTES = 2**28
"""Bytes that a new history reserves, or a half of it, and so on, where the broker has less storage.
"""
LEAST_AGE, MOST_AGE = SECOND // 10, 2**63 - 1
"""Nanoseconds for which brokers can keep a record of the history."""

logger = clean_logger("fibaction.nats")


class ApiError(Exception):
    """An error that JetStream has answered with."""

    def __init__(self, error: dict[str, Any]) -> None:
        super().__init__(str(error.get("description", "no description")))
        self.code: int = error.get("code", 0)
        self.number: int = error.get("err_code", 0)


async def call(
    client: NatsClient, name: str, body: bytes = b"", timeout: float = API_TIMEOUT
) -> dict[str, Any]:
    """Make a request to JetStream, and return the answer.

    Raises:
        ApiError: It answers with an error.
        NoResponders, BrokerAway: It does not answer.
    """
    message = await client.answer(f"$JS.API.{name}", body, timeout)
    try:
        answer: dict[str, Any] = msgspec.json.decode(message.data, type=dict[str, Any])
    except msgspec.DecodeError as exc:
        raise BrokerAway(f"the answer to {name} cannot be read: {exc}") from exc
    if error := answer.get("error"):
        raise ApiError(error)
    return answer


class _Error(msgspec.Struct):
    code: int = 0
    err_code: int = 0
    description: str = ""


class _PubAck(msgspec.Struct):
    seq: int = 0
    error: _Error | None = None


_pub_ack = msgspec.json.Decoder(_PubAck)


def outcome(data: bytes) -> int | PutError:
    """Return the sequence of a stored record, or the error, from the answer to a write."""
    try:
        ack = _pub_ack.decode(data)
    except msgspec.DecodeError as exc:
        return PutError(PutFailure.UNKNOWN, f"the answer cannot be read: {exc}")
    error = ack.error
    if error is None:
        return ack.seq
    if error.err_code in WRONG_SEQUENCE:
        kind = PutFailure.REFUSED
    elif error.err_code in TOO_LARGE:
        kind = PutFailure.TOO_LARGE
    elif error.code == 503 and error.err_code not in FULL:
        kind = PutFailure.UNKNOWN  # there is no leader now
    else:
        kind = PutFailure.FULL
    return PutError(kind, error.description)


def check_version(url: str, version: str) -> None:
    """Check the version of a broker.

    Raises:
        TransportError: It is too old.
    """
    found = re.match(r"v?(\d+)\.(\d+)", version)
    if found is None or (int(found[1]), int(found[2])) < LEAST_VERSION:
        raise TransportError(
            f"the broker at {url} is nats-server {version or 'of no known version'}, and a fleet"
            f" needs 2.11 or later: in older ones the lease of a lost worker does not end"
        )


async def check_account(client: NatsClient) -> None:
    """Check that JetStream is there for this account.

    Raises:
        TransportError: It is not.
    """
    why = "it does not answer"
    with anyio.move_on_after(ELECTION):
        while True:
            try:
                answer = await call(client, "INFO", timeout=INFO_TIMEOUT)
            except NoResponders as exc:
                why = "is not enabled: start nats-server with -js"
                if not client.info.cluster:
                    raise TransportError(f"JetStream of the broker {client.url} {why}") from exc
            except ApiError as exc:
                why = f"cannot be used: {exc}"
                if exc.number not in (NO_LEADER, OFFLINE):
                    raise TransportError(f"JetStream of the broker {client.url} {why}") from exc
            except BrokerAway as exc:
                if not client.info.cluster:
                    raise TransportError(f"the broker {client.url} does not answer") from exc
            else:
                if answer.get("api", {}).get("level", 0) < 1:
                    raise TransportError(
                        f"JetStream of {client.url} is older than 2.11: update all brokers"
                    )
                return
            await anyio.sleep(TRY_AGAIN)
    raise TransportError(f"JetStream of the broker {client.url} {why}")


async def find_stream(client: NatsClient, stream: str) -> BrokerStream | None:
    """Return a stream; None if it is missing.

    Raises:
        BrokerAway: Nothing answers, or there is no leader now.
    """
    try:
        answer = await call(client, f"STREAM.INFO.{stream}")
    except ApiError as exc:
        if exc.number == STREAM_NOT_FOUND:
            return None
        raise BrokerAway(f"the stream {stream} does not answer: {exc}") from exc
    except NoResponders as exc:
        raise BrokerAway("JetStream does not answer") from exc
    made, now = (datetime.fromisoformat(answer[key]) for key in ("created", "ts"))
    return BrokerStream(answer["created"], (now - made).total_seconds())


def _streams(names: FleetNames) -> list[dict[str, Any]]:
    """Return the settings of the streams of a fleet; that of the keys is the last one."""
    records = {
        "retention": "limits",
        "storage": "file",
        "discard": "new",
        "max_msgs_per_subject": 1,
        "allow_direct": True,
        "allow_msg_ttl": True,
        "allow_rollup_hdrs": True,
        "subject_delete_marker_ttl": MARKER_TTL * SECOND,
    }
    notes = {"retention": "workqueue", "storage": "file", "discard": "new"}
    return [
        {"name": names.goals, "subjects": [names.all_goals()], **records},
        {"name": names.workers, "subjects": [names.worker()], **records},
        {"name": names.notes, "subjects": [names.all_want(), names.all_left()], **notes},
        {"name": names.keys, "subjects": [names.all_keys()], **records},
    ]


class NoStorage(TransportError):
    """The error for a stream that reserves more than the broker has left."""


async def create_streams(
    client: NatsClient, names: FleetNames, replicas: int, brokers: int, *, has_keys: bool = False
) -> None:
    """Make the streams of a fleet but that of its history, or check those that are there.

    Each has a limit, which is reserved for it: goals that fill their stream leave room for leases.

    Raises:
        TransportError: A stream of this name is of something else, or cannot be made.
    """
    goals, *others, keys = _streams(names)
    if has_keys:
        others.append(keys)
    made = await create_large_stream(client, goals, GOAL_BYTES, replicas, brokers)
    if made.get("max_bytes", -1) < 0:
        logger.warning(
            "the stream %s has no limit: goals that fill the broker stop all workers; `nats stream"
            " edit %s --max-bytes=...` sets one",
            names.goals,
            names.goals,
        )
    for wanted in others:
        made = await _create_beside(made, client, wanted, replicas, brokers)


async def create_history(
    client: NatsClient, names: FleetNames, history: GoalHistory, replicas: int, brokers: int
) -> None:
    """Make the stream of a history, whose oldest records the brokers remove, or set the bounds of
    the one that is there.

    Raises:
        TransportError: A stream of this name is of something else, or cannot be made.
    """
    age = history.seconds * SECOND
    bounds = {
        "max_age": int(max(age, LEAST_AGE)) if age < MOST_AGE else 0,  # 0 is none
        "max_msgs": min(history.goals, MOST_AGE),
    }
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


async def _create_beside(
    goals: dict[str, Any], client: NatsClient, wanted: dict[str, Any], replicas: int, brokers: int
) -> dict[str, Any]:
    """Make a stream, of whose size that of the goals leaves room; return the settings of that."""
    while True:
        limit = goals.get("max_bytes", -1)
        size = MOST_OTHER_BYTES
        if limit >= 0:
            size = max(LEAST_BYTES, min(limit // SHARE, size))
        try:
            await create_stream(client, {**wanted, "max_bytes": size}, replicas, brokers)
        except NoStorage:
            if limit // 2 < LEAST_BYTES:
                raise
            goals = {**goals, "max_bytes": limit // 2}
            await update_stream(client, goals)
        else:
            return goals


async def create_large_stream(
    client: NatsClient, wanted: dict[str, Any], size: int, replicas: int, brokers: int
) -> dict[str, Any]:
    """Make or check a stream of this size, or of a half, and so on, if there is less storage."""
    while True:
        try:
            return await create_stream(client, {**wanted, "max_bytes": size}, replicas, brokers)
        except NoStorage:
            if (size := size // 2) < LEAST_BYTES:
                raise


async def create_stream(
    client: NatsClient, wanted: dict[str, Any], replicas: int, brokers: int
) -> dict[str, Any]:
    """Make a stream, or check the one that is there; return its settings.

    Raises:
        NoStorage: It reserves more than the broker has left.
        TransportError: As for `create_streams`.
    """
    name = wanted["name"]
    count = replicas or (MANY if brokers >= MANY else 1)
    placed_by = anyio.current_time() + PLACEMENT
    with anyio.move_on_after(ELECTION):
        while True:
            try:
                found = await _get_or_create(client, {**wanted, "num_replicas": count})
                _check_stream(wanted, found)
                if replicas and found["num_replicas"] != replicas:
                    found["num_replicas"] = replicas
                    await update_stream(client, found)
                return found
            except ApiError as exc:
                what = f"the stream {name} cannot be made: {exc}"
                if NO_STORAGE in str(exc):
                    raise NoStorage(what) from exc
                if exc.number == NO_PEERS and anyio.current_time() < placed_by:
                    pass  # the one that leads has not heard of the others yet
                elif exc.number in NO_ROOM_FOR_REPLICAS and not replicas and count > 1:
                    logger.warning("%s; one broker keeps each of its records", what)
                    count = 1
                elif exc.code != 503 or exc.number in NO_ROOM_FOR_REPLICAS:
                    raise TransportError(what) from exc
            except (NoResponders, BrokerAway):
                pass  # there is no leader now
            await anyio.sleep(TRY_AGAIN)
    raise TransportError(f"the stream {name} cannot be made: JetStream does not answer")


async def update_stream(client: NatsClient, config: dict[str, Any]) -> None:
    """Change the settings of a stream. Raises as `call` does."""
    await call(client, f"STREAM.UPDATE.{config['name']}", msgspec.json.encode(config))


async def _get_or_create(client: NatsClient, wanted: dict[str, Any]) -> dict[str, Any]:
    name = wanted["name"]
    try:
        answer = await call(client, f"STREAM.INFO.{name}")
    except ApiError as exc:
        if exc.number != STREAM_NOT_FOUND:
            raise
        try:
            answer = await call(client, f"STREAM.CREATE.{name}", msgspec.json.encode(wanted))
        except ApiError as clash:
            if clash.number != NAME_IN_USE:
                raise
            answer = await call(client, f"STREAM.INFO.{name}")  # another worker was faster
    config: dict[str, Any] = answer["config"]
    return config


def _check_stream(wanted: dict[str, Any], found: dict[str, Any]) -> None:
    for key in ("subjects", "retention", "max_msgs_per_subject", "allow_msg_ttl"):
        if key in wanted and found.get(key) != wanted[key]:
            raise TransportError(
                f"the stream {wanted['name']} is of something else: its {key} is {found.get(key)},"
                f" and not {wanted[key]}; choose another name for the fleet, or delete the stream"
            )
