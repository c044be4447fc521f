"""Timeouts and retries of clients."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionError,
    ActionServer,
    AuthenticationFailed,
    CancelAnswer,
    ConnectionLost,
    GoalAborted,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    GoalTimeout,
    LimitReached,
    RejectionCode,
    Retry,
    Schedule,
    ServerNotFound,
    UnknownGoal,
)
from fibaction._runtime.notify import Notifier
from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.testing.contract.executors import FIBONACCI, Feedback, Goal, Items, Result, Steps
from fibaction.testing.contract.reach import Reach

pytestmark = pytest.mark.anyio

Client = ActionClient[Goal, Feedback, Result]
AT_ONCE = Retry(delay=0)

ACCEPTED = 1.5
"""Seconds of a timeout within which a goal is accepted, also over ROS 2 and on a busy machine."""


# Timeouts


async def calls(client: Client, timeout: float) -> None:
    await client.call(Goal(2), timeout=timeout)


async def calls_with_feedback(client: Client, timeout: float) -> None:
    await client.call(Goal(2), timeout=timeout, on_feedback=lambda _: None)


async def reads_feedback_in_a_block(client: Client, timeout: float) -> None:
    async with client.send_goal(Goal(2), timeout=timeout) as goal:
        async for _ in goal.feedback:
            pass


async def waits_for_the_outcome(client: Client, timeout: float) -> None:
    goal = await client.send_goal(Goal(2), timeout=timeout)
    await goal.outcome()


@pytest.mark.promise("DEADLINE-1")
@pytest.mark.parametrize(
    "use", [calls, calls_with_feedback, reads_feedback_in_a_block, waits_for_the_outcome]
)
async def test_a_timeout_ends_each_wait_and_cancels_the_goal(
    reach: Reach, use: Callable[[Client, float], Awaitable[None]]
) -> None:
    steps = Steps()
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        with pytest.raises(TimeoutError) as caught:
            await use(client, 0.2)
        if steps.runs:  # else it was too early
            await steps.canceled.wait()
    assert isinstance(caught.value, GoalTimeout)
    assert isinstance(caught.value, ActionError)


@pytest.mark.promise("DEADLINE-1")
@pytest.mark.turns
async def test_a_timeout_tells_the_status_and_the_feedback_that_was_read(reach: Reach) -> None:
    errors: list[GoalTimeout] = []
    async with (
        reach(ActionServer(FIBONACCI, Steps())) as client,
        anyio.create_task_group() as tasks,
    ):

        async def call(**options: Any) -> None:
            with pytest.raises(GoalTimeout) as caught:
                await client.call(Goal(3), timeout=ACCEPTED, **options)
            errors.append(caught.value)

        tasks.start_soon(partial(call, on_feedback=lambda _: None))
        tasks.start_soon(call)
    assert [error.status for error in errors] == [GoalStatus.EXECUTING] * 2
    read, unread = sorted(errors, key=lambda error: -error.feedback_count)
    assert (read.feedback, read.feedback_count) == (Feedback([3]), 3)
    text = "timed out: it took longer than 1.5 s, and was EXECUTING"
    assert str(read) == f"goal {read.goal_id} {text} after 3 feedback messages"
    assert str(unread) == f"goal {unread.goal_id} {text}"


@pytest.mark.promise("DEADLINE-1")
@pytest.mark.turns
async def test_a_timeout_tells_a_client_without_feedback_that_its_goal_still_waits(
    reach: Reach,
) -> None:
    steps = Steps()
    server = ActionServer(FIBONACCI, steps, schedule=Schedule(concurrency=1, queue=1))
    async with reach(server) as client, client.send_goal(Goal(0)) as first:
        with pytest.raises(GoalTimeout) as caught:
            await client.call(Goal(3), timeout=ACCEPTED)
        assert caught.value.status is GoalStatus.ACCEPTED
        steps.go.set()
        await first.result()


class Deciding(ForwardingEndpoint):
    """A server that decides on its goals as soon as a cancel arrives."""

    def __init__(self, steps: Steps) -> None:
        self.decide = anyio.Event()
        super().__init__(ActionServer(FIBONACCI, steps, on_goal=self._wait))

    async def _wait(self, goal: Goal) -> None:
        if goal.order < 0:
            raise GoalRejected("it asks only whether requests arrive")
        await self.decide.wait()

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        self.decide.set()
        return await super().cancel_goals(goal_id, stamp)


@pytest.mark.promise("DEADLINE-1")
async def test_a_goal_that_is_still_being_decided_times_out_and_does_not_run_on(
    reach: Reach,
) -> None:
    steps = Steps()
    async with reach.connection(Deciding(steps)) as connection:
        client = connection.client(FIBONACCI)
        with pytest.raises(GoalRejected):  # over ROS, the first request may take seconds
            await client.call(Goal(-1))
        with pytest.raises(GoalTimeout) as caught:
            await client.call(Goal(1), timeout=0.2)
        error = caught.value
        assert (error.status, error.feedback_count) == (GoalStatus.UNKNOWN, 0)
        assert str(error).endswith("longer than 0.2 s, and was not known to be accepted")
        assert error.goal_id is not None
        outcome = await client.endpoint.get_result(error.goal_id)
        # In the same process, the cancellation reaches the server before the goal is accepted.
        assert outcome.status in (GoalStatus.CANCELED, GoalStatus.UNKNOWN)


@pytest.mark.promise("DEADLINE-2")
@pytest.mark.turns
async def test_an_outcome_in_time_counts_however_late_it_is_read(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, Steps(go=True))) as client:
        assert await client.call(Goal(2), timeout=30) == Result([2])
        sent_at = anyio.current_time()
        async with client.send_goal(Goal(2), timeout=ACCEPTED) as goal:
            await goal.outcome()
            await anyio.sleep_until(sent_at + ACCEPTED + 0.1)
            assert [item async for item in goal.feedback] == [Feedback([1]), Feedback([2])]
            assert await goal.result() == Result([2])


@pytest.mark.promise("DEADLINE-1")
async def test_feedback_without_end_does_not_put_the_deadline_off(reach: Reach) -> None:
    async def endless(goal: GoalHandle[Goal]) -> Items:
        while True:
            yield Feedback([1])

    async with reach(ActionServer(FIBONACCI, endless)) as client:
        with pytest.raises(GoalTimeout):
            await client.call(Goal(1), timeout=0.2, on_feedback=lambda _: None)


@pytest.mark.promise("DEADLINE-3")
@pytest.mark.turns
async def test_a_goal_that_no_task_waits_for_is_not_canceled(reach: Reach) -> None:
    steps = Steps()
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        goal = await client.send_goal(Goal(0), timeout=ACCEPTED)
        await anyio.sleep_until(anyio.current_time() + ACCEPTED)
        assert not steps.canceled.is_set()
        with pytest.raises(GoalTimeout):
            await goal.result()
        await steps.canceled.wait()


@pytest.mark.promise("DEADLINE-4")
async def test_the_executor_sees_the_deadline(reach: Reach) -> None:
    steps = Steps(go=True)
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        await client.call(Goal(0), timeout=100)
        await client.call(Goal(0))
        await client.call(Goal(0), timeout=math.inf)
    assert 50 < steps.deadlines[0] <= 100
    assert steps.deadlines[1:] == [math.inf, math.inf]


@pytest.mark.promise("DEADLINE-4")
async def test_a_goal_that_is_sent_again_keeps_its_first_deadline(reach: Reach) -> None:
    deadlines: list[float] = []
    again = anyio.Event()

    async def executor(goal: GoalHandle[Goal]) -> Items:
        deadlines.append(goal.deadline)
        await again.wait()
        deadlines.append(goal.deadline)
        yield Result([])

    goal_id = GoalID.random()
    async with reach(ActionServer(FIBONACCI, executor)) as client:
        goal = await client.send_goal(Goal(0), goal_id=goal_id, timeout=100)
        await client.send_goal(Goal(0), goal_id=goal_id, timeout=1000)
        again.set()
        await goal.result()
    assert deadlines[0] == deadlines[1] < anyio.current_time() + 500


# Retries


class Faulty(ForwardingEndpoint):
    """An endpoint with faults, and a client of it that no transport is in between."""

    @property
    def client(self) -> Client:
        return ActionClient(self, FIBONACCI)


class Troubled(Faulty):
    """An endpoint that fails some times, before or after it has forwarded a goal."""

    def __init__(self, inner: Endpoint, *errors: ActionError, after: bool = False) -> None:
        super().__init__(inner)
        self.errors = list(errors)
        self.sent: list[GoalID] = []
        self.canceled: list[GoalID | None] = []
        self.failed = anyio.Event()
        self._after = after

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        self.sent.append(request.goal_id)
        if self.errors and not self._after:
            self.failed.set()
            raise self.errors.pop(0)
        stream = await super().offer_goal(request)
        if self.errors:
            self.failed.set()
            raise self.errors.pop(0)
        return stream

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        self.canceled.append(goal_id)
        return await super().cancel_goals(goal_id, stamp)


@pytest.mark.promise("RETRY-1")
@pytest.mark.parametrize(
    "error",
    [
        GoalRejected("1 of 1 running", code=RejectionCode.BUSY),
        ServerNotFound("it is not served yet"),
        LimitReached("the server is full"),
        ConnectionLost("the line broke"),
    ],
    ids=lambda error: type(error).__name__,
)
async def test_a_goal_that_was_not_accepted_is_sent_again_with_its_id(
    reach: Reach, error: ActionError, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "fibaction.client")
    steps = Steps(go=True)
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        troubled = Troubled(client.endpoint, error, error)
        assert await troubled.client.call(Goal(1), retry=AT_ONCE) == Result([1])
    (goal_id,) = set(troubled.sent)
    assert len(troubled.sent) == 3
    assert steps.runs == {goal_id: 1}
    texts = [record.getMessage() for record in caplog.records if record.name == "fibaction.client"]
    assert texts == [
        f"goal {goal_id}: attempt {attempt} of 3 comes in 0 s, because the last one failed: {error}"
        for attempt in (2, 3)
    ]


@pytest.mark.promise("RETRY-1")
async def test_a_rejection_of_a_busy_server_is_not_its_last_word(reach: Reach) -> None:
    """The errors cross the wire, and the server itself rejects."""
    steps = Steps()
    async with reach(ActionServer(FIBONACCI, steps, max_goals=1)) as client:
        async with client.send_goal(Goal(0)) as first:
            with pytest.raises(GoalRejected) as caught:
                await client.call(Goal(1), retry=Retry(attempts=2, delay=0))
            assert caught.value.is_busy
            troubled = Troubled(client.endpoint)
            results: list[Result] = []

            async def call() -> None:
                retry = Retry(attempts=1000, delay=0.02, max_delay=0.02)
                results.append(await troubled.client.call(Goal(1), retry=retry))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(call)
                while len(troubled.sent) < 3:
                    await anyio.lowlevel.checkpoint()
                steps.go.set()
            await first.result()
    assert results == [Result([1])]
    assert sorted(steps.runs.values()) == [1, 1]


@pytest.mark.promise("RETRY-1")
async def test_a_goal_whose_acceptance_was_lost_is_sent_again_and_runs_once(reach: Reach) -> None:
    steps = Steps(go=True)
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        troubled = Troubled(client.endpoint, *[ConnectionLost("the line broke")] * 2, after=True)
        assert await troubled.client.call(Goal(1), retry=AT_ONCE) == Result([1])
    assert len(troubled.sent) == 3
    assert list(steps.runs.values()) == [1]


@pytest.mark.promise("RETRY-2")
@pytest.mark.parametrize(
    "error",
    [GoalRejected("the order is negative"), AuthenticationFailed("this client may not send")],
    ids=lambda error: type(error).__name__,
)
async def test_a_decision_is_not_asked_for_again(reach: Reach, error: ActionError) -> None:
    async with reach(ActionServer(FIBONACCI, Steps(go=True))) as client:
        troubled = Troubled(client.endpoint, error)
        with pytest.raises(type(error)) as caught:
            await troubled.client.call(Goal(1), retry=AT_ONCE)
    assert caught.value is error
    assert len(troubled.sent) == 1


@pytest.mark.promise("RETRY-2")
async def test_a_goal_that_has_run_is_not_run_again(reach: Reach) -> None:
    runs = 0

    async def fails(goal: GoalHandle[Goal]) -> Items:
        nonlocal runs
        runs += 1
        raise GoalAborted("too heavy")
        yield Result([])

    async with reach(ActionServer(FIBONACCI, fails)) as client:
        with pytest.raises(GoalAborted):
            await client.call(Goal(1), retry=AT_ONCE)
    assert runs == 1


@pytest.mark.promise("RETRY-1")
async def test_the_last_error_is_raised_after_the_last_attempt(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, Steps(go=True))) as client:
        busy = [GoalRejected(f"busy: {n}", code=RejectionCode.BUSY) for n in range(9)]
        troubled = Troubled(client.endpoint, *busy)
        with pytest.raises(GoalRejected, match="busy: 3") as caught:
            await troubled.client.call(Goal(1), retry=Retry(attempts=4, delay=0))
    assert caught.value.is_busy
    assert len(troubled.sent) == 4


class Breaking(Faulty):
    """An endpoint whose streams of a goal are lost when a test wants it."""

    def __init__(self, inner: Endpoint) -> None:
        super().__init__(inner)
        self.sent: list[GoalID] = []
        self.follows: list[int | None] = []
        self.streams: list[GoalStream] = []
        self.news = Notifier()

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        self.sent.append(request.goal_id)
        return self._opened(await super().offer_goal(request))

    async def feedback(
        self, goal_id: GoalID, *, after: int | None = None, own: bool = False, attempt: int = 1
    ) -> GoalStream:
        self.follows.append(after)
        return self._opened(await super().feedback(goal_id, after=after, own=own, attempt=attempt))

    def _opened(self, stream: GoalStream) -> GoalStream:
        self.streams.append(stream)
        self.news.notify()
        return stream

    async def opened(self, streams: int) -> None:
        """Wait until so many streams have been opened."""
        while len(self.streams) < streams:
            await self.news.wait()

    def break_all(self) -> None:
        for stream in self.streams:
            stream.fail(ConnectionLost("the line broke"))


async def calls_a_goal_that_is_lost(client: Client, breaking: Breaking, steps: Steps) -> None:
    seen: list[int] = []

    def on_feedback(feedback: Feedback) -> None:
        seen.extend(feedback.partial_sequence)
        if seen[-1] == 3:
            breaking.break_all()
            steps.go.set()

    assert await client.call(Goal(3), on_feedback=on_feedback, retry=AT_ONCE) == Result([3])
    assert seen == [1, 2, 3]
    assert len(breaking.sent) == len(breaking.follows) == 1
    assert list(steps.runs.values()) == [1]


@pytest.mark.promise("RETRY-3")
async def test_an_accepted_goal_is_followed_again_behind_the_feedback_that_was_read(
    reach: Reach,
) -> None:
    steps = Steps()
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        breaking = Breaking(client.endpoint)
        await calls_a_goal_that_is_lost(breaking.client, breaking, steps)


@pytest.mark.promise("RETRY-3")
async def test_a_goal_that_is_lost_behind_the_server_is_followed_again(reach: Reach) -> None:
    steps = Steps()
    breaking = Breaking(ActionServer(FIBONACCI, steps))
    async with reach.connection(breaking) as connection:
        await calls_a_goal_that_is_lost(connection.client(FIBONACCI), breaking, steps)


@pytest.mark.promise("RETRY-3")
async def test_the_result_of_an_accepted_goal_is_waited_for_again(reach: Reach) -> None:
    steps = Steps()
    results: list[Result] = []
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        breaking = Breaking(client.endpoint)

        async def call() -> None:
            results.append(await breaking.client.call(Goal(0), retry=AT_ONCE, timeout=100))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(call)
            for streams in (1, 2):
                await breaking.opened(streams)
                breaking.break_all()
            await breaking.opened(3)
            steps.go.set()
    assert results == [Result([0])]
    assert (len(breaking.sent), len(breaking.follows)) == (1, 2)
    assert list(steps.runs.values()) == [1]


@pytest.mark.promise("RETRY-3")
async def test_an_accepted_goal_that_the_server_has_forgotten_is_not_run_again(
    reach: Reach,
) -> None:
    class Forgotten(Breaking):
        async def feedback(self, goal_id: GoalID, **_: Any) -> GoalStream:
            self.follows.append(None)
            return await super(Breaking, self).feedback(GoalID.random())  # it knows no such goal

    steps = Steps()
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        breaking = Forgotten(client.endpoint)
        with pytest.raises(UnknownGoal):
            await breaking.client.call(
                Goal(1), on_feedback=lambda _: breaking.break_all(), retry=AT_ONCE
            )
    assert len(breaking.sent) == len(breaking.follows) == 1
    assert list(steps.runs.values()) == [1]


@pytest.mark.promise("DEADLINE-1", "RETRY-1")
async def test_the_timeout_is_for_all_attempts_together(reach: Reach) -> None:
    async with reach(ActionServer(FIBONACCI, Steps(go=True))) as client:
        busy = GoalRejected("no arm is free", code=RejectionCode.BUSY)
        troubled = Troubled(client.endpoint, busy)
        with pytest.raises(GoalTimeout) as caught:
            await troubled.client.call(
                Goal(1), timeout=0.1, retry=Retry(delay=1000, max_delay=1000)
            )
    assert caught.value.status is GoalStatus.UNKNOWN
    assert isinstance(caught.value.__cause__, GoalRejected)
    assert len(troubled.sent) == 1
    assert troubled.canceled == []


@pytest.mark.promise("CANCEL-22")
@pytest.mark.parametrize("after", [False, True], ids=["not accepted", "maybe accepted"])
async def test_a_caller_that_is_canceled_between_attempts_cancels_a_goal_that_may_run(
    reach: Reach, after: bool
) -> None:
    steps = Steps()
    error = ConnectionLost("the line broke") if after else ServerNotFound("nowhere")
    async with reach(ActionServer(FIBONACCI, steps)) as client:
        troubled = Troubled(client.endpoint, error, after=after)
        retry = Retry(delay=1000, max_delay=1000)
        async with anyio.create_task_group() as tasks:

            async def call() -> None:
                await troubled.client.call(Goal(1), retry=retry)

            tasks.start_soon(call)
            await troubled.failed.wait()
            tasks.cancel_scope.cancel()
        if after:
            await steps.canceled.wait()
    assert troubled.canceled == troubled.sent * after
