"""Bad lines, and processes that die: no goal runs twice, no feedback is lost unnoticed, no call
hangs.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections import Counter
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import anyio
import pytest
from anyio.abc import Process
from anyio.streams.text import TextReceiveStream

from fibaction import (
    ActionClient,
    ActionServer,
    ClientGoal,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalStatus,
    Retry,
    ServerNotFound,
    UnknownGoal,
    connect,
    serve,
)
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.matching import End
from tests.transports.hearing import hearing
from tests.transports.proxy import Line, line_to

pytestmark = pytest.mark.asyncio

Client = ActionClient[Goal, Feedback, Result]
Items = AsyncGenerator[Feedback | Result, None]
HEARTBEAT = 0.05


USED = {"scheme": "tcp"}
"""The transport of this test."""


@pytest.fixture(autouse=True, params=["tcp", "ws"])
def scheme(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setitem(USED, "scheme", request.param)
    return request.param


def address() -> str:
    return f"{USED['scheme']}://127.0.0.1:0"


@asynccontextmanager
async def bad_line(
    server: ActionServer[Goal, Feedback, Result], **settings: Any
) -> AsyncGenerator[Line, None]:
    async with serve(server, address(), **settings) as (url,), line_to(url) as line:
        yield line


class Counting:
    """An executor that yields 1, 2, 3 and so on, and a result; it counts how often each goal runs.

    At its `stop`, if it has one, it waits for `go_on`.
    """

    def __init__(self, stop: int = 0, pause: float = 0) -> None:
        self.runs: Counter[GoalID] = Counter()
        self.interrupted: Counter[GoalID] = Counter()
        self.started = anyio.Event()
        self.go_on = anyio.Event()
        self._stop = stop
        self._pause = pause

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        self.runs[goal.goal_id] += 1
        self.started.set()
        try:
            for number in range(1, goal.request.order + 1):
                yield Feedback([number])
                if number == self._stop:
                    await self.go_on.wait()
                await anyio.sleep(self._pause)
        except anyio.get_cancelled_exc_class():
            self.interrupted[goal.goal_id] += 1
            raise
        yield Result([goal.request.order])


async def numbers(goal: ClientGoal[Feedback, Result]) -> list[int]:
    return [number async for item in goal.feedback for number in item.partial_sequence]


# The line goes bad


@pytest.mark.promise("LOSS-3")
@pytest.mark.parametrize("more", [10, 250])
async def test_after_a_cut_the_feedback_goes_on_with_no_gap_or_a_counted_one(more: int) -> None:
    executor = Counting(stop=50)
    server = ActionServer(FIBONACCI, executor, feedback_window=16, stall_timeout=math.inf)
    async with bad_line(server) as line, connect(line.url, FIBONACCI, window=8) as client:
        with anyio.fail_after(30):
            goal = await client.send_goal(Goal(50 + more))
            got = [(await anext(goal.feedback)).partial_sequence[0] for _ in range(50)]
            line.hush("to client")
            executor.go_on.set()
            await line.swallows()
            line.cut()
            line.hush()
            got += await numbers(goal)
            assert await goal.result() == Result([50 + more])
    # What was on its way is lost with the line, and comes again if the server still has it.
    lost = goal.feedback_dropped
    assert got == [*range(1, 51), *range(51 + lost, 51 + more)]
    assert lost == 0 if more < 16 else lost <= 8
    assert list(executor.runs.values()) == [1]
    assert line.opened == 2


@pytest.mark.promise("LOSS-4")
@pytest.mark.parametrize("result_timeout", [10, 0])
async def test_an_end_that_is_lost_with_the_line_arrives_on_the_next(result_timeout: float) -> None:
    executor = Counting(stop=3)
    server = ActionServer(FIBONACCI, executor, result_timeout=result_timeout)
    async with bad_line(server) as line, connect(line.url, FIBONACCI) as client:
        with anyio.fail_after(30):
            goal = await client.send_goal(Goal(3))
            got = [(await anext(goal.feedback)).partial_sequence[0] for _ in range(3)]
            line.hush("to client")
            executor.go_on.set()
            await line.swallows()
            line.cut()
            line.hush()
            got += await numbers(goal)
            assert await goal.result() == Result([3])
    assert (got, goal.feedback_dropped) == ([1, 2, 3], 0)
    assert list(executor.runs.values()) == [1]
    assert line.opened == 2


@pytest.mark.promise("LOSS-3")
async def test_feedback_that_the_server_no_longer_has_after_a_cut_is_counted() -> None:
    executor = Counting(stop=3)
    server = ActionServer(FIBONACCI, executor, feedback_window=8, stall_timeout=0)
    async with bad_line(server) as line, connect(line.url, FIBONACCI) as client:
        with anyio.fail_after(5):
            goal = await client.send_goal(Goal(100))
            got = [(await anext(goal.feedback)).partial_sequence[0] for _ in range(3)]
            line.refuses = True
            line.cut()
            # Nobody reads, and the executor does not wait for that: it is done before the client
            # is there again.
            executor.go_on.set()
            assert (await server.get_result(goal.goal_id)).status is GoalStatus.SUCCEEDED
            line.refuses = False
            got += await numbers(goal)
            assert await goal.result() == Result([100])
    assert got == [1, 2, 3, *range(93, 101)]
    assert goal.feedback_dropped == 89


@pytest.mark.load
@pytest.mark.promise("GOAL-1", "GOAL-3", "LOSS-3", "LOSS-5")
async def test_500_goals_run_once_each_over_a_line_that_is_cut_every_50_ms() -> None:
    executor = Counting(pause=0.01)
    outcomes: Counter[GoalID] = Counter()
    todo = iter(range(500))
    server = ActionServer(FIBONACCI, executor)
    async with bad_line(server) as line, connect(line.url, FIBONACCI) as client:

        async def send() -> None:
            for order in todo:
                goal = await client.send_goal(Goal(order % 10))
                got = await numbers(goal)
                assert await goal.result() == Result([order % 10])
                assert got == sorted(set(got))
                assert len(got) + goal.feedback_dropped == order % 10
                outcomes[goal.goal_id] += 1

        async def cut() -> None:
            while True:
                await anyio.sleep(0.05)  # this is the fault, nobody waits for it
                line.cut()

        with anyio.fail_after(20):
            async with anyio.create_task_group() as cutting:
                cutting.start_soon(cut)
                async with anyio.create_task_group() as sending:
                    for _ in range(25):
                        sending.start_soon(send)
                cutting.cancel_scope.cancel()
    assert len(outcomes) == 500
    assert outcomes == executor.runs == Counter(dict.fromkeys(outcomes, 1))
    assert line.opened > 10


@pytest.mark.promise("LOSS-5")
async def test_a_cancel_whose_answer_is_lost_is_answered_on_the_next_connection() -> None:
    executor = Counting(stop=1)
    async with bad_line(ActionServer(FIBONACCI, executor)) as line:
        async with connect(line.url, FIBONACCI) as client:
            with anyio.fail_after(30):
                goal = await client.send_goal(Goal(2))
                await executor.started.wait()
                line.hush("to client")
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(goal.cancel)
                    while not executor.interrupted:
                        await anyio.lowlevel.checkpoint()
                    line.cut()
                    line.hush()
                assert (await goal.outcome()).status is GoalStatus.CANCELED
    assert list(executor.interrupted.values()) == [1]


async def test_a_slow_line_is_not_taken_for_a_dead_one() -> None:
    async with bad_line(ActionServer(FIBONACCI, fibonacci), heartbeat=HEARTBEAT) as line:
        line.delay = 2 * HEARTBEAT
        async with connect(line.url, FIBONACCI, heartbeat=HEARTBEAT) as client:
            with anyio.fail_after(30):
                goal = await client.send_goal(Goal(5))
                assert len([item async for item in goal.feedback]) == 4
        assert line.opened == 1


async def pending(client: Client, goal: ClientGoal[Feedback, Result]) -> list[Callable[[], Any]]:
    """Calls of all kinds that wait for the server."""
    statuses = await client.endpoint.status()
    for _ in range(statuses.known):
        assert await statuses.receive() is not None
    return [
        goal.outcome,
        lambda: anext(goal.feedback),
        goal.cancel,
        statuses.receive,
        lambda: client.send_goal(Goal(1)),
        lambda: client.attach(GoalID.random()),
        lambda: client.endpoint.get_result(goal.goal_id),
        client.cancel_goals,
    ]


@pytest.mark.promise("GOAL-4", "LOSS-1", "LOSS-2")
@pytest.mark.parametrize(
    "directions", [("to server",), ("to client",), ("to server", "to client")], ids=" and ".join
)
async def test_a_silent_line_is_noticed_and_no_call_hangs(directions: tuple[str, ...]) -> None:
    executor = Counting(stop=1)
    lost: list[ConnectionLost] = []
    with hearing() as heard:
        async with bad_line(ActionServer(FIBONACCI, executor), heartbeat=HEARTBEAT) as line:
            async with connect(line.url, FIBONACCI, heartbeat=HEARTBEAT, reconnect=False) as client:
                with anyio.fail_after(5):
                    goal = await client.send_goal(Goal(2))
                    assert (await anext(goal.feedback)).partial_sequence == [1]
                    calls = await pending(client, goal)

                    async def wait(call: Callable[[], Awaitable[object]]) -> None:
                        with pytest.raises(ConnectionLost) as caught:
                            await call()
                        lost.append(caught.value)

                    line.hush(*directions)
                    begun = perf_counter()
                    async with anyio.create_task_group() as tasks:
                        for call in calls:
                            tasks.start_soon(wait, call)
                    assert 2 * HEARTBEAT < perf_counter() - begun < 5
                    with pytest.raises(ConnectionLost):
                        await client.send_goal(Goal(1))
                    if "to server" in directions:
                        await heard.until("has been silent for 0.")
    assert len(lost) == len(calls)
    assert len(set(map(id, lost))) == len(calls)  # each is raised in a task of its own


# A line that is away for longer than calls wait

OFTEN = Retry(attempts=500, delay=0.02, max_delay=0.02)


@pytest.mark.promise("RETRY-3")
async def test_a_call_goes_on_with_its_goal_after_a_line_that_was_away_for_long() -> None:
    executor = Counting(stop=3)
    server = ActionServer(FIBONACCI, executor)
    got: list[int] = []
    async with bad_line(server) as line:
        async with connect(line.url, FIBONACCI, reconnect_timeout=0.02) as client:

            def on_feedback(feedback: Feedback) -> None:
                got.extend(feedback.partial_sequence)
                if got[-1] == 3:
                    line.refuses = True
                    line.cut()

            async def mend() -> None:
                await heard.until("attempt 3 ")
                executor.go_on.set()
                line.refuses = False

            with anyio.fail_after(10), hearing("fibaction.client") as heard:
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(mend)
                    result = await client.call(Goal(9), on_feedback=on_feedback, retry=OFTEN)
    assert (got, result) == ([*range(1, 10)], Result([9]))
    assert list(executor.runs.values()) == [1]


# Processes die


@asynccontextmanager
async def peer(*arguments: str) -> AsyncGenerator[tuple[Process, str], None]:
    """Another process, and the first line that it prints."""
    command = [sys.executable, "-m", "tests.transports.peer", *arguments]
    async with await anyio.open_process(
        command, cwd=Path(__file__).parents[2], stdin=subprocess.DEVNULL, stderr=None
    ) as process:
        try:
            assert process.stdout is not None
            with anyio.fail_after(20):
                text = ""
                async for part in TextReceiveStream(process.stdout):
                    text += part
                    if "\n" in text:
                        break
            yield process, text.strip()
        finally:
            if process.returncode is None:
                process.kill()


@pytest.mark.promise("LOSS-6")
async def test_a_server_that_is_killed_and_started_again_no_longer_knows_its_goals() -> None:
    async with peer("serve", address()) as (process, url):
        async with connect(url, FIBONACCI) as client:
            with anyio.fail_after(5):
                goal = await client.send_goal(Goal(1))
                unread = await client.send_goal(Goal(2))
                assert await anext(goal.feedback) == Feedback([0])
                process.kill()
                await process.wait()
            async with peer("serve", url) as (_, again):
                assert again == url
                with anyio.fail_after(10):
                    assert await goal.outcome() == End(
                        GoalStatus.UNKNOWN,
                        None,
                        "it was never accepted, its result has expired, or the server was"
                        " restarted",
                    )
                    assert await numbers(goal) == []
                    with pytest.raises(UnknownGoal):
                        await goal.result()
                    with pytest.raises(UnknownGoal):
                        await unread.result()
                    assert await client.call(Goal(0)) == Result([0])


@pytest.mark.promise("GOAL-4", "LOSS-1", "LOSS-2")
async def test_a_server_that_is_killed_for_good_ends_all_calls() -> None:
    async with peer("serve", address()) as (process, url):
        async with (
            connect(url, FIBONACCI, reconnect=False) as client,
            connect(url, FIBONACCI, reconnect_timeout=0.1) as hopeful,
        ):
            with anyio.fail_after(5):
                goals = [await one.send_goal(Goal(1)) for one in (client, hopeful)]
                process.kill()
                await process.wait()
                with pytest.raises(ConnectionLost):
                    await goals[0].result()
                # The end of the server is known, too.
                with pytest.raises((ConnectionLost, ServerNotFound)):
                    await goals[1].result()


@pytest.mark.promise("LOSS-7")
async def test_the_goal_of_a_client_that_is_killed_is_canceled_after_the_grace() -> None:
    executor = Counting(stop=1)
    server = ActionServer(FIBONACCI, executor)
    async with serve(server, address(), orphans="cancel", grace=0.2) as (url,):
        async with peer("send", url, "2") as (process, goal):
            goal_id = GoalID.parse(goal)
            process.kill()
            begun = perf_counter()
            await process.wait()
            with anyio.fail_after(30):
                outcome = await server.get_result(goal_id)
            assert outcome.status is GoalStatus.CANCELED
            assert perf_counter() - begun > 0.1
    assert executor.interrupted == {goal_id: 1}


@pytest.mark.promise("LOSS-7")
async def test_the_goal_of_a_client_that_is_killed_can_be_kept() -> None:
    executor = Counting(stop=1)
    server = ActionServer(FIBONACCI, executor, feedback_window=1)
    with hearing() as heard:
        async with serve(server, address(), grace=0.05) as (url,):
            async with peer("send", url, "100") as (process, goal):
                goal_id = GoalID.parse(goal)
                process.kill()
                await process.wait()
                await heard.until("127.0.0.1:")
                executor.go_on.set()
                # After the grace the executor no longer waits for somebody to read.
                async with connect(url, FIBONACCI) as client:
                    with anyio.fail_after(30):
                        follower = await client.attach(goal_id)
                        assert await follower.result() == Result([100])
    assert not executor.interrupted
