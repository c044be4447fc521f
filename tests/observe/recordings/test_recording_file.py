"""The lines of a recording, payloads from them, and what a reader of MCAP finds in an export."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import anyio
import jsonschema
import msgspec
import pytest
from mcap.reader import make_reader

from fibaction import Action, ActionServer, GoalHandle, GoalRejected, connect, serve
from fibaction.observe.recordings.recorder import Recorder
from fibaction.observe.recordings.recording_file import (
    Record,
    RecordingError,
    export_mcap,
    payload_of,
    read_records,
)
from fibaction.schema.payload import PayloadError
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci


def test_lines_that_are_not_records_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "recording.jsonl"
    good = msgspec.json.encode(Record(1, "left", "count"))
    path.write_bytes(b'{"time":1\n' + good + b"\n\xff\n" + b"[" * 5000 + b"\n\n" + good[:-1])

    assert list(read_records(path)) == [Record(1, "left", "count")]


@pytest.mark.parametrize("number", ["9" * 5000, str(10**30), str(2**63), "1e300", "-1"])
@pytest.mark.parametrize("field", ["time", "number", "attempt"])
def test_lines_with_impossible_numbers_are_left_out(
    tmp_path: Path, field: str, number: str
) -> None:
    path = tmp_path / "recording.jsonl"
    good = Record(1, "left", "count", number=1, attempt=2)
    line = msgspec.json.encode(good).decode()
    assert line.count(f'"{field}":') == 1
    broken = re.sub(f'"{field}":\\d+', f'"{field}":{number}', line)
    path.write_text(f"{broken}\n{line}\n")

    assert list(read_records(path)) == [good]


def test_the_payload_of_a_record_is_that_of_its_data_or_its_raw_bytes() -> None:
    goal = Record(1, "accepted", "fibonacci", data={"order": 3})

    assert payload_of(goal, FIBONACCI.info.goal) == FIBONACCI.goal.encode(Goal(3))
    assert payload_of(Record(1, "end", "fibonacci"), {}) is None
    assert payload_of(Record(1, "end", "fibonacci", raw=b"\xc1"), {}) == b"\xc1"


def test_data_of_another_type_is_an_error_that_names_the_goal() -> None:
    record = Record(1, "accepted", "fibonacci", "12ab", data={"order": "x"})

    with pytest.raises(PayloadError, match=r"^accepted of goal 12ab in the recording: goal\.order"):
        payload_of(record, FIBONACCI.info.goal)


LEVEL = Action("arm/level", goal=int, feedback=bytes, result=float)


async def measure(goal: GoalHandle[int]) -> AsyncGenerator[bytes | float, None]:
    yield b"\x00\xff"
    yield 1.5


class Message(msgspec.Struct):
    """A message of an MCAP file."""

    topic: str
    time: int
    schema: dict[str, Any]
    data: dict[str, Any]


def messages_in(path: Path) -> list[Message]:
    with open(path, "rb") as file:
        found = []
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert schema.name == channel.topic.strip("/").replace("/", ".")
            described, data = json.loads(schema.data), json.loads(message.data)
            found.append(Message(channel.topic, message.log_time, described, data))
        return found


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A recording of two servers."""

    def not_seven(goal: Goal) -> None:
        if goal.order == 7:
            raise GoalRejected("not seven")

    async def record(path: Path) -> None:
        servers: list[ActionServer[Any, Any, Any]] = [
            ActionServer(FIBONACCI, fibonacci, on_goal=not_seven),
            ActionServer(LEVEL, measure),
        ]
        with Recorder(path) as recorder:
            async with (
                serve(servers, "inproc://robot", watchers=[recorder]),
                connect("inproc://robot") as connection,
            ):
                fib, level = connection.client(FIBONACCI), connection.client(LEVEL)
                await fib.call(Goal(2))
                with pytest.raises(GoalRejected):
                    await fib.call(Goal(7))
                await level.call(3)
                await fib.cancel_goals()

    path = tmp_path / "recording.jsonl"
    anyio.run(record, path)
    return path


def test_each_event_is_a_message_that_matches_the_schema_of_its_topic(
    recording: Path, tmp_path: Path
) -> None:
    path = tmp_path / "recording.mcap"
    count = export_mcap(recording, path)
    messages = messages_in(path)

    assert len(messages) == count
    assert [message.time for message in messages] == sorted(one.time for one in messages)
    for message in messages:
        jsonschema.Draft202012Validator.check_schema(message.schema)
        jsonschema.validate(message.data, message.schema)
    found = [(one.topic, one.data.get("data"), one.data["status"]) for one in messages]
    assert ("/fibonacci/goal", {"order": 2}, "ACCEPTED") in found
    assert ("/fibonacci/goal", {"order": 7}, "") in found
    assert ("/fibonacci/feedback", {"partial_sequence": [0, 1, 1]}, "") in found
    assert ("/fibonacci/result", {"sequence": [0, 1, 1]}, "SUCCEEDED") in found
    assert ("/arm/level/goal", 3, "ACCEPTED") in found
    assert ("/arm/level/feedback", "AP8=", "") in found
    assert ("/arm/level/result", 1.5, "SUCCEEDED") in found
    assert "/fibonacci/cancel" in [message.topic for message in messages]


def test_a_recording_that_was_appended_to_has_each_topic_once(
    recording: Path, tmp_path: Path
) -> None:
    path = tmp_path / "recording.mcap"
    recording.write_bytes(2 * recording.read_bytes())
    export_mcap(recording, path)
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    topics = [channel.topic for channel in summary.channels.values()]
    assert sorted(topics) == sorted(set(topics))
    assert len(topics) == 10


def test_events_of_no_action_are_left_out(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    count = export_mcap(recording, path)
    with open(recording, "ab") as file:
        file.write(msgspec.json.encode(Record(1, "dropped", "", number=3)) + b"\n")
        file.write(msgspec.json.encode(Record(1, "accepted", "other", "a")) + b"\n")
    assert export_mcap(recording, path) == count


def test_a_file_that_is_not_a_recording_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("hello\n")
    with pytest.raises(RecordingError, match="text has no servers: is it a recording"):
        export_mcap(tmp_path / "text", tmp_path / "recording.mcap")
    assert not (tmp_path / "recording.mcap").exists()
