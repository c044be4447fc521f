"""`export_mcap`: a recording as an MCAP file, for Foxglove and other viewers.

It needs mcap, which `pip install "fibaction[mcap]"` installs. Each action has the topics `goal`,
`status`, `feedback`, `result` and `cancel` below its name, with JSON messages and their JSON
Schemas: what an event says about its goal, and below `data` the goal, the feedback or the result
itself. The recording is read and written message by message, so it may be larger than the memory.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from fibaction.observe.recordings.recording_file import Event, Record, RecordingError, read_records
from fibaction.types.action import ActionInfo
from fibaction.words.extras import NeedsExtra

if TYPE_CHECKING:
    from mcap.writer import Writer

__all__ = ["export_mcap"]

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
