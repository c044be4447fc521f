"""`Recorder`: what is in the file, also after a kill and on a disk that is full or slow."""

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    GoalID,
    GoalInfo,
    GoalRejected,
    GoalStatus,
)
from fibaction.border.abc import FeedbackItem
from fibaction.observe.recordings import recorder
from fibaction.observe.recordings.recorder import Recorder
from fibaction.observe.recordings.recording_file import read_records
from tests.server.held import waits
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci

pytestmark = pytest.mark.anyio

GOAL_ID = GoalID(bytes(16))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "recording.jsonl"


def not_seven(goal: Goal) -> None:
    if goal.order == 7:
        raise GoalRejected("not seven")


async def test_a_recording_has_every_event_of_each_goal(path: Path) -> None:
    with Recorder(path) as recording:
        options: Any = {"on_goal": not_seven, "watchers": [recording]}
        async with ActionServer(FIBONACCI, fibonacci, **options) as server:
            client = ActionClient(server, FIBONACCI)
            goal = await client.send_goal(Goal(3))
            await goal.outcome()
            with pytest.raises(GoalRejected):
                await client.send_goal(Goal(7))
            await goal.cancel()

    records = list(read_records(path))
    assert [record.time for record in records] == sorted(record.time for record in records)
    assert records[0].info == FIBONACCI.info
    assert {record.goal_id for record in records[1:6]} == {str(goal.goal_id)}
    assert [(one.event, one.status, one.number, one.data) for one in records[1:]] == [
        ("accepted", "ACCEPTED", 0, {"order": 3}),
        ("status", "EXECUTING", 0, msgspec.UNSET),
        ("feedback", "", 1, {"partial_sequence": [0, 1, 1]}),
        ("feedback", "", 2, {"partial_sequence": [0, 1, 1, 2]}),
        ("end", "SUCCEEDED", 0, {"sequence": [0, 1, 1, 2]}),
        ("rejected", "", 0, {"order": 7}),
        ("cancel", "GOAL_TERMINATED", 0, msgspec.UNSET),
    ]
    assert records[6].reason == "not seven"


async def test_a_recording_has_an_end_without_a_result_and_its_reason(path: Path) -> None:
    with Recorder(path) as recording:
        async with ActionServer(FIBONACCI, waits, watchers=[recording]) as server:
            await anext((await ActionClient(server, FIBONACCI).send_goal(Goal(1))).feedback)

    end = list(read_records(path))[-1]
    assert (end.event, end.status, end.reason) == ("end", "ABORTED", "server stopped")
    assert end.data is msgspec.UNSET


def feedback(number: int, payload: bytes = b"\x01") -> FeedbackItem:
    return FeedbackItem(number, payload)


def test_a_recording_is_appended_to_behind_a_line_that_was_cut_off(path: Path) -> None:
    with Recorder(path) as recording:
        recording.feedback("count", GOAL_ID, feedback(1))
        recording.feedback("count", GOAL_ID, feedback(2))
    os.truncate(path, path.stat().st_size - 9)
    with Recorder(path) as recording:
        recording.left("count", GoalInfo(GOAL_ID, 1, GoalStatus.EXECUTING), "it is kept")

    assert [(one.event, one.number) for one in read_records(path)] == [("feedback", 1), ("left", 0)]


def test_a_recording_that_was_closed_is_appended_to_without_a_line_between(path: Path) -> None:
    for number in (1, 2):
        with Recorder(path) as recording:
            recording.feedback("count", GOAL_ID, feedback(number))

    assert [one.number for one in read_records(path)] == [1, 2]
    assert path.read_bytes().count(b"\n") == 2


def test_payloads_that_json_cannot_express_are_kept_as_they_are(path: Path) -> None:
    extension, broken = msgspec.msgpack.encode(msgspec.msgpack.Ext(5, b"x")), b"\xc1"
    keyed = msgspec.msgpack.encode({(1, 2): 3})
    with Recorder(path) as recording:
        for number, payload in enumerate((extension, broken, keyed), 1):
            recording.feedback("count", GOAL_ID, feedback(number, payload))

    records = list(read_records(path))
    assert records[0].data == {"ext": 5, "data": "eA=="}
    assert [one.raw for one in records[1:]] == [broken, keyed]
    with pytest.raises(TypeError, match="JSON has no object"):
        msgspec.json.encode(object(), enc_hook=recorder._without_extension)


def test_feedback_that_comes_faster_than_the_disk_is_dropped_counted_and_logged_once(
    path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "FLUSH", 3600)
    with Recorder(path, max_bytes=2000) as recording:
        for number in range(1, 11):
            recording.feedback("count", GOAL_ID, feedback(number, b"\xc4\xc8" + bytes(200)))
        recording.left("count", GoalInfo(GOAL_ID, 1, GoalStatus.EXECUTING), "it is kept")

    records = list(read_records(path))
    assert [one.number for one in records if one.event == "feedback"] == [1, 2, 3]
    assert [one.number for one in records if one.event == "dropped"] == [7]
    assert records[3].event == "left"
    assert recording.dropped == 7
    (line,) = caplog.records
    assert line.getMessage().endswith("some feedback is left out of the recording")


class FullDisk:
    """A file that takes 10 bytes, and a part of a write first."""

    def __init__(self) -> None:
        self.left = 10
        self.is_closed = False

    def write(self, data: memoryview) -> int:
        if not self.left:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken, self.left = self.left, 0
        return taken

    def __enter__(self) -> FullDisk:
        return self

    def __exit__(self, *_: object) -> None:
        self.is_closed = True


async def test_a_full_disk_ends_the_recording_with_one_line_in_the_log_and_goals_go_on(
    path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = FullDisk()
    monkeypatch.setattr(recorder, "_opened", lambda _: disk)
    monkeypatch.setattr(recorder, "FLUSH", 0.001)
    with Recorder(path) as recording:
        async with ActionServer(FIBONACCI, fibonacci, watchers=[recording]) as server:
            client = ActionClient(server, FIBONACCI)
            while recording.error is None:
                await client.call(Goal(3))
            assert await client.call(Goal(3)) == Result([0, 1, 1, 2])

    assert disk.is_closed
    (line,) = (one for one in caplog.records if one.levelno >= logging.WARNING)
    assert line.getMessage() == (
        f"the recording {path} ends here, and goals continue: it cannot be written to: No space"
        " left on device"
    )


def test_a_file_that_cannot_be_opened_is_an_error_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Recorder(tmp_path / "missing" / "recording.jsonl")


async def test_the_parent_and_the_step_of_a_goal_are_recorded_once(path: Path) -> None:
    parent, payload = GoalID(bytes([7]) * 16), FIBONACCI.goal.encode
    meta = {"parent": str(parent), "step": "count"}
    with Recorder(path) as recording:
        options: Any = {"on_goal": not_seven, "watchers": [recording]}
        async with ActionServer(FIBONACCI, fibonacci, **options) as server:
            stream = await server.send_goal(GoalID.random(), payload(Goal(1)), meta=meta)
            await stream.outcome()
            with pytest.raises(GoalRejected):
                await server.send_goal(GoalID.random(), payload(Goal(7)), meta=meta)
            await ActionClient(server, FIBONACCI).call(Goal(1))

    named = [(one.event, one.parent, one.step) for one in read_records(path) if one.parent]
    assert named == [(event, str(parent), "count") for event in ("accepted", "rejected")]


def test_feedback_that_has_not_reached_the_recorder_is_counted_in_the_recording(
    path: Path,
) -> None:
    with Recorder(path) as recording:
        recording.add_dropped(3)

    assert recording.dropped == 3
    assert [(one.event, one.number) for one in read_records(path)] == [("dropped", 3)]
