"""The client of the SDK whose connection is cut in the middle of a task, again and again."""

from __future__ import annotations

from contextlib import suppress

import anyio
import pytest
from a2a.client.errors import A2AClientError
from a2a.types import StreamResponse
from a2a.utils.errors import InvalidParamsError, UnsupportedOperationError

from tests.support.processes import PATIENCE
from tests.transports.a2a.agent_talk import Talk, robot_and_talk, talking, told
from tests.transports.proxy import Line, line_to

pytestmark = pytest.mark.asyncio
CUTS = 20
METERS = 500
WHOLE = [
    *(f"{meter}: {{'meters': {meter}.0}}" for meter in range(1, METERS + 1)),
    f"result {{'at': {METERS}.0}}",
    "COMPLETED",
]


def event_id_of(update: StreamResponse) -> str | None:
    """Return the position of an update, if it has one."""
    metadata = update.status_update.metadata or update.artifact_update.metadata
    return str(metadata["event_id"]) if "event_id" in metadata else None


class CutClient:
    """A client that reads a task, and comes back with the position of what it has seen."""

    def __init__(self, talk: Talk, line: Line, task_id: str) -> None:
        self._talk = talk
        self._line = line
        self._task_id = task_id
        self._after = "0"
        self.seen: list[str] = []
        self.cuts = 0

    async def read(self, most: int | None = None) -> None:
        """Read so many updates that have a position, then lose the connection, and with it all that
        is under way; without a number, read to the end.
        """
        updates = self._talk.subscribe(self._task_id, self._after)
        read = 0
        async for update in updates:
            if not update.HasField("task"):
                self._note(update)
                read += "event_id" in update.status_update.metadata
            if read == most:
                self._line.cut()
                self.cuts += 1
                break
        with suppress(A2AClientError):
            await updates.aclose()  # type: ignore[attr-defined]  # it is a generator

    def _note(self, update: StreamResponse) -> None:
        text = told(update)
        if text != "WORKING":
            self.seen.append(text)
        self._after = event_id_of(update) or self._after


@pytest.mark.parametrize("ahead", [True, False])
async def test_a_client_that_is_cut_twenty_times_loses_and_repeats_nothing(ahead: bool) -> None:
    """The robot is ahead of the client, or goes on while the client is away."""
    async with (
        robot_and_talk() as (robot, talk),
        line_to(talk.url.rstrip("/")) as line,
        talking(f"{line.url}/") as far,
    ):
        task = await talk.send({"meters": METERS}, skill="arm-drive", at_once=True)
        client = CutClient(far, line, task.id)
        if ahead:
            robot.go(METERS)
        with anyio.fail_after(PATIENCE):
            for _ in range(CUTS):
                if not ahead:
                    robot.go(METERS // CUTS)
                await client.read(METERS // CUTS - 5)
            await client.read()
        assert client.seen == WHOLE
        assert client.cuts == CUTS


async def test_a_task_is_read_from_its_beginning_without_a_position() -> None:
    async with robot_and_talk() as (robot, talk):
        task = await talk.send({"meters": 100}, skill="arm-drive", at_once=True)
        robot.go(2)
        one = talk.subscribe(task.id)
        while told(await anext(one)) != "2: {'meters': 2.0}":
            pass
        two = [told(await anext(updates)) for updates in [talk.subscribe(task.id)] for _ in "abc"]
        assert two == ["task WORKING", "1: {'meters': 1.0}", "2: {'meters': 2.0}"]
        three = talk.subscribe(task.id, "1")
        assert [told(await anext(three)) for _ in "ab"] == ["task WORKING", "2: {'meters': 2.0}"]
        robot.go(98)
        assert [told(update) async for update in three][-1] == "COMPLETED"


async def test_what_was_missed_at_the_end_is_read_with_a_position() -> None:
    async with robot_and_talk() as (_, talk):
        task = await talk.send({"meters": 3}, skill="arm-drive")
        end = ["result {'at': 3.0}", "COMPLETED"]
        third = [told(update) async for update in talk.subscribe(task.id, "2")]
        assert third == ["task COMPLETED", "3: {'meters': 3.0}", *end]
        last = [told(update) async for update in talk.subscribe(task.id, "result")]
        assert last == ["task COMPLETED", "COMPLETED"]
        with pytest.raises(UnsupportedOperationError, match="Last-Event-ID, with 0 for all"):
            [update async for update in talk.subscribe(task.id)]
        with pytest.raises(InvalidParamsError, match="such as 17, not 'x'"):
            [update async for update in talk.subscribe(task.id, "x")]
