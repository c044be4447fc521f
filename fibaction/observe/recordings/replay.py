"""`replayed`: servers that answer goals from a recording, for tests without a robot.

Theory of operation
-------------------

The recording is read once, to find where each goal begins; what is kept of a goal is a digest of
its data and its position in the file. A goal that is sent is compared by its data, with defaults
filled in. Its executor then reads the recording from that position on, in a thread, some records at
a time, and yields the feedback at the recorded times. So the memory does not grow with the file.

The payloads of a recording have no Python types here. `_PayloadCodec` stands in for them: goals,
feedback and results are bytes of three classes.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterator
from hashlib import blake2b
from itertools import islice
from pathlib import Path
from typing import Any, cast

import anyio
import msgspec

from fibaction.observe.recordings.recording_file import (
    Record,
    RecordingError,
    numbered_records,
    payload_of,
)
from fibaction.schema.payload import GoalCodec, PayloadError
from fibaction.server import ActionServer, GoalHandle
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import GoalAborted, GoalRejected

__all__ = ["RecordingError", "replayed"]

AT_ONCE = 200
"""Records of a goal that are read at once."""
SECOND = 1_000_000_000
NOT_RECORDED = "the recording has no such goal"
CUT_OFF = "the recording ends before the end of this goal"

_sorted = msgspec.msgpack.Encoder(order="sorted")


class _Payload(bytes):
    """A message as bytes; its classes tell feedback from a result."""


class _Goal(_Payload):
    pass


class _Feedback(_Payload):
    pass


class _Result(_Payload):
    pass


class _PayloadCodec:
    """A stand-in for the `Codec` of a type that is not known."""

    def __init__(self, kind: type[_Payload]) -> None:
        self.kind = self.type = kind
        self.classes = (kind,)

    def holds(self, value: object) -> bool:
        return type(value) is self.kind

    accepts = holds

    def encode(self, value: bytes) -> bytes:
        return bytes(value)

    def decode(self, payload: bytes) -> bytes:
        return self.kind(payload)

    def schema(self) -> dict[str, Any]:
        """Return the schema of any value: the recording decides which goals are accepted."""
        return {}


def _action_of(info: ActionInfo) -> Action[Any, Any, Any]:
    """Return an action whose messages are payloads."""
    action = Action.untyped(info)
    action.goal = cast("Any", _PayloadCodec(_Goal))
    action.feedback = cast("Any", _PayloadCodec(_Feedback))
    action.result = cast("Any", _PayloadCodec(_Result))
    return action


class _Recorded:
    """The goals of one action in a recording."""

    def __init__(self, path: Path, info: ActionInfo) -> None:
        self.info = info
        self._path = path
        self._codec = GoalCodec(info.goal)
        self._places: dict[bytes, list[int]] = {}
        self._next: dict[bytes, int] = {}

    def add(self, position: int, record: Record) -> None:
        """Remember where a goal begins."""
        self._places.setdefault(self._key_of(record), []).append(position)

    def _key_of(self, record: Record) -> bytes:
        if record.data is msgspec.UNSET:
            return _digest(record.raw)
        try:
            return _digest(_sorted.encode(self._codec.complete(record.data)))
        except PayloadError:  # it was rejected because of that
            pass
        try:
            return _digest(_sorted.encode(record.data))
        except OverflowError:
            return b""  # no payload has such a number

    def find(self, payload: bytes) -> int | None:
        """Return the position of the goal with this payload; None if there is none.

        If there are several, each has its turn.
        """
        try:
            key = _digest(_sorted.encode(self._codec.complete(self._codec.decode(payload))))
        except PayloadError:
            key = _digest(payload)
        places = self._places.get(key)
        if places is None:
            return None
        turn = self._next.get(key, 0)
        self._next[key] = (turn + 1) % len(places)
        return places[turn]

    def records(self, position: int) -> Iterator[Record]:
        """Yield the records of the goal that begins at this position, to its end."""
        with open(self._path, "rb") as file:
            file.seek(position)
            goal_id = ""
            for _, record in numbered_records(file):
                goal_id = goal_id or record.goal_id
                if record.goal_id == goal_id:
                    yield record
                    if record.event in ("end", "rejected"):
                        return


def _digest(data: bytes) -> bytes:
    return blake2b(data, digest_size=16).digest()


class _Replay:
    """The `on_goal` and the executor of one action."""

    def __init__(self, goals: _Recorded, speed: float) -> None:
        self._goals = goals
        self._speed = speed
        self._chosen: dict[int, int] = {}  # by the identity of the request, which is kept alive

    def on_goal(self, goal: _Goal) -> None:
        """Find the goal in the recording.

        Raises:
            GoalRejected: It was rejected, or is not there.
        """
        position = self._goals.find(goal)
        if position is None:
            raise GoalRejected(NOT_RECORDED)
        first = next(self._goals.records(position))
        if first.event == "rejected":
            raise GoalRejected(first.reason)
        self._chosen[id(goal)] = position

    async def execute(self, goal: GoalHandle[_Goal]) -> AsyncGenerator[_Feedback | _Result, None]:
        """Yield the feedback of the recorded goal at its times, and end as it did."""
        records = self._goals.records(self._chosen.pop(id(goal.request)))
        info, begun, start = self._goals.info, 0, anyio.current_time()
        while batch := await anyio.to_thread.run_sync(lambda: list(islice(records, AT_ONCE))):
            for record in batch:
                begun = begun or record.time
                if record.event not in ("feedback", "end"):
                    continue  # a recorder outside the server may have been told it later
                at = start + (record.time - begun) / SECOND / self._speed
                if at > anyio.current_time():
                    await anyio.sleep_until(at)
                if record.event == "feedback":
                    yield _Feedback(payload_of(record, info.feedback) or b"")
                else:
                    payload = payload_of(record, info.result)
                    result = None if payload is None else _Result(payload)
                    if record.status == "SUCCEEDED" and result is not None:
                        yield result
                        return
                    reason = record.reason
                    if record.status == "CANCELED":
                        reason = f"it was canceled in the recording: {reason}".removesuffix(": ")
                    raise GoalAborted(reason, result=result)
        raise GoalAborted(CUT_OFF)


def replayed(path: str | Path, *, speed: float = 1.0) -> list[ActionServer[Any, Any, Any]]:
    """Return servers that answer from the recording, one for each action; `serve` them.

    A goal that is equal to a recorded one gets its feedback at the recorded times, and its end,
    whether it has succeeded, was rejected or aborted. Other goals are rejected. If the same goal
    was recorded several times, each has its turn. With a `speed` of 2, all takes half of the time.

    Raises:
        OSError: The file cannot be read.
        RecordingError: There are no servers in it.
        ValueError: The speed is not a positive number.
    """
    if not speed > 0:
        raise ValueError(f"speed must be a positive number, not {speed}")
    path = Path(path)
    actions: dict[str, _Recorded] = {}
    with open(path, "rb") as file:
        for position, record in numbered_records(file):
            if record.event == "server" and record.info is not None:
                if record.action not in actions:
                    actions[record.action] = _Recorded(path, record.info)
            elif record.event in ("accepted", "rejected") and record.action in actions:
                actions[record.action].add(position, record)
    if not actions:
        raise RecordingError(f"{path} has no servers: is it a recording of fibaction?")
    servers: list[ActionServer[Any, Any, Any]] = []
    for goals in actions.values():
        replay = _Replay(goals, speed)
        action = _action_of(goals.info)
        servers.append(ActionServer(action, replay.execute, on_goal=replay.on_goal))
    return servers
