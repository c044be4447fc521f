"""The executors of the simulation, one for each kind of goal."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable
from typing import Any, TypeAlias

import anyio

from fibaction import CancelRejected, GoalAborted, GoalCanceled, GoalHandle, GoalRejected
from fibaction.server.execution.executor import Executor
from tests.simulation.facts import Life
from tests.simulation.invariants import Record
from tests.simulation.scenario import ON_PURPOSE, Done, Step, Work

Items: TypeAlias = AsyncGenerator[Step | Done, None]

ENDLESS = 30.0
"""Seconds that an endless goal takes if it is not canceled."""


class Job:
    """A goal that is being executed, and the record of it."""

    def __init__(self, record: Record, life: Life, goal: GoalHandle[Work]) -> None:
        self._record = record
        self._life = life
        self._begin(goal)
        record.keeping.started(self._truth, goal)

    def _begin(self, goal: GoalHandle[Work]) -> None:
        self.goal = goal
        self.work = goal.request
        self._truth = self._life.goals[goal.goal_id, goal.stamp]
        self._truth.attempt = goal.attempt
        self._done = goal.restored or 0  # steps, with those of earlier attempts
        self._record.started(self._truth)

    @property
    def left_to_do(self) -> int:
        """The number of steps that no attempt has done yet."""
        return max(0, self.work.steps - self._done)

    def take_over(self) -> bool:
        """Go on as the successor, and return True, if there is one."""
        if self.goal.successor is None:
            return False
        self._begin(self.goal.take_over())
        return True

    def grasp(self) -> None:
        """Check that there is no successor after an interruption."""
        if self.goal.successor is not None or self.goal.cancel_requested is False:
            self._record.fail("turn", f"{self.goal} was interrupted, and has a successor")
        try:
            self.goal.take_over()
        except RuntimeError:
            return
        self._record.fail("turn", f"{self.goal} was interrupted, and took its successor over")

    def left(self) -> None:
        """Note that the executor has ended, with its clean-up."""
        self._record.places.left(self._truth)

    def step(self) -> Step:
        """Return the next feedback."""
        if not self.goal._goal.phase.is_open:  # it was killed, and its feedback is discarded
            return Step(self._truth.count + 1)
        self._truth.count += 1
        self._done += 1
        return Step(self._truth.count, bytes(self.work.size), self.goal.attempt)

    def done(self) -> Done:
        """Return the result."""
        result = self.part()
        if self.goal._goal.phase.is_open:  # else it was killed, and the result is discarded
            self._truth.result = result
        return result

    def part(self) -> Done:
        """Return the partial result."""
        return Done(self.work.key, self._truth.count, bytes(self.work.size))

    async def rest(self) -> None:
        """Await, for as long as the goal says, and keep a checkpoint if it is time for one."""
        await anyio.sleep(self.work.pause)
        if self.work.keeps and self._truth.count % self.work.keeps == 0:
            await self.keep()

    async def keep(self) -> None:
        """Keep a checkpoint, unless the goal has ended."""
        goal, done = self.goal, self._done
        if goal._goal.phase.is_open:
            truth = self._truth
            await goal.checkpoint(done)
            self._record.keeping.checkpoint_returned(truth, done)


async def steady(job: Job) -> Items:
    for _ in range(job.left_to_do):
        yield job.step()
        await job.rest()
    yield job.done()


async def busy(job: Job) -> Items:
    for _ in range(job.work.steps):
        yield job.step()
    yield job.done()


async def bursts(job: Job) -> Items:
    for number in range(job.work.steps):
        yield job.step()
        if number % 5 == 4:
            await job.rest()
    yield job.done()


async def instant(job: Job) -> Items:
    yield job.done()


async def tidy(job: Job) -> Items:
    try:
        for _ in range(job.left_to_do):
            yield job.step()
            await job.rest()
        await anyio.sleep(0.2)
    except anyio.get_cancelled_exc_class():
        if job.work.keeps:
            await job.keep()
        await anyio.sleep(job.work.cleanup)
        raise GoalCanceled(ON_PURPOSE, result=job.part()) from None
    yield job.done()


async def polite(job: Job) -> Items:
    for _ in range(job.work.steps):
        if job.goal.cancel_requested:
            raise GoalCanceled(ON_PURPOSE, result=job.part())
        yield job.step()
        await job.rest()
    yield job.done()


async def stubborn(job: Job) -> Items:
    left = job.work.steps
    while left:
        try:
            left -= 1
            yield job.step()
            await job.rest()
        except anyio.get_cancelled_exc_class():
            await anyio.sleep(job.work.cleanup)
    yield job.done()


async def raises(job: Job) -> Items:
    for _ in range(job.work.steps):
        yield job.step()
        await job.rest()
    raise ValueError(ON_PURPOSE)


async def aborts(job: Job) -> Items:
    for _ in range(job.work.steps):
        yield job.step()
    raise GoalAborted(ON_PURPOSE, result=job.part())


async def endless(job: Job) -> Items:
    ends_at = anyio.current_time() + ENDLESS
    while anyio.current_time() < ends_at:
        if job.goal.cancel_requested:
            raise GoalCanceled(ON_PURPOSE)
        yield job.step()
        await anyio.sleep(max(job.work.pause, 0.05))
    yield job.done()


async def takes_over(job: Job) -> Items:
    left = job.work.steps
    while left:
        left -= 1
        if job.take_over():
            left = job.work.steps
        yield job.step()
        await job.rest()
    yield job.done()


async def follows_on(job: Job) -> Items:
    for _ in range(job.work.steps):
        yield job.step()
        with anyio.move_on_after(job.work.pause + 0.1):
            await job.goal.wait_for_successor()
        job.take_over()
    yield job.done()


async def grasps(job: Job) -> Items:
    try:
        for _ in range(job.work.steps):
            yield job.step()
            await job.rest()
        await anyio.sleep(0.2)
    except anyio.get_cancelled_exc_class():
        job.grasp()
        await anyio.sleep(job.work.cleanup)
        raise
    yield job.done()


class _Watched(AsyncGenerator[Step | Done, None]):
    """The executor of a job, which reports its end to the record."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._items = EXECUTORS[job.work.kind](job)

    def asend(self, value: None) -> Awaitable[Step | Done]:  # type: ignore[override]  # it is a coroutine's
        return self._items.asend(value)

    def athrow(self, *error: Any) -> Awaitable[Step | Done]:  # type: ignore[override]  # it is a coroutine's
        return self._items.athrow(*error)

    async def aclose(self) -> None:
        try:
            await self._items.aclose()
        finally:
            self._job.left()


EXECUTORS: dict[str, Callable[[Job], Items]] = {
    kind.__name__.replace("_", " "): kind
    for kind in (
        steady,
        busy,
        bursts,
        instant,
        tidy,
        polite,
        stubborn,
        raises,
        aborts,
        endless,
        takes_over,
        follows_on,
        grasps,
    )
}


def executor_for(record: Record, number: int) -> Executor[Work, Step, Done]:
    """Return the executor of all goals of the server of that number, counted from 0, which reports
    its starts to the record.
    """

    def execute(goal: GoalHandle[Work]) -> Items:
        return _Watched(Job(record, record.lives[number], goal))

    return execute


def decide_goal(work: Work) -> None:
    """Decide on a goal: a sync `on_goal`."""
    if work.rejects == "goal":
        raise GoalRejected(ON_PURPOSE)
    if work.rejects == "goal by failing":
        raise ValueError(ON_PURPOSE)


async def decide_goal_later(work: Work) -> None:
    """Decide on a goal after a while: an async `on_goal`."""
    await anyio.sleep(work.decide)
    decide_goal(work)


def recover(goal: GoalHandle[Work]) -> None:
    """Decide on a goal that was interrupted by a crash: a sync `recovery`."""
    if goal.request.key % 3 == 0:
        raise GoalAborted(ON_PURPOSE, result=Done(goal.request.key, goal.restored or 0))
    if goal.request.key % 11 == 0:
        raise ValueError(ON_PURPOSE)


async def recover_later(goal: GoalHandle[Work]) -> None:
    """Decide on a goal that was interrupted by a crash, after a while: an async `recovery`."""
    await anyio.sleep(goal.request.decide)
    recover(goal)


def decide_cancel(goal: GoalHandle[Work]) -> None:
    """Decide on a cancel: a sync `on_cancel`."""
    if goal.request.rejects == "cancel":
        raise CancelRejected(ON_PURPOSE)


async def decide_cancel_later(goal: GoalHandle[Work]) -> None:
    """Decide on a cancel after a while: an async `on_cancel`."""
    await anyio.sleep(goal.request.decide)
    decide_cancel(goal)
