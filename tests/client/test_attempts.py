"""`fibaction.client.attempts`: timeouts and retries of one goal, on virtual time."""

from __future__ import annotations

import gc
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from typing import Any
from weakref import ref

import anyio
import pytest
from anyio import current_time

from fibaction import (
    ActionClient,
    ActionError,
    ActionServer,
    CancelAnswer,
    CancelRejected,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    GoalTimeout,
    RejectionCode,
    Retry,
    Schedule,
    ServerNotFound,
)
from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalRequest, GoalStream
from fibaction.feeds.feedback_log import FeedbackCursor
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]

Client = ActionClient[Goal, Feedback, Result]
Items = AsyncGenerator[Feedback | Result, None]
HANG = object()
"""A step that does not end."""


async def slow(goal: GoalHandle[Goal]) -> Items:
    """Yield a feedback message each second."""
    for number in range(1, goal.request.order + 1):
        await anyio.sleep(1)
        yield Feedback([number])
    yield Result([goal.request.order])


class Scripted(ForwardingEndpoint):
    """An endpoint that fails, hangs or forwards, as its scripts say, and notes its calls."""

    def __init__(
        self,
        server: Endpoint,
        *,
        sends: Iterable[Any] = (),
        follows: Iterable[Any] = (),
        cancels: Iterable[Any] = (),
    ) -> None:
        super().__init__(server)
        self.steps = {"send": [*sends], "follow": [*follows], "cancel": [*cancels]}
        self.calls: list[str] = []
        self.timeouts: list[float] = []
        self.streams: list[GoalStream] = []

    async def _step(self, name: str) -> None:
        self.calls.append(name)
        step = self.steps[name].pop(0) if self.steps[name] else None
        if step is HANG:
            await anyio.sleep_forever()
        if isinstance(step, float):
            with anyio.CancelScope(shield=True):
                await anyio.sleep(step)
        if isinstance(step, Exception):
            try:
                raise step
            finally:
                del step  # its traceback references this frame

    async def offer_goal(self, request: GoalRequest) -> GoalStream:
        self.timeouts.append(request.deadline - current_time())
        await self._step("send")
        self.streams.append(await super().offer_goal(request))
        return self.streams[-1]

    async def feedback(self, goal_id: GoalID, **options: Any) -> GoalStream:
        await self._step("follow")
        self.streams.append(await super().feedback(goal_id, **options))
        return self.streams[-1]

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        await self._step("cancel")
        return await super().cancel_goals(goal_id, stamp)

    def lose(self) -> None:
        """Lose the stream that was opened last."""
        self.streams[-1].fail(ConnectionLost("the line broke"))

    @property
    def client(self) -> Client:
        return ActionClient(self, FIBONACCI)


class Watch:
    """A stopwatch, since the clock goes on from test to test."""

    def __init__(self) -> None:
        self.begun = current_time()

    def shows(self, seconds: float) -> bool:
        """Return whether so many seconds have passed."""
        passed: bool = current_time() - self.begun == pytest.approx(seconds)
        return passed


@pytest.fixture(autouse=True)
def full_delays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten no delay by chance."""
    monkeypatch.setattr("random.uniform", lambda low, high: high)


def reject(goal: GoalHandle[Goal]) -> None:
    raise CancelRejected("nearly done")


async def timed_out(waiting: Awaitable[object]) -> GoalTimeout:
    with pytest.raises(GoalTimeout) as caught:
        await waiting
    return caught.value


# Timeouts


@pytest.mark.parametrize(
    ("answer", "seconds"),
    [(None, 2), (0.5, 2.5), (HANG, 3), (ServerNotFound("gone"), 2)],
    ids=["at once", "later", "never", "an error"],
)
async def test_the_status_of_a_goal_without_feedback_is_asked_for_before_its_cancel(
    answer: object, seconds: float
) -> None:
    schedule = Schedule(concurrency=1, queue=1)
    async with ActionServer(FIBONACCI, slow, schedule=schedule) as server:
        endpoint = Scripted(server, follows=[answer])
        async with ActionClient(server, FIBONACCI).send_goal(Goal(9)):
            watch = Watch()
            error = await timed_out(endpoint.client.call(Goal(1), timeout=2))
            assert watch.shows(seconds)
    assert endpoint.calls == ["send", "follow", "cancel"]
    assert error.status is GoalStatus.ACCEPTED


async def test_the_status_of_a_goal_is_asked_for_once_and_not_if_changes_of_it_are_told() -> None:
    schedule = Schedule(concurrency=1, queue=1)
    async with ActionServer(FIBONACCI, slow, schedule=schedule) as server:
        endpoint = Scripted(server)
        async with ActionClient(server, FIBONACCI).send_goal(Goal(9)):
            goal = await endpoint.client.send_goal(Goal(1), timeout=2)
            await timed_out(goal.outcome())
            assert endpoint.calls == ["send", "cancel"]
            endpoint.steps["cancel"] = [ServerNotFound("gone")]
            goal = await endpoint.client.send_goal(Goal(1), timeout=2)
            goal.feedback.stream.close()
            for _ in range(2):
                await timed_out(goal.outcome())
            assert endpoint.calls[2:] == ["send", "follow", "cancel"]


async def test_an_outcome_that_arrives_while_the_status_is_asked_for_counts() -> None:
    schedule = Schedule(concurrency=1, queue=1)
    async with ActionServer(FIBONACCI, slow, schedule=schedule) as server:
        endpoint = Scripted(server, follows=[1.5])
        async with ActionClient(server, FIBONACCI).send_goal(Goal(1)):
            assert await endpoint.client.call(Goal(1), timeout=0.75) == Result([1])
    assert endpoint.calls == ["send", "follow"]


@pytest.mark.parametrize("cancel", [HANG, None], ids=["no answer", "answer"])
async def test_the_answer_to_the_cancel_is_waited_for_some_seconds(
    cancel: object, caplog: pytest.LogCaptureFixture
) -> None:
    watch = Watch()
    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server, cancels=[cancel])
        await timed_out(endpoint.client.call(Goal(9), timeout=2))
        assert watch.shows(2 if cancel is None else 7)
    assert endpoint.calls == ["send", "cancel"]
    assert ("its server does not answer the cancel" in caplog.text) is (cancel is HANG)


@pytest.mark.parametrize(("timeout", "seconds"), [(1, 5), (4, 5), (6, 7)])
async def test_a_server_that_answers_not_even_the_goal_has_less_time_for_the_cancel(
    timeout: float, seconds: float, caplog: pytest.LogCaptureFixture
) -> None:
    watch = Watch()
    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server, sends=[HANG], cancels=[HANG])
        error = await timed_out(endpoint.client.call(Goal(9), timeout=timeout))
        assert watch.shows(seconds)
    assert endpoint.calls == ["send", "cancel"]
    assert error.status is GoalStatus.UNKNOWN
    assert "its server does not answer the cancel" in caplog.text


async def test_a_cancellation_of_the_caller_does_not_cut_the_cancel_short() -> None:
    watch = Watch()
    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server, cancels=[HANG])
        with anyio.move_on_after(3):
            await timed_out(endpoint.client.call(Goal(9), timeout=2))
        assert watch.shows(7)


async def test_a_cancel_that_is_rejected_or_fails_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with ActionServer(FIBONACCI, slow, on_cancel=reject) as server:
        await timed_out(Scripted(server).client.call(Goal(9), timeout=2))
        endpoint = Scripted(server, cancels=[ConnectionLost("the line broke")])
        await timed_out(endpoint.client.call(Goal(9), timeout=2))
    assert "was left, but runs on: nearly done" in caplog.text
    assert "was left, but could not be canceled: the line broke" in caplog.text


async def test_each_wait_raises_and_one_cancels() -> None:
    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server)
        async with endpoint.client.send_goal(Goal(9), timeout=2) as goal:
            async with anyio.create_task_group() as tasks:
                for wait in (goal.outcome, goal.result, goal.feedback.__anext__):
                    tasks.start_soon(_expect_timeout, wait)
            await server.get_result(goal.goal_id)
            assert (await goal.outcome()).status is GoalStatus.CANCELED
    assert endpoint.calls == ["send", "cancel"]


async def test_a_goal_that_runs_on_is_not_waited_for_again() -> None:
    async with ActionServer(FIBONACCI, slow, on_cancel=reject) as server:
        endpoint = Scripted(server)
        goal = await endpoint.client.send_goal(Goal(9), timeout=2)
        first = await timed_out(goal.outcome())
        await anyio.sleep(1)
        again = await timed_out(goal.outcome())
        assert (str(again), again.status) == (str(first), GoalStatus.EXECUTING)
        await server.get_result(goal.goal_id)
        assert await goal.result() == Result([9])
    assert endpoint.calls == ["send", "cancel"]


async def _expect_timeout(wait: Callable[[], Awaitable[object]]) -> None:
    with pytest.raises(GoalTimeout):
        while True:
            await wait()


async def test_a_callback_is_not_interrupted_and_the_time_is_checked_after_it() -> None:
    watch = Watch()

    async def take_time(feedback: Feedback) -> None:
        await anyio.sleep(10)

    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server)
        await timed_out(endpoint.client.call(Goal(99), timeout=3, on_feedback=take_time))
        assert watch.shows(11)
    assert endpoint.calls == ["send", "cancel"]


# Retries


async def test_the_goal_is_sent_again_with_longer_and_longer_delays_and_the_time_left() -> None:
    watch = Watch()
    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server, sends=[GoalRejected("full", code=RejectionCode.BUSY)] * 3)
        retry = Retry(attempts=4, delay=1.0, max_delay=3.0)
        assert await endpoint.client.call(Goal(0), timeout=20, retry=retry) == Result([0])
        assert watch.shows(1 + 2 + 3)
    assert endpoint.timeouts == pytest.approx([20, 19, 17, 14])


async def test_an_attempt_that_ends_after_the_deadline_is_the_last() -> None:
    watch = Watch()

    class Late(Scripted):
        async def offer_goal(self, request: GoalRequest) -> GoalStream:
            await super().offer_goal(request)
            raise ConnectionLost("the line broke")

    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Late(server, sends=[3.0])
        await timed_out(endpoint.client.call(Goal(9), timeout=2, retry=Retry()))
        assert watch.shows(3)
    assert endpoint.calls == ["send", "cancel"]


def losing(endpoint: Scripted, *numbers: int) -> tuple[list[int], Callable[[Feedback], None]]:
    """A callback that loses the stream after these messages, and the list of those that came."""
    seen: list[int] = []

    def on_feedback(feedback: Feedback) -> None:
        seen.extend(feedback.partial_sequence)
        if seen[-1] in numbers:
            endpoint.lose()

    return seen, on_feedback


async def test_a_goal_is_followed_again_within_the_attempt_that_was_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server)
        seen: list[int] = []

        def on_feedback(feedback: Feedback) -> None:
            seen.extend(feedback.partial_sequence)
            if len(seen) == 2:
                endpoint.lose()

        monkeypatch.setattr(FeedbackCursor, "attempt", 2)  # and the goal is in the first
        client = endpoint.client
        result = await client.call(Goal(3), on_feedback=on_feedback, retry=Retry(delay=0.1))
        assert result == Result([3])
    assert seen == [1, 2, 1, 2, 3]


@pytest.mark.parametrize(
    "retry", [None, Retry(on=(ServerNotFound,)), Retry(attempts=1)], ids=["none", "other", "once"]
)
async def test_a_lost_connection_is_raised_where_it_is_not_retried(retry: Retry | None) -> None:
    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server)
        _, on_feedback = losing(endpoint, 1)
        with pytest.raises(ConnectionLost, match="the line broke"):
            await endpoint.client.call(Goal(9), timeout=9, on_feedback=on_feedback, retry=retry)
    assert endpoint.calls == ["send", "cancel"]


async def test_feedback_that_is_lost_meanwhile_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    async with ActionServer(FIBONACCI, slow, feedback_window=2) as server:
        endpoint = Scripted(server)
        seen, on_feedback = losing(endpoint, 1, 6)
        retry = Retry(delay=5.2, max_delay=5.2)
        client = endpoint.client
        await client.call(Goal(15), on_feedback=on_feedback, retry=retry)
    assert seen == [1, 5, 6, 10, 11, 12, 13, 14, 15]
    assert "6 feedback messages were lost" in caplog.text


async def test_an_executor_does_not_wait_for_a_goal_that_is_followed_again_for_its_result() -> None:
    watch = Watch()
    async with ActionServer(FIBONACCI, slow, feedback_window=1, stall_timeout=1000) as server:
        endpoint = Scripted(server)
        client = endpoint.client
        async with anyio.create_task_group() as tasks:

            async def lose() -> None:
                await anyio.sleep(1.5)
                endpoint.lose()

            tasks.start_soon(lose)
            await client.call(Goal(9), retry=Retry(delay=0.1))
        assert watch.shows(9)
        assert endpoint.calls == ["send", "follow"]
        assert not endpoint.streams[-1].reads


async def test_leaving_the_connection_ends_a_pause() -> None:
    watch = Watch()
    async with ActionServer(FIBONACCI, slow) as server:
        endpoint = Scripted(server)
        client = endpoint.client
        errors: list[ActionError] = []

        async def call() -> None:
            try:
                await client.call(Goal(9), timeout=100, retry=Retry())
            except ActionError as error:
                errors.append(error)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(call)
            await anyio.sleep(1)
            endpoint.lose()
            await anyio.sleep(0.1)
            await client.leave()
        assert watch.shows(1.1)
    assert endpoint.calls == ["send", "cancel"]
    assert [str(error) for error in errors] == ["the line broke"]


async def test_errors_that_are_retried_are_freed_without_the_garbage_collector() -> None:
    async with ActionServer(FIBONACCI, slow) as server:
        rejected, lost = ServerNotFound("not yet"), ConnectionLost("the line broke")
        errors: list[ref[Exception]] = [ref(rejected), ref(lost)]
        endpoint = Scripted(server, sends=[rejected], follows=[lost])
        del rejected, lost
        gc.collect()
        gc.disable()
        try:
            _, on_feedback = losing(endpoint, 1)
            await endpoint.client.call(Goal(2), on_feedback=on_feedback, retry=Retry(attempts=9))
            assert [error() for error in errors] == [None, None]
        finally:
            gc.enable()
