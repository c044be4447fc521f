"""The file of a recording, which a kill cannot spoil, and its export as an MCAP file.

The file has JSON objects, one on a line. The first line of each server describes its action with
its JSON Schemas (`server`). Each line after that is an event of a goal: `accepted` or `rejected`
with the goal, `status`, `feedback`, `end` with the result, and `left`. The lines are read one by
one, so a file may be larger than the memory.

`export_mcap` is for Foxglove and other viewers. It needs mcap, which
`pip install "fibaction[mcap]"` installs. Each action has the topics `goal`, `status`, `feedback`,
`result` and `cancel` below its name, with JSON messages and their JSON Schemas: what an event says
about its goal, and below `data` the goal, the feedback or the result itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Literal, TypeAlias

import msgspec

from fibaction.schema.payload import GoalCodec, JsonCodec, PayloadError
from fibaction.types.action import ActionInfo
from fibaction.words.extras import NeedsExtra

if TYPE_CHECKING:
    from mcap.writer import Writer


__all__ = ["Event", "Record", "RecordingError", "export_mcap", "payload_of", "read_records"]

Event: TypeAlias = Literal[
    "server", "accepted", "rejected", "status", "feedback", "cancel", "end", "left", "dropped"
]
"""The kind of a line."""


Number: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
"""A number that every program can work with; another one makes a line unreadable."""


class RecordingError(ValueError):
    """An error for a file that is not a recording."""


class Record(msgspec.Struct, omit_defaults=True):
    """One line of a recording."""

    time: Number
    """The time of the event: nanoseconds since 1970."""
    event: Event
    action: str
    goal_id: str = ""
    """The ID of the goal; empty if the event is not about one goal."""
    status: str = ""
    """The status of a goal, or the answer to a cancel."""
    number: Number = 0
    """The number of a feedback message, or of the messages that were dropped."""
    attempt: Number = 1
    client: str = ""
    """The client that sent the goal, for people to read."""
    parent: str = ""
    """The ID of the goal whose executor has sent this one, in the line of its acceptance or its
    rejection; empty if there is none."""
    step: str = ""
    """The name of the step that the goal is of its parent."""
    reason: str = ""
    data: Any = msgspec.UNSET
    """The goal, the feedback or the result as JSON data, with bytes as base64 text."""
    raw: bytes = b""
    """The payload, if JSON cannot express what it holds."""
    info: ActionInfo | None = None
    """The description of the action, in the line of a server."""


_decoder = msgspec.json.Decoder(Record)


def record_of(line: bytes) -> Record | None:
    """Return the record in a line; None if the line was cut off by a kill or a full disk."""
    try:
        return _decoder.decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def read_records(path: str | Path) -> Iterator[Record]:
    """Yield the records of a recording, without lines that were cut off.

    Raises:
        OSError: The file cannot be read.
    """
    with open(path, "rb") as file:
        for _, record in numbered_records(file):
            yield record


def numbered_records(file: BinaryIO) -> Iterator[tuple[int, Record]]:
    """Yield the records from the current position on, each with its position in the file."""
    position = file.tell()
    for line in file:
        record = record_of(line)
        if record is not None:
            yield position, record
        position += len(line)


def payload_of(record: Record, schema: Mapping[str, Any]) -> bytes | None:
    """Return the payload of a goal, of feedback or of a result by its schema; None if it has none.

    Raises:
        PayloadError: The data does not match the schema.
    """
    if record.data is msgspec.UNSET:
        return record.raw or None
    try:
        codec = GoalCodec if record.event in ("accepted", "rejected") else JsonCodec
        return codec(schema).encode(record.data)
    except PayloadError as exc:
        what = f"{record.event} of goal {record.goal_id} in the recording"
        raise PayloadError(f"{what}: {exc}") from exc


TOPICS: dict[Event, str] = {
    "accepted": "goal",
    "rejected": "goal",
    "status": "status",
    "left": "status",
    "feedback": "feedback",
    "end": "result",
    "cancel": "cancel",
}
"""The topic of each event, below the name of the action."""

_TEXT = {"type": "string"}
_COUNT = {"type": "integer"}
_ABOUT: dict[str, Any] = {
    "goal_id": _TEXT,
    "status": _TEXT,
    "attempt": _COUNT,
    "number": _COUNT,
    "client": _TEXT,
    "parent": _TEXT,
    "step": _TEXT,
    "reason": _TEXT,
}

_encode = msgspec.json.encode


def export_mcap(recording: str | Path, path: str | Path) -> int:
    """Write a recording as an MCAP file, and return the number of messages.

    The time of a message is that of its event. Lines that a kill has cut off are left out. A
    message whose payload JSON cannot express has no `data`.

    Raises:
        MissingExtra: mcap is not installed.
        OSError: The recording cannot be read, or the file cannot be written.
        RecordingError: There are no servers in the file.
    """
    with NeedsExtra("an MCAP file", "fibaction[mcap]"):
        from mcap.writer import Writer
    count = 0
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(library="fibaction")
        channels = _Channels(writer)
        for record in read_records(recording):
            if record.event == "server" and record.info is not None:
                channels.add(record.info)
            elif (channel := channels.of(record)) is not None:
                count += 1
                writer.add_message(channel, record.time, _message(record), record.time)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap has no type for it
    if not channels.has_actions:
        Path(path).unlink()
        raise RecordingError(f"{recording} has no servers: is it a recording of fibaction?")
    return count


class _Channels:
    """The channels of the actions of a recording."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._ids: dict[tuple[str, str], int] = {}

    @property
    def has_actions(self) -> bool:
        return bool(self._ids)

    def add(self, info: ActionInfo) -> None:
        """Make the channels of an action, unless it has some."""
        if (info.name, "goal") in self._ids:
            return
        schemas = {"goal": info.goal, "feedback": info.feedback, "result": info.result}
        for topic in dict.fromkeys(TOPICS.values()):
            name = f"{info.name.strip('/')}/{topic}"
            schema = self._writer.register_schema(
                name.replace("/", "."), "jsonschema", _encode(_schema(schemas.get(topic)))
            )
            channel = self._writer.register_channel(f"/{name}", "json", schema)
            self._ids[info.name, topic] = channel

    def of(self, record: Record) -> int | None:
        """Return the channel of an event; None if it belongs to none."""
        return self._ids.get((record.action, TOPICS.get(record.event, "")))


def _schema(data: dict[str, Any] | None) -> dict[str, Any]:
    """Return the schema of a topic, whose messages have such data."""
    properties = dict(_ABOUT)
    schema: dict[str, Any] = {"type": "object", "properties": properties}
    if data is not None:
        properties["data"] = {name: value for name, value in data.items() if name != "$defs"}
        schema["$defs"] = data.get("$defs", {})
    return schema


def _message(record: Record) -> bytes:
    """Return an event as JSON; viewers want all members in each message."""
    members: dict[str, Any] = {name: getattr(record, name) for name in _ABOUT}
    if record.data is not msgspec.UNSET:
        members["data"] = record.data
    return _encode(members)
