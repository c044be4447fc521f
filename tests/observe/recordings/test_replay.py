"""`replayed`: servers that answer from a recording."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any, TypeAlias

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalRejected,
    GoalStatus,
)
from fibaction.observe.recordings.recorder import Recorder
from fibaction.observe.recordings.recording_file import Record
from fibaction.observe.recordings.replay import CUT_OFF, NOT_RECORDED, RecordingError, replayed
from tests.support.virtual_time import in_virtual_time

pytestmark = pytest.mark.anyio


class Drive(msgspec.Struct, omit_defaults=True):
    meters: int
    map: bytes = b"\0\1"


DRIVE = Action("drive", goal=Drive, feedback=int, result=str)
Client: TypeAlias = ActionClient[Drive, int, str]


async def drive(goal: GoalHandle[Drive]) -> AsyncGenerator[int | str, None]:
    for meters in range(goal.request.meters):
        yield meters
        await anyio.sleep(0.01)
    if goal.request.meters == 2:
        raise GoalAborted("a wall", result="almost")
    if goal.request.meters == 3:
        await anyio.sleep_forever()
    yield "there"


def on_goal(goal: Drive) -> None:
    if goal.meters < 0:
        raise GoalRejected("not backwards")


@pytest.fixture
async def recording(tmp_path: Path) -> Path:
    """Return a recording of five goals."""
    path = tmp_path / "recording.jsonl"
    with Recorder(path) as recorder:
        async with ActionServer(DRIVE, drive, on_goal=on_goal, watchers=[recorder]) as server:
            client = ActionClient(server, DRIVE)
            other = await client.send_goal(Drive(3))
            await anext(other.feedback)
            for meters in (1, 2, -1):
                try:
                    await client.call(Drive(meters))
                except (GoalAborted, GoalRejected):
                    continue
            await other.cancel()
            await other.outcome()
    return path


async def outcome_of(client: Client, goal: Drive) -> tuple[Any, ...]:
    sent = await client.send_goal(goal)
    feedback = [item async for item in sent.feedback]
    outcome = await sent.outcome()
    return feedback, outcome.status, outcome.result, outcome.reason


@pytest.mark.parametrize("anyio_backend", ["asyncio", "trio"])
async def test_goals_end_as_in_the_recording_and_others_are_rejected(recording: Path) -> None:
    (server,) = replayed(recording, speed=1000)
    async with server:
        assert server.info == DRIVE.info
        client = ActionClient(server, DRIVE)
        for _ in range(2):
            found = await outcome_of(client, Drive(1, map=b"\0\1"))
            assert found == ([0], GoalStatus.SUCCEEDED, "there", "")
        assert await outcome_of(client, Drive(2)) == (
            [0, 1],
            GoalStatus.ABORTED,
            "almost",
            "a wall",
        )
        feedback, status, _, reason = await outcome_of(client, Drive(3))
        assert (feedback[0], status) == (0, GoalStatus.ABORTED)
        assert reason == "it was canceled in the recording"
        with pytest.raises(GoalRejected, match="not backwards"):
            await client.send_goal(Drive(-1))
        with pytest.raises(GoalRejected, match=NOT_RECORDED):
            await client.send_goal(Drive(9))


def written(path: Path, *records: Record) -> Path:
    lines = [msgspec.json.encode(record) + b"\n" for record in records]
    path.write_bytes(b"".join(lines))
    return path


SECOND = 1_000_000_000
SERVER = Record(1, "server", "drive", info=DRIVE.info)


@in_virtual_time()
async def test_feedback_comes_at_its_recorded_times_divided_by_the_speed(tmp_path: Path) -> None:
    path = written(
        tmp_path / "recording.jsonl",
        SERVER,
        SERVER,
        Record(10 * SECOND, "accepted", "drive", "a", data={"meters": 1}),
        Record(11 * SECOND, "accepted", "drive", "b", data={"meters": 5}),
        Record(12 * SECOND, "feedback", "drive", "b", number=1, data=77),
        Record(25 * SECOND, "status", "drive", "a", status="EXECUTING"),  # which was told late
        Record(14 * SECOND, "feedback", "drive", "a", number=1, data=0),
        Record(30 * SECOND, "end", "drive", "a", status="SUCCEEDED", data="there"),
    )
    (server,) = replayed(path, speed=2)
    async with server:
        client = ActionClient(server, DRIVE)
        start = anyio.current_time()
        goal = await client.send_goal(Drive(1))
        assert await anext(goal.feedback) == 0
        assert anyio.current_time() - start == pytest.approx(2, abs=0.5)
        assert (await goal.outcome()).result == "there"
        assert anyio.current_time() - start == pytest.approx(10, abs=0.5)


@pytest.mark.parametrize("anyio_backend", ["asyncio", "trio"])
async def test_goals_that_cannot_be_compared_by_their_data_are_compared_by_their_bytes(
    tmp_path: Path,
) -> None:
    anything = Action("drive", goal=msgspec.Raw, feedback=int, result=str)
    path = written(
        tmp_path / "recording.jsonl",
        SERVER,
        Record(1, "rejected", "drive", "a", reason="not text", data={"meters": "x"}),
        Record(2, "accepted", "drive", "b", raw=b"\xc1"),
        Record(3, "accepted", "other", "c", data=1),
    )
    (server,) = replayed(path)
    async with server:
        client = ActionClient(server, anything)
        with pytest.raises(GoalRejected, match=NOT_RECORDED):
            await client.send_goal(msgspec.Raw(msgspec.msgpack.encode({"meters": "y"})))
        goal = await client.send_goal(msgspec.Raw(b"\xc1"))
        outcome = await goal.outcome()

    assert (outcome.status, outcome.reason) == (GoalStatus.ABORTED, CUT_OFF)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_the_recording_and_not_the_schema_decides_on_a_goal_of_a_client_without_types(
    tmp_path: Path,
) -> None:
    path = written(
        tmp_path / "recording.jsonl",
        SERVER,
        Record(1, "rejected", "drive", "a", reason="too far", data={"metres": 1}),
    )
    (server,) = replayed(path)
    async with server:
        client = ActionClient(server, Action.untyped(DRIVE.info))
        with pytest.raises(GoalRejected, match="too far"):
            await client.send_goal({"metres": 1})


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_goal_with_a_number_that_no_client_can_send_is_no_error(tmp_path: Path) -> None:
    absurd = Record(1, "accepted", "drive", "a", data={"meters": 0})
    path = written(
        tmp_path / "recording.jsonl",
        SERVER,
        absurd,
        Record(2, "accepted", "drive", "b", data={"meters": 1}),
        Record(3, "end", "drive", "b", status="SUCCEEDED", data="there"),
    )
    path.write_bytes(path.read_bytes().replace(b'"meters":0', b'"meters":' + b"9" * 30))
    (server,) = replayed(path, speed=1000)
    async with server:
        assert (await outcome_of(ActionClient(server, DRIVE), Drive(1)))[2] == "there"


async def test_a_file_without_servers_and_a_wrong_speed_are_errors(tmp_path: Path) -> None:
    path = written(tmp_path / "recording.jsonl")

    with pytest.raises(RecordingError, match="has no servers: is it a recording of fibaction"):
        replayed(path)
    for speed in (0, -1, float("nan")):
        with pytest.raises(ValueError, match=r"^speed must be a positive number, not "):
            replayed(path, speed=speed)
