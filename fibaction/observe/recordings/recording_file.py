"""The file of a recording: JSON objects, one on a line, which a kill cannot spoil.

The first line of each server describes its action with its JSON Schemas (`server`). Each line after
that is an event of a goal: `accepted` or `rejected` with the goal, `status`, `feedback`, `end` with
the result, and `left`. The lines are read one by one, so a file may be larger than the memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, TypeAlias

import msgspec

from fibaction.schema.payload import GoalCodec, JsonCodec, PayloadError
from fibaction.types.action import ActionInfo

__all__ = ["Event", "Record", "RecordingError", "payload_of", "read_records"]

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
