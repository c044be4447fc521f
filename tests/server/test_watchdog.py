"""`fibaction.server.execution.watchdog`: an executor that blocks the event loop is named in the
log."""

from __future__ import annotations

import asyncio  # noqa: TID251  # it alone can cancel a task without a scope
import linecache
import logging
import math
import re
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from contextvars import copy_context
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest
from anyio.lowlevel import checkpoint

from fibaction import ActionClient, ActionServer, GoalHandle, GoalID
from fibaction.server.execution import watchdog as watchdog_module
from fibaction.server.execution.interruption import CancelOnce, Stepper
from fibaction.server.execution.watchdog import ADVICE, POLL, Watch, Watchdog
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.processes import PATIENCE

pytestmark = pytest.mark.anyio


LIMIT = 0.01
"""Seconds of servers whose executors block until they are named."""


def watchdogs() -> list[Watchdog]:
    return [thread for thread in threading.enumerate() if isinstance(thread, Watchdog)]


@pytest.fixture(autouse=True)
def no_watchdog_is_left() -> Iterator[None]:
    assert watchdogs() == []
    yield
    assert watchdogs() == []


# The check, at times of the test's own


class Bench:
    """A watch with a limit of a second that no thread checks, and a clock that the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
        self.now = 1000.0
        self._caplog = caplog
        monkeypatch.setattr(
            "fibaction.server.execution.interruption.perf_counter", lambda: self.now
        )
        monkeypatch.setattr("fibaction.server.execution.watchdog.perf_counter", lambda: self.now)
        self.watchdog = Watchdog()
        never = SimpleNamespace(add=lambda _: self.watchdog, remove=lambda _: None)
        monkeypatch.setattr(watchdog_module, "_watchdogs", never)
        self.watch = Watch("count", 1.0)
        self.watch.open()
        self.watchdog.watches = (self.watch,)
        self.made: list[Stepper[None]] = []

    def executor(self, name: str, body: Callable[[], object]) -> Stepper[None]:
        """Begin an executor of the goal of that name, which calls `body` in each step."""

        async def run() -> None:
            while True:
                body()
                with suppress(ValueError):
                    await Pause()

        scopes = CancelOnce(lambda: None)
        steps = Stepper(run(), scopes, copy_context(), lambda: None, current=self.watch.current)
        self.made.append(steps)
        self.watch.begin(steps, Executor(name))
        return steps

    def check(self, seconds: float = 0) -> float:
        """Check after so many seconds, as the thread does."""
        self.now += seconds
        return self.watchdog.check(self.now)

    @property
    def told(self) -> list[str]:
        """The messages since the last time, without the places."""
        texts = [record.getMessage() for record in self._caplog.records]
        self._caplog.clear()
        return [text.partition(" so far")[0] for text in texts]


class Executor:
    def __init__(self, name: str) -> None:
        self.handle = cast("GoalHandle[Any]", SimpleNamespace(goal_id=name))


class Pause:
    def __await__(self) -> Generator[None, None, None]:
        yield


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Iterator[Bench]:
    bench = Bench(monkeypatch, caplog)
    yield bench
    for steps in bench.made:
        steps.close()


def blocks(name: str, seconds: str) -> str:
    return f"goal {name} of action 'count' has blocked the event loop for {seconds} s"


def blocked(name: str, seconds: str) -> str:
    return f"goal {name} of action 'count' blocked the event loop for {seconds} s in all"


async def test_a_step_is_named_once_at_the_limit_and_its_end_is_told(
    bench: Bench,
) -> None:
    def body() -> None:
        bench.check(0.99)
        assert bench.told == []
        bench.check(0.02)
        assert bench.told == [blocks("a", "1.0")]
        bench.check(5)
        assert bench.told == []

    bench.executor("a", body).send(None)
    bench.check(0.5)
    assert bench.told == [blocked("a", "6.5")]
    bench.check(5)
    assert bench.told == []


async def test_the_time_between_steps_does_not_count(bench: Bench) -> None:
    steps = bench.executor("a", lambda: bench.check(0.9))
    for _ in range(3):
        steps.send(None)
        bench.check(60)
    assert bench.told == []


async def test_of_two_steps_the_inner_one_is_named_and_then_the_outer_one(
    bench: Bench,
) -> None:
    inner = bench.executor("b", lambda: bench.check(2))

    def body() -> None:
        bench.check(0.5)
        inner.send(None)
        assert bench.told == [blocks("b", "2.0")]
        bench.check()
        assert bench.told == [blocked("b", "2.0")]
        bench.check(1)
        assert bench.told == [blocks("a", "3.5")]

    bench.executor("a", body).send(None)
    assert bench.watch.current.steps is None


async def test_of_steps_of_two_servers_only_the_inner_one_is_named(bench: Bench) -> None:
    other = Watch("other", 0)
    other.open()
    outer, bench.watch = bench.watch, other
    inner = bench.executor("b", lambda: bench.check(2))
    bench.watch = outer
    bench.executor("a", lambda: inner.send(None)).send(None)
    assert bench.told == []


async def test_the_goal_that_an_executor_has_taken_over_is_named(bench: Bench) -> None:
    executor = Executor("old")

    def body() -> None:
        executor.handle = Executor("new").handle
        bench.check(1.1)

    steps = bench.executor("", body)
    bench.watch.begin(steps, executor)
    steps.send(None)
    assert bench.told == [blocks("new", "1.1")]


async def test_a_step_of_another_server_is_not_named(bench: Bench) -> None:
    steps = bench.executor("a", lambda: bench.check(2))
    bench.watch.end(steps)
    steps.send(None)
    assert bench.told == []


async def test_a_step_that_ends_while_its_place_is_read_is_not_named(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_late(thread: int) -> list[Any]:
        bench.watch.current.steps = None
        return []

    monkeypatch.setattr(watchdog_module, "_places_in", read_late)
    bench.executor("a", lambda: bench.check(2)).send(None)
    assert bench.told == []


async def test_the_end_of_a_step_is_told_by_the_server_if_it_closes_first(bench: Bench) -> None:
    bench.executor("a", lambda: bench.check(2)).send(None)
    bench.now += 0.1
    bench.watch.close()
    assert bench.told == [blocks("a", "2.0"), blocked("a", "2.1")]
    bench.check()
    assert bench.told == []


async def test_checks_are_made_more_often_while_a_step_blocks(bench: Bench) -> None:
    due: list[float] = []
    bench.executor("a", lambda: due.extend((bench.check(2), bench.check(2)))).send(None)
    assert due == [POLL, POLL]


@pytest.mark.parametrize("limit", [0, math.inf])
async def test_nothing_is_watched_without_a_limit(limit: float, bench: Bench) -> None:
    bench.watch = Watch("count", limit)
    bench.watch.open()
    bench.watchdog.watches = (bench.watch,)
    bench.executor("a", lambda: bench.check(1e300)).send(None)
    bench.watch.close()
    assert bench.told == []


# The place


class Names(logging.Filter):
    """Executors that block until the log has each of some texts, which name them."""

    def __init__(self, *expected: str) -> None:
        super().__init__()
        self.texts: dict[str, str] = {}
        """The messages in which the texts were found first."""
        self._expected = expected  # the end of a block is told after it, so it ends none
        self._come = threading.Lock()  # it blocks without a frame of Python's own
        self._come.acquire()

    def __enter__(self) -> Names:
        logging.getLogger("fibaction.server").addFilter(self)
        return self

    def __exit__(self, *exc_info: object) -> None:
        logging.getLogger("fibaction.server").removeFilter(self)

    def filter(self, record: logging.LogRecord) -> bool:
        message = record.getMessage()
        found = {text: message for text in self._expected if text in message}
        if found:
            self.texts = found | self.texts
            if self._come.locked() and {"in all", *self.texts} >= set(self._expected):
                self._come.release()
        return True

    async def blocks(self, goal: GoalHandle[Goal]) -> Items:
        yield Feedback([])
        assert self._come.acquire(timeout=PATIENCE)  # in the executor
        self._come.release()
        yield Result([])

    async def calls(self, goal: GoalHandle[Goal]) -> Items:
        self._wait()  # of the call
        yield Result([])

    def _wait(self) -> None:
        assert self._come.acquire(timeout=PATIENCE)  # in what it calls

    async def awaits(self, goal: GoalHandle[Goal]) -> Items:
        await self._wait_later()  # of the await
        yield Result([])

    async def _wait_later(self) -> None:
        await checkpoint()
        assert self._come.acquire(timeout=PATIENCE)  # in what it awaits

    async def computes(self, goal: GoalHandle[Goal]) -> Items:
        while self._come.locked(): pass  # noqa: E701  # so that it has one line  # fmt: skip  # of the loop
        yield Result([])

    async def cleans_up(self, goal: GoalHandle[Goal]) -> Items:
        yield Feedback([])
        try:
            await anyio.sleep_forever()
        finally:
            assert self._come.acquire(timeout=PATIENCE)  # in the clean-up
        yield Result([])

    def returns_one(self, goal: GoalHandle[Goal]) -> Items:
        assert self._come.acquire(timeout=PATIENCE)  # in a function
        return fibonacci(goal)


PLACES = {
    "blocks": ["in the executor"],
    "calls": ["of the call", "in what it calls"],
    "awaits": ["of the await", "in what it awaits"],
    "computes": ["of the loop"],
    "cleans_up": ["in the clean-up"],
    "returns_one": ["in a function"],
}
"""For each executor the ends of the lines to be named."""


def place_of(mark: str) -> str:
    """Return the place of the line of this file that ends with a mark, as the log tells it."""
    lines = linecache.getlines(__file__)
    number, line = next(
        (number, line) for number, line in enumerate(lines, 1) if line.endswith(f"# {mark}\n")
    )
    functions = [line for line in lines[:number] if line.startswith("    ") and " def " in line]
    name = functions[-1].partition("def ")[2].partition("(")[0]
    return f"{__file__}:{number} in Names.{name}: {line.strip()}"


async def run_goal(server: ActionServer[Goal, Feedback, Result]) -> GoalID:
    """Run a goal, and cancel it at its first feedback."""
    with anyio.fail_after(PATIENCE):
        async with server, ActionClient(server, FIBONACCI).send_goal(Goal(0)) as goal:
            async for _ in goal.feedback:
                await goal.cancel()
            await goal.outcome()
            return goal.goal_id


@pytest.mark.promise("EXECUTE-12")
@pytest.mark.parametrize("executor", PLACES)
async def test_an_executor_that_blocks_is_named_with_its_line_and_the_innermost_one(
    executor: str,
) -> None:
    where = ", and in it at ".join(map(place_of, PLACES[executor]))
    with Names(where, "in all") as names:
        goal_id = await run_goal(ActionServer(FIBONACCI, getattr(names, executor), watchdog=LIMIT))
    goal = f"goal {goal_id} of action 'fibonacci'"
    assert re.fullmatch(
        f"{goal} has blocked the event loop for [0-9.]+ s so far, at {re.escape(where + ADVICE)}",
        names.texts[where],
    )
    assert re.fullmatch(
        f"{goal} blocked the event loop for [0-9.]+ s in all", names.texts["in all"]
    )


async def test_no_place_is_named_where_no_step_runs() -> None:
    assert watchdog_module._places_in(threading.get_ident()) == []
    assert watchdog_module._places_in(0) == []


@pytest.mark.parametrize(
    ("name", "value"), [("_current_frames", None), ("_is_gil_enabled", lambda: False)]
)
async def test_a_goal_is_named_without_a_place_where_frames_cannot_be_read(
    name: str, value: Any, bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, name, value, raising=False)
        bench.executor("a", lambda: bench.check(2)).send(None)
    (record,) = caplog.records
    assert record.getMessage() == f"{blocks('a', '2.0')} so far{ADVICE}"


async def test_a_line_without_source_is_named_by_its_number() -> None:
    place = watchdog_module._Place("<string>", 3, "drive")
    assert watchdog_module._text_of(place) == "<string>:3 in drive"


# The thread


async def test_executors_in_two_event_loops_are_named_at_the_same_time(
    anyio_backend_name: str,
) -> None:
    goals = [GoalID.random(), GoalID.random()]

    async def main(goal_id: GoalID) -> None:
        server = ActionServer(FIBONACCI, names.blocks, watchdog=LIMIT)
        async with server:
            follower = await server.send_goal(goal_id, FIBONACCI.goal.encode(Goal(0)))
            while await follower.receive() is not None:
                pass

    with Names(*map(str, goals)) as names:
        async with anyio.create_task_group() as tasks:
            for goal_id in goals:
                loop = partial(anyio.run, main, goal_id, backend=anyio_backend_name)
                tasks.start_soon(anyio.to_thread.run_sync, loop)


async def test_a_goal_of_a_server_that_was_idle_is_named() -> None:
    with Names("so far") as names:
        server = ActionServer(FIBONACCI, names.blocks, watchdog=LIMIT)
        async with server:
            await thread_sleeps()
            await ActionClient(server, FIBONACCI).call(Goal(0))
            await thread_sleeps()  # again


async def thread_sleeps() -> None:
    (watchdog,) = watchdogs()
    with anyio.fail_after(PATIENCE):
        while not watchdog.is_asleep:
            await checkpoint()


async def test_many_short_goals_do_not_wake_the_thread_for_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    woken: list[Watchdog] = []
    wake = Watchdog.wake

    def wake_and_tell(self: Watchdog) -> None:
        woken.append(self)
        wake(self)

    monkeypatch.setattr(Watchdog, "wake", wake_and_tell)
    async with ActionServer(FIBONACCI, fibonacci, watchdog=100) as server:
        client = ActionClient(server, FIBONACCI)
        for _ in range(100):
            await client.call(Goal(0))
    assert len(woken) == 1  # to end


async def test_all_servers_of_a_process_share_one_thread_which_ends_with_the_last() -> None:
    first, second, other = (
        ActionServer(FIBONACCI, fibonacci, watchdog=seconds) for seconds in (1, 2, 0)
    )
    async with other, ActionServer(FIBONACCI, fibonacci, watchdog=math.inf):
        assert watchdogs() == []
        async with first:
            (watchdog,) = watchdogs()
            assert watchdog.daemon
            async with second:
                assert watchdogs() == [watchdog]
            assert watchdogs() == [watchdog]
        assert watchdogs() == []
        async with ActionServer(FIBONACCI, fibonacci):
            assert watchdogs() not in ([], [watchdog])


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_the_thread_ends_with_a_server_that_is_canceled_while_it_starts() -> None:
    async def serves() -> None:
        async with ActionServer(FIBONACCI, fibonacci):
            raise AssertionError("it has started")

    task = asyncio.ensure_future(serves())
    await asyncio.sleep(0)
    assert len(watchdogs()) == 1
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert watchdogs() == []


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_the_thread_ends_at_ctrl_c(backend: str) -> None:
    async def main() -> None:
        async with ActionServer(FIBONACCI, fibonacci):
            assert len(watchdogs()) == 1
            signal.raise_signal(signal.SIGINT)
            await anyio.sleep_forever()

    with pytest.raises(KeyboardInterrupt):
        anyio.run(main, backend=backend)
    assert watchdogs() == []


async def test_a_server_closes_even_if_the_log_keeps_the_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watchdog_module, "JOIN_TIMEOUT", 0.01)
    closed = threading.Event()

    class Waits(Names):
        def filter(self, record: logging.LogRecord) -> bool:
            passes = super().filter(record)
            if isinstance(threading.current_thread(), Watchdog):
                assert closed.wait(PATIENCE)
            return passes

    with Waits("so far") as names:
        await run_goal(ActionServer(FIBONACCI, names.blocks, watchdog=LIMIT))
        (watchdog,) = watchdogs()
        closed.set()
        watchdog.join(PATIENCE)


async def test_a_process_that_was_forked_has_a_thread_of_its_own() -> None:
    ours = watchdog_module._Watchdogs()
    parents, own = Watch("parent's", 1), Watch("own", 1)
    gone = ours.add(parents)
    gone.watches = ()
    gone.wake()
    gone.join(PATIENCE)
    gone.watches = (parents,)  # as after a fork
    watchdog = ours.add(own)
    assert watchdog is not gone
    assert watchdog.watches == (own,)
    ours.remove(parents)
    assert watchdog.is_alive()
    ours.remove(own)
    ours.remove(own)


async def test_a_server_runs_where_no_thread_can_be_started(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def start(self: Watchdog) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(Watchdog, "start", start)
    async with ActionServer(FIBONACCI, fibonacci) as server:
        assert (await ActionClient(server, FIBONACCI).call(Goal(1))).sequence
    assert [record.getMessage() for record in caplog.records] == [
        (
            "goals of action 'fibonacci' that block the event loop are not named here: can't start"
            " new thread"
        )
    ]
