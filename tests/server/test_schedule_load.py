"""A thousand goals of twenty clients, under each kind of schedule, canceled at random moments.

The executor counts what runs, from its first line to the end of its clean-up, so the limits are
checked by nothing that the server itself counts.
"""

from __future__ import annotations

import math
from collections import Counter
from random import Random

import anyio
import pytest
from anyio.lowlevel import checkpoint

from fibaction import (
    ActionServer,
    CancelCode,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    Outcome,
    Schedule,
)
from fibaction.border.abc import GoalStream
from fibaction.words.goals import Sender
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.matching import End

pytestmark = pytest.mark.anyio

CLIENTS, GOALS = 20, 50
"""The clients, and the goals that each of them sends."""
PAUSES = (0, 2, 8, 20)
"""Turns of the event loop between two goals of a client."""
KEYS = 3
MOST_TURNS = 6
"""Turns of the event loop that an executor, its clean-up or a client takes at most."""


def key_of(goal: Goal) -> int:
    return goal.order % KEYS


def priority_of(goal: Goal) -> int:
    return goal.order * 7 % 5


def urgency_of(goal: Goal) -> int:
    """The order in a queue: the smallest is the first."""
    return -priority_of(goal)


class Sent:
    """A goal that was accepted, and what has become of it."""

    def __init__(self, goal: Goal, stream: GoalStream, number: int) -> None:
        self.goal = goal
        self.stream = stream
        self.number = number
        """The place in the order of acceptance."""
        self.is_canceled = False
        self.was_waiting = False
        """True if it had not begun when its cancel was accepted."""
        self.begun = 0
        self.result: Result | None = None


class Load:
    """A server under load, and the rules that have to hold meanwhile."""

    def __init__(self, schedule: Schedule, seed: int, *, takes_over: bool = False) -> None:
        self.schedule = schedule
        self.takes_over = takes_over
        self.chance = Random(seed)
        self.sent: dict[GoalID, Sent] = {}
        self.rejected = 0
        self.running: Counter[int] = Counter()
        self.most: Counter[int] = Counter()
        self.most_in_all = 0
        self.wrong: list[str] = []
        self.taken_over = 0
        self.hold: anyio.Event | None = None
        """The event that executors wait for, in place of some turns; None if they do not."""
        self.server = ActionServer(
            FIBONACCI, self.execute, schedule=schedule, result_timeout=math.inf, max_results=2000
        )

    # The executor

    async def execute(self, goal: GoalHandle[Goal]) -> Items:
        key = self.begin(goal)
        try:
            for _ in range(self.chance.randrange(MOST_TURNS)):
                goal = await self.step(goal)
            yield Feedback([goal.request.order])
            if self.hold is not None:
                await self.hold.wait()
            goal = await self.step(goal)
            yield self.result_of(goal)
        except anyio.get_cancelled_exc_class():
            await self.pause()
            raise GoalCanceled(result=self.result_of(goal)) from None
        finally:
            try:
                await self.pause()
            finally:
                self.running[key] -= 1

    def begin(self, goal: GoalHandle[Goal]) -> int:
        """Note the start of an executor, and return the key of its goal."""
        key = self.key_of(goal.request)
        self.note_start(goal)
        self.running[key] += 1
        self.most[key] = max(self.most[key], self.running[key])
        self.most_in_all = max(self.most_in_all, self.running.total())
        return key

    def note_start(self, goal: GoalHandle[Goal]) -> None:
        if goal.status is not GoalStatus.EXECUTING:
            self.wrong.append(f"it began as {goal.status.name}")
        sent = self.sent[goal.goal_id]
        sent.begun += 1
        if self.schedule.concurrency == 1 and self.schedule.when_full == "reject":
            earlier = (other for other in self.sent.values() if self.is_before(other, sent))
            self.wrong.extend(f"{sent.number} began before {one.number}" for one in earlier)

    def is_before(self, one: Sent, other: Sent) -> bool:
        """Return whether a goal waits and has to begin before the other one, of the same key."""
        return (
            one.number < other.number
            and one.stream.status is GoalStatus.ACCEPTED
            and self.key_of(one.goal) == self.key_of(other.goal)
            and self.urgency_of(one.goal) <= self.urgency_of(other.goal)
        )

    def result_of(self, goal: GoalHandle[Goal]) -> Result:
        result = self.sent[goal.goal_id].result = Result([goal.request.order])
        return result

    async def step(self, goal: GoalHandle[Goal]) -> GoalHandle[Goal]:
        """Await something, then take the successor over, if there is one."""
        await checkpoint()
        if self.takes_over and goal.successor is not None and self.chance.random() < 0.5:
            goal = goal.take_over()
            self.note_start(goal)
            self.taken_over += 1
        return goal

    async def pause(self) -> None:
        for _ in range(self.chance.randrange(MOST_TURNS)):
            await checkpoint()

    def key_of(self, goal: Goal) -> int:
        return key_of(goal) if self.schedule.key else 0

    def urgency_of(self, goal: Goal) -> int:
        return urgency_of(goal) if self.schedule.priority else 0

    # The clients

    async def be_a_client(self, number: int) -> None:
        sender = Sender(f"client-{number}", bytes([number]))
        async with anyio.create_task_group() as tasks:
            for order in range(number * GOALS, (number + 1) * GOALS):
                if (sent := await self.send(Goal(order), sender)) is not None:
                    chance = self.chance.random()
                    if chance < 0.3:
                        await self.cancel(sent)
                    elif chance < 0.6:
                        tasks.start_soon(self.cancel_later, sent)
                for _ in range(self.chance.choice(PAUSES)):
                    await checkpoint()

    async def send(self, goal: Goal, sender: Sender) -> Sent | None:
        goal_id = GoalID.random()
        try:
            stream = await self.server.send_goal(
                goal_id, FIBONACCI.goal.encode(goal), sender=sender
            )
        except GoalRejected as exc:
            if not exc.is_busy:
                self.wrong.append(exc.reason)
            self.rejected += 1
            return None
        sent = self.sent[goal_id] = Sent(goal, stream, len(self.sent))
        return sent

    async def cancel_later(self, sent: Sent) -> None:
        for _ in range(self.chance.randrange(20)):
            await checkpoint()
        await self.cancel(sent)

    async def cancel(self, sent: Sent) -> None:
        was_waiting = sent.stream.status is GoalStatus.ACCEPTED
        answer = await self.server.cancel_goals(sent.stream.goal_id)
        sent.is_canceled = answer.return_code is CancelCode.NONE
        sent.was_waiting = sent.is_canceled and was_waiting

    # The whole

    async def run(self) -> set[str]:
        """Let all clients send their goals, check all ends, and return their kinds."""
        async with self.server:
            async with anyio.create_task_group() as tasks:
                for number in range(CLIENTS):
                    tasks.start_soon(self.be_a_client, number)
            for sent in self.sent.values():
                self.check(sent, await sent.stream.outcome())
            await anyio.wait_all_tasks_blocked()
            assert self.running.total() == 0
            assert self.rejected + len(self.sent) == CLIENTS * GOALS
            self.check_limits()
            ends = self.ends()
            await self.fill_all_places()
        assert self.wrong == []
        return ends

    def check_limits(self) -> None:
        """Check that the limits were kept, and reached."""
        rules = self.schedule
        if rules.concurrency is not None:
            keys = KEYS if rules.key is not None else 1
            assert set(self.most.values()) == {min(rules.concurrency, rules.total or math.inf)}
            assert len(self.most) == keys
        if rules.total is not None:
            assert self.most_in_all == rules.total

    async def fill_all_places(self) -> None:
        """Check that as many goals as the limits allow run again at the same time."""
        keys = range(KEYS) if self.schedule.key is not None else range(1)
        limit = (self.schedule.concurrency or math.inf) * len(keys)
        limit = int(min(limit, self.schedule.total or math.inf))
        self.hold = anyio.Event()
        per_key = math.ceil(limit / len(keys))
        for order in range(per_key * len(keys)):
            await self.send(Goal(1000 * KEYS * 5 + order), Sender())
        await anyio.wait_all_tasks_blocked()
        assert self.running.total() == limit
        self.hold.set()

    # The ends

    def check(self, sent: Sent, outcome: Outcome[bytes]) -> None:
        """Check the end of a goal."""
        try:
            self.check_end(sent, outcome)
        except AssertionError as exc:
            self.wrong.append(f"goal {sent.number} ended as {outcome}: {exc}")

    def check_end(self, sent: Sent, outcome: Outcome[bytes]) -> None:
        result = FIBONACCI.result.encode(sent.result) if sent.result is not None else None
        assert outcome.result == result, "with another result"
        assert sent.begun < 2, "it began twice"
        if sent.was_waiting:
            assert sent.begun == 0, "it began though it was canceled before"
            assert outcome == End(GoalStatus.CANCELED)
        elif outcome.status is GoalStatus.SUCCEEDED:
            assert sent.begun == 1
            assert outcome.reason == ""
        elif outcome.status is GoalStatus.CANCELED:
            assert sent.is_canceled
            assert outcome.reason == ""
        else:
            assert outcome.status is GoalStatus.ABORTED
            assert not sent.is_canceled
            self.check_reason(sent, outcome.reason)

    def check_reason(self, sent: Sent, reason: str) -> None:
        words, _, name = reason.rpartition(" ")
        other = self.sent[GoalID.parse(name)]
        rules = self.schedule
        assert self.key_of(other.goal) == self.key_of(sent.goal), "by one of another key"
        assert other.number > sent.number, "by one that came before"
        if words == "replaced by":
            assert rules.when_full == "replace"
            assert sent.begun == 0
        else:
            assert (words, rules.when_full) == ("preempted by", "preempt")
            if rules.priority is not None:
                assert urgency_of(other.goal) < urgency_of(sent.goal), "by a less urgent one"

    def ends(self) -> set[str]:
        """Return the kinds of ends: statuses, or the reasons of the server."""
        outcomes = [sent.stream.known_outcome() for sent in self.sent.values()]
        return {one.reason.rpartition(" ")[0] or one.status.name for one in outcomes if one}


REJECTING = {
    "a bounded queue": Schedule(concurrency=4, queue=50),
    "one of each key, by priority": Schedule(
        concurrency=1, queue=20, key=key_of, priority=priority_of
    ),
    "keys within a total": Schedule(
        concurrency=2, total=4, queue=10, key=key_of, priority=priority_of
    ),
}
PREEMPTING = {
    "one arm": Schedule(concurrency=1, when_full="preempt"),
    "two arms with a queue": Schedule(concurrency=2, queue=3, when_full="preempt"),
    "urgent goals": Schedule(
        concurrency=1, queue=5, when_full="preempt", key=key_of, priority=priority_of
    ),
}
HANDING_OVER = {
    "never interrupted": Schedule(concurrency=1, when_full="preempt", handover=math.inf),
    "interrupted after a moment": Schedule(concurrency=1, when_full="preempt", handover=0.0003),
    "by keys": Schedule(concurrency=1, queue=2, when_full="preempt", key=key_of, handover=0.001),
}


@pytest.mark.parametrize("schedule", REJECTING.values(), ids=REJECTING)
async def test_a_queue_keeps_its_limits_and_loses_no_place_under_load(schedule: Schedule) -> None:
    load = Load(schedule, seed=1)
    ends = await load.run()
    assert ends == {"SUCCEEDED", "CANCELED"}
    assert load.rejected > 0


@pytest.mark.parametrize("schedule", PREEMPTING.values(), ids=PREEMPTING)
async def test_a_preempting_arm_keeps_its_limits_and_loses_no_place_under_load(
    schedule: Schedule,
) -> None:
    load = Load(schedule, seed=2)
    ends = await load.run()
    assert ends | {"SUCCEEDED"} == {"SUCCEEDED", "CANCELED", "preempted by"}


@pytest.mark.parametrize("schedule", HANDING_OVER.values(), ids=HANDING_OVER)
async def test_an_arm_that_takes_its_successors_over_runs_one_goal_at_a_time_under_load(
    schedule: Schedule,
) -> None:
    load = Load(schedule, seed=3, takes_over=True)
    ends = await load.run()
    assert load.taken_over > 5
    assert ends | {"SUCCEEDED"} == {"SUCCEEDED", "CANCELED", "preempted by"}


async def test_the_newest_goals_give_way_under_load_and_no_place_is_lost() -> None:
    schedule = Schedule(concurrency=2, total=4, queue=2, when_full="replace", key=key_of)
    load = Load(schedule, seed=4)
    ends = await load.run()
    assert ends == {"SUCCEEDED", "CANCELED", "replaced by"}
    assert load.rejected == 0
