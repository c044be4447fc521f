"""`fibaction.client.events`: all that happens to the goals of one action."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    ConnectionLost,
    Events,
    GoalFeedback,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalStatus,
    ProtocolError,
    UnknownGoal,
)
from fibaction.border.abc import GoalStream, StatusStream
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.words.errors import ActionError
from fibaction.words.goals import UNKNOWN_OUTCOME, UNKNOWN_SENDER
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

pytestmark = pytest.mark.asyncio

Event = GoalInfo | GoalFeedback[Feedback]
ENDED = Result([])


def told(event: Event) -> object:
    """An event in short: the status, or the number of the feedback."""
    return event.status.name if isinstance(event, GoalInfo) else event.number


class Gate:
    """An executor that begins when a test lets it."""

    def __init__(self) -> None:
        self.open = anyio.Event()

    async def work(self, goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        await self.open.wait()
        async for item in fibonacci(goal):
            yield item


async def until(events: Events[Feedback], last: GoalStatus = GoalStatus.SUCCEEDED) -> list[Event]:
    seen: list[Event] = []
    async for event in events:
        seen.append(event)
        if isinstance(event, GoalInfo) and event.status is last:
            break
    return seen


async def test_a_goal_is_told_from_its_acceptance_to_its_end_feedback_first() -> None:
    gate = Gate()
    with anyio.fail_after(5):
        async with ActionServer(FIBONACCI, gate.work) as server:
            client = ActionClient(server, FIBONACCI)
            async with client.events() as events:
                await client.send_goal(Goal(4))
                seen = await until(events, GoalStatus.EXECUTING)
                gate.open.set()
                seen += await until(events)
    assert [told(event) for event in seen] == ["ACCEPTED", "EXECUTING", 1, 2, 3, "SUCCEEDED"]
    assert [event.feedback.partial_sequence for event in seen if isinstance(event, GoalFeedback)]
    assert len({event.goal_id for event in seen}) == 1


async def test_goals_that_there_are_come_first_and_their_feedback_from_now_on() -> None:
    held, release = anyio.Event(), anyio.Event()

    async def work(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        yield Feedback([1])
        yield Feedback([2])
        held.set()
        await release.wait()
        yield Feedback([3])
        yield ENDED

    with anyio.fail_after(5):
        async with ActionServer(FIBONACCI, work) as server:
            client = ActionClient(server, FIBONACCI)
            await client.send_goal(Goal(1))
            await held.wait()
            async with client.events() as events:
                first = await anext(events)
                assert isinstance(first, GoalInfo)
                assert (first.status, first.feedback_count) == (GoalStatus.EXECUTING, 2)
                release.set()
                seen = await until(events)
    assert [told(event) for event in seen] == [3, "SUCCEEDED"]


# When something goes wrong behind it


class Statuses(StatusStream):
    """Statuses that a test tells, and then what comes after them."""

    def __init__(self, *infos: GoalInfo, error: Exception | None = None, known: int = 0) -> None:
        self._infos = list(infos)
        self._error = error
        self.known = known

    @property
    def dropped(self) -> int:
        return 7

    def fail(self, error: ActionError) -> None:
        raise NotImplementedError

    async def receive(self) -> GoalInfo | None:
        await anyio.lowlevel.checkpoint()
        if self._infos:
            return self._infos.pop(0)
        if self._error is not None:
            raise self._error
        return None

    def close(self) -> None:
        pass


class Watched(ActionServer[Goal, Feedback, Result]):
    """A server whose streams are a test's."""

    def __init__(self, statuses: Statuses, error: Exception | None = None) -> None:
        super().__init__(FIBONACCI, fibonacci)
        self._told = statuses
        self._error = error
        self.asked: list[int | None] = []

    async def status(self) -> StatusStream:  # type: ignore[override]  # any will do here
        return self._told

    async def feedback(  # type: ignore[override]  # as above
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False, attempt: int = 1
    ) -> GoalStream:
        self.asked.append(after)
        assert self._error is not None
        raise self._error


ONE = GoalID(bytes(range(16)))


async def events_over(server: Watched) -> list[object]:
    seen: list[object] = []
    with anyio.fail_after(5):
        async with ActionClient(server, FIBONACCI).events() as events:
            seen += [told(event) async for event in events]
            assert events.dropped == 7
    return seen


async def test_a_goal_whose_feedback_is_over_before_its_end_is_not_followed_again() -> None:
    statuses = (GoalStatus.EXECUTING, GoalStatus.CANCELING, GoalStatus.CANCELED)
    server = Watched(Statuses(*(GoalInfo(ONE, 1, status) for status in statuses)), UnknownGoal(ONE))
    assert await events_over(server) == ["EXECUTING", "CANCELING", "CANCELED"]
    assert server.asked == [0]


async def test_a_new_goal_is_followed_from_its_beginning_and_a_known_one_from_now_on() -> None:
    other = GoalID(bytes(range(16, 32)))
    infos = [GoalInfo(ONE, 1, GoalStatus.EXECUTING), GoalInfo(other, 2, GoalStatus.ACCEPTED)]
    server = Watched(Statuses(*infos, known=1), UnknownGoal(ONE))
    await events_over(server)
    assert server.asked == [None, 0]


async def test_feedback_says_which_attempt_it_is_of() -> None:
    record = GoalRecord(ONE, b"", 1, UNKNOWN_SENDER)
    record.attempt = 2
    log = FeedbackLog(record)

    class Kept(Watched):
        async def feedback(  # type: ignore[override]  # as above
            self, goal_id: GoalID, **_: Any
        ) -> GoalStream:
            return log.follow(after=0)

    log.append(FIBONACCI.feedback.encode(Feedback([1])))
    record.outcome = UNKNOWN_OUTCOME
    log.finish()
    server = Kept(Statuses(GoalInfo(ONE, 1, GoalStatus.EXECUTING)))
    async with ActionClient(server, FIBONACCI).events() as events:
        seen = [event async for event in events]
    (item,) = log.after(0, 1)
    assert seen[1:] == [GoalFeedback(ONE, 1, Feedback([1]), 2, item.at)]


@pytest.mark.parametrize(
    "server",
    [
        Watched(Statuses(error=ConnectionLost("the line broke"))),
        Watched(Statuses(GoalInfo(ONE, 1, GoalStatus.EXECUTING)), ConnectionLost("the line broke")),
    ],
    ids=["of statuses", "of feedback"],
)
async def test_a_lost_connection_is_raised_where_the_events_are_read(server: Watched) -> None:
    with pytest.raises(ConnectionLost, match="the line broke"):
        await events_over(server)


async def test_feedback_of_another_type_is_raised_where_the_events_are_read() -> None:
    other = Action("fibonacci", goal=Goal, feedback=str, result=Result)
    gate = anyio.Event()

    async def work(goal: GoalHandle[Goal]) -> AsyncGenerator[str | Result, None]:
        await gate.wait()
        yield "no numbers"
        yield ENDED

    with anyio.fail_after(5):
        async with ActionServer(other, work) as server:
            client = ActionClient(server, FIBONACCI)
            async with client.events() as events:
                await client.send_goal(Goal(1))
                await until(events, GoalStatus.EXECUTING)
                gate.set()
                text = "^feedback of action 'fibonacci' is not of its type, as its server sent it: "
                with pytest.raises(ProtocolError, match=text):
                    await until(events)


async def test_events_whose_block_is_left_end_for_a_reader_that_waits_and_for_a_later_one() -> None:
    async with ActionServer(FIBONACCI, fibonacci) as server:
        client = ActionClient(server, FIBONACCI)
        seen: list[list[Event]] = []

        async def watch(events: Events[Feedback]) -> None:
            seen.append([event async for event in events])

        with anyio.fail_after(5):
            async with anyio.create_task_group() as tasks:
                async with client.events() as events:
                    tasks.start_soon(watch, events)
                    await anyio.wait_all_tasks_blocked()
            await client.send_goal(Goal(1))
            await watch(events)
    assert seen == [[], []]
