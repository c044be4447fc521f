"""`record_from`: what a client sees of a server's goals is in its recording."""

from __future__ import annotations

import errno
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import anyio
import anyio.lowlevel
import pytest
from anyio.abc import TaskGroup

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    ClientConnection,
    GoalHandle,
    GoalStatus,
    connect,
    serve,
)
from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalStream
from fibaction.observe.recordings import recorder as recorders
from fibaction.observe.recordings.recorder import Recorder, record_from
from fibaction.observe.recordings.recording_file import Record, read_records
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ConnectionLost, TransportError, UnknownGoal
from fibaction.words.goals import GoalID
from tests.cli.served import Served, counter, look_often
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result

pytestmark = pytest.mark.anyio

URL = "inproc://robot"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "recording.jsonl"


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorder looks for new actions, and for its end, at once."""
    look_often(monkeypatch)
    monkeypatch.setattr(recorders, "RETRY_PAUSE", 0.01)


class Gated:
    """An executor that waits after its feedback, until it may continue."""

    def __init__(self) -> None:
        self.go_on = anyio.Event()

    async def __call__(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        for number in range(goal.request.order):
            yield Feedback([number])
        await self.go_on.wait()
        yield Result([goal.request.order])


class Lines:
    """The records of a file that is being written."""

    def __init__(self, path: Path) -> None:
        self.path = path

    async def until(
        self, event: str, goal_id: GoalID | None = None, count: int = 1
    ) -> list[Record]:
        """Wait until so many records of that event are written, and return all."""
        wanted = "" if goal_id is None else str(goal_id)
        with anyio.fail_after(30):
            while True:
                records = list(read_records(self.path)) if self.path.exists() else []
                found = [one for one in records if one.event == event and wanted in one.goal_id]
                if len(found) >= count:
                    return records
                await anyio.sleep(0.01)  # the thread of the recorder notifies nobody


class Robot(NamedTuple):
    """A server, a client that sends it goals, and what records it from outside."""

    gated: Gated
    client: ActionClient[Goal, Feedback, Result]
    observer: ClientConnection
    recorder: Recorder
    lines: Lines
    tasks: TaskGroup

    def record(self) -> None:
        """Begin to record."""
        self.tasks.start_soon(record_from, self.observer, self.recorder)


RunRobot: TypeAlias = "Callable[..., AbstractAsyncContextManager[Robot]]"


@pytest.fixture
def robot(path: Path) -> RunRobot:
    """Runs a robot for a block; `wrap` makes the endpoint that is served of its server."""

    @asynccontextmanager
    async def run(
        wrap: Callable[[ActionServer[Any, Any, Any]], Endpoint] = lambda server: server,
        **settings: Any,
    ) -> AsyncGenerator[Robot, None]:
        gated = Gated()
        async with (
            serve(wrap(ActionServer(FIBONACCI, gated, **settings)), URL),
            connect(URL) as observer,
            connect(URL, FIBONACCI) as client,
            anyio.create_task_group() as tasks,
        ):
            with Recorder(path) as recorder:
                yield Robot(gated, client, observer, recorder, Lines(path), tasks)
                tasks.cancel_scope.cancel()

    return run


def of(goal_id: GoalID, records: list[Record]) -> list[tuple[str, object]]:
    return [(one.event, one.number or one.status) for one in records if one.goal_id == str(goal_id)]


async def test_goals_of_other_clients_are_recorded_from_their_first_feedback_on(
    robot: RunRobot,
) -> None:
    async with robot() as one:
        before = await one.client.send_goal(Goal(2))
        await anext(before.feedback)
        await anext(before.feedback)
        begun_at = time.time_ns()
        one.record()
        await one.lines.until("accepted", before.goal_id)
        after = await one.client.send_goal(Goal(1))
        await one.lines.until("accepted", after.goal_id)
        one.gated.go_on.set()
        await one.lines.until("end", before.goal_id)
        records = await one.lines.until("end", after.goal_id)

    assert [one.event for one in records].count("server") == 1
    assert next(one.data for one in records if one.goal_id == str(before.goal_id)) == {"order": 2}
    for goal, count in ((before, 2), (after, 1)):
        found = of(goal.goal_id, records)
        feedback = [("feedback", number + 1) for number in range(count)]
        assert [one for one in found if one[0] == "feedback"] == feedback
        told = [one for one in records if one.goal_id == str(goal.goal_id)]
        times = [one.time for one in told if one.event in ("accepted", "feedback")]
        assert times == sorted(times)
        assert (times[-1] < begun_at) == (goal is before), "each at its time at the server"
        assert found[-1] == ("end", GoalStatus.SUCCEEDED.name)


async def test_a_goal_that_had_ended_before_is_left_out(robot: RunRobot) -> None:
    async with robot() as one:
        one.gated.go_on.set()
        ended = await one.client.send_goal(Goal(1))
        await ended.outcome()
        one.record()
        await one.lines.until("server")
        later = await one.client.send_goal(Goal(1))
        records = await one.lines.until("end")

    assert {one.goal_id for one in records} == {"", str(later.goal_id)}


class Losing(ForwardingEndpoint):
    """An endpoint that does not let goals be followed."""

    def __init__(self, wrapped: Any, error: Exception) -> None:
        super().__init__(wrapped)
        self.error = error

    async def feedback(self, goal_id: GoalID, **settings: Any) -> GoalStream:
        raise self.error


@pytest.mark.parametrize(
    ("error", "events"),
    [
        (UnknownGoal(GoalID(bytes(16))), ["server"]),
        (ConnectionLost("the line is cut"), ["server", "left"]),
    ],
)
async def test_a_goal_that_cannot_be_followed_is_said_to_be_left_unless_it_has_ended(
    error: Exception, events: list[str], robot: RunRobot, path: Path
) -> None:
    async with robot(lambda server: Losing(server, error)) as one:
        one.record()
        await one.lines.until("server")
        async with one.client.send_goal(Goal(1)):
            await anyio.wait_all_tasks_blocked()

    assert [one.event for one in read_records(path)] == events


async def test_goals_that_were_followed_are_forgotten_after_a_while(
    robot: RunRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorders, "REMEMBERED", 1)
    async with robot() as one:
        one.gated.go_on.set()
        one.record()
        await one.lines.until("server")
        for _ in range(3):
            goal = await one.client.send_goal(Goal(1))
            records = await one.lines.until("end", goal.goal_id)

    assert [one.event for one in records].count("end") == 3


async def ends_with_its_error(connection: ClientConnection, recorder: Recorder) -> None:
    """Record until the disk is full."""
    with pytest.raises(OSError, match="No space left"), anyio.fail_after(30):
        await record_from(connection, recorder)


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.usefixtures("soon")
async def test_a_full_disk_ends_the_recording_also_of_a_server_that_does_not_answer(
    path: Path,
) -> None:
    served = Served(counter("one"))
    with Recorder(path) as recorder:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(ends_with_its_error, served.connection, recorder)
            await anyio.wait_all_tasks_blocked()
            served.silent = True
            recorder.error = FULL


async def test_each_change_of_the_status_is_recorded(robot: RunRobot) -> None:
    async with robot(interrupt_on_cancel=False) as one:
        one.record()
        goal = await one.client.send_goal(Goal(1))
        await one.lines.until("accepted")
        await goal.cancel()
        await one.lines.until("status")
        one.gated.go_on.set()
        records = await one.lines.until("end")

    assert ("status", "CANCELING") in of(goal.goal_id, records)


@pytest.mark.usefixtures("soon")
async def test_a_server_that_starts_again_is_recorded_again_and_so_are_new_actions(
    path: Path,
) -> None:
    other = Action("other", goal=int, feedback=str, result=int)

    async def count(goal: GoalHandle[int]) -> AsyncGenerator[int, None]:
        yield goal.request

    gated = Gated()
    gated.go_on.set()
    async with connect(URL) as observer, anyio.create_task_group() as tasks:
        with Recorder(path) as recorder:
            async with serve(ActionServer(FIBONACCI, gated), URL):
                tasks.start_soon(record_from, observer, recorder)
                await Lines(path).until("server")
            servers: list[Any] = [ActionServer(FIBONACCI, gated), ActionServer(other, count)]
            async with serve(servers, URL):
                requests: list[tuple[Any, Any]] = [(FIBONACCI, Goal(1)), (other, 5)]
                for action, request in requests:
                    await Lines(path).until("server", count=3)
                    goal = await observer.client(action).send_goal(request)
                    records = await Lines(path).until("end", goal.goal_id)
            tasks.cancel_scope.cancel()
    assert sorted(one.action for one in records if one.event == "end") == ["fibonacci", "other"]


class WithoutTypes:
    """A connection whose actions cannot be used here."""

    def __init__(self) -> None:
        self.looks = 0

    async def actions(self) -> list[ActionInfo]:
        self.looks += 1
        return [FIBONACCI.info]

    def endpoint(self, info: ActionInfo) -> Endpoint:
        raise TransportError("the ROS type is not installed")


@pytest.mark.usefixtures("soon")
async def test_an_action_that_cannot_be_used_here_is_left_out(path: Path) -> None:
    connection: Any = WithoutTypes()
    with Recorder(path) as recorder:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(record_from, connection, recorder)
            while connection.looks < 3:
                await anyio.lowlevel.checkpoint()
            tasks.cancel_scope.cancel()
    assert list(read_records(path)) == []
