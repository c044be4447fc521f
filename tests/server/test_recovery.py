"""Servers that keep their goals: what they promise, seen from outside, through kills and restarts.

A kill is a store that stops writing at once, and a server that is stopped afterwards: nothing of
its end is kept or told. `tests/kills` does the same with processes and SIGKILL.
"""

from __future__ import annotations

import re
from collections.abc import AsyncGenerator
from contextlib import aclosing, asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    CancelCode,
    ConnectionLost,
    GoalAborted,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    Outcome,
    Schedule,
    SqliteStore,
    StoreError,
    TransportError,
    connect,
    serve,
)
from fibaction.client import attempts
from tests.contract.conftest import tcp_address
from tests.server.painting import PAINT, Painting, Server
from tests.support.matching import End
from tests.support.memory_store import Fate, MemoryStore
from tests.support.virtual_time import in_virtual_time

pytestmark = pytest.mark.anyio

Client: TypeAlias = ActionClient[int, int, str]

RESTARTED = End(GoalStatus.ABORTED, None, "the server was restarted")


class CutStore(MemoryStore):
    """A store whose writes fail from `cut` on, as those of a killed process."""

    def __init__(self) -> None:
        super().__init__(lambda _number, _what: Fate.FAILED if self.is_cut else Fate.KEPT)
        self.is_cut = False
        self.waits = anyio.Event()
        """Set when a write is held up."""
        self.delay = self._note_write

    def _note_write(self) -> float:
        if self.is_holding:
            self.waits.set()
        return 0.0

    def cut(self) -> None:
        """Let all writes fail from now on, and those that are held up."""
        self.is_cut = True
        self.release()


# A server that is killed and started again


class Machine:
    """A place for one server after another, at one address and with one file."""

    def __init__(self, path: Path, url: str) -> None:
        self.path = path
        self.url = url
        self.settings: Any = {"reconnect": False} if url.startswith("tcp") else {}
        """The settings of a client that gives up when its connection is lost."""
        self.store = CutStore()
        """The store of the server that runs, with the goals of those before it."""

    @asynccontextmanager
    async def life(self, executor: Any, **settings: Any) -> AsyncGenerator[Client, None]:
        """Run a server, which is killed at the end, and give a client."""
        self.store, earlier = CutStore(), self.store
        self.store.goals = earlier.goals
        server = ActionServer(PAINT, executor, store=self.store, **settings)
        with anyio.fail_after(30):
            try:
                async with serve(server, self.url):
                    async with connect(self.url, PAINT) as client:
                        try:
                            yield client
                        finally:
                            self.store.cut()
            except StoreError:
                assert self.store.is_cut


class Run(NamedTuple):
    """A call of an executor."""

    attempt: int
    restored: int | None


class Painter:
    """An executor that keeps each square meter, and waits after one of them if it is to."""

    def __init__(self, stop_at: int = 0) -> None:
        self.runs: list[Run] = []
        self.waits = anyio.Event()
        self._stop_at = stop_at

    async def __call__(self, goal: GoalHandle[int]) -> Painting:
        self.runs.append(Run(goal.attempt, goal.restored))
        done = goal.restored or 0
        while done < goal.request:
            done += 1
            await goal.checkpoint(done)
            yield done
            if done == self._stop_at:
                self.waits.set()
                await anyio.sleep_forever()
        yield f"painted {done}"


@pytest.fixture(params=["inproc", "tcp"])
def machine(request: pytest.FixtureRequest, tmp_path: Path) -> Machine:
    url = f"inproc://{tmp_path.name}" if request.param == "inproc" else tcp_address()
    return Machine(tmp_path / "goals.db", url)


@pytest.fixture
def remote(tmp_path: Path) -> Machine:
    """A machine that clients reach over a connection, which they restore."""
    return Machine(tmp_path / "goals.db", tcp_address())


async def begun(machine: Machine, painter: Painter, **settings: Any) -> GoalID:
    """Let a painter begin a goal of four square meters, kill its server, and return the ID."""
    async with machine.life(painter, **settings) as client:
        goal = await client.send_goal(4)
        await painter.waits.wait()
    return goal.goal_id


async def outcome_of(client: Client, goal_id: GoalID) -> Outcome[str]:
    """Return the outcome as a client gets it that asks now."""
    return await (await client.attach(goal_id)).outcome()


# What is told is kept


@pytest.mark.promise("KEEP-1", "KEEP-6")
async def test_a_goal_whose_acceptance_was_told_is_there_after_a_kill(machine: Machine) -> None:
    goal_id = await begun(machine, Painter(stop_at=1))
    async with machine.life(Painter()) as client:
        assert await outcome_of(client, goal_id) == RESTARTED


@pytest.mark.promise("KEEP-2")
async def test_an_end_that_was_told_is_the_same_after_kills(machine: Machine) -> None:
    async with machine.life(Painter()) as client:
        goal = await client.send_goal(3)
        end = await goal.outcome()
    assert end == End(GoalStatus.SUCCEEDED, "painted 3", "")
    for _ in range(2):
        async with machine.life(Painter()) as client:
            attached = await client.attach(goal.goal_id)
            assert (await attached.outcome(), attached.stamp) == (end, goal.stamp)


@pytest.mark.promise("KEEP-2", "CANCEL-20")
async def test_a_cancel_that_comes_while_an_end_is_written_is_too_late(machine: Machine) -> None:
    go_on = anyio.Event()
    answers: list[CancelCode] = []

    async def paint(goal: GoalHandle[int]) -> Painting:
        await go_on.wait()
        yield "painted"

    async with machine.life(paint) as client:
        goal = await client.send_goal(0)
        machine.store.hold()
        go_on.set()
        await machine.store.waits.wait()

        async def cancel() -> None:
            answers.append((await goal.cancel()).return_code)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(cancel)
            await anyio.wait_all_tasks_blocked()
            assert answers == []
            machine.store.release()
        assert (await goal.outcome()).status is GoalStatus.SUCCEEDED
    assert answers == [CancelCode.GOAL_TERMINATED]


@pytest.mark.promise("KEEP-3")
@pytest.mark.parametrize("recovery", ["abort", "rerun"])
async def test_a_goal_whose_cancel_was_accepted_is_not_run_again(
    machine: Machine, recovery: str
) -> None:
    cleans_up = anyio.Event()
    runs = 0

    async def paint(goal: GoalHandle[int]) -> Painting:
        nonlocal runs
        runs += 1
        try:
            yield 1
            await anyio.sleep_forever()
        finally:
            cleans_up.set()
            await anyio.sleep_forever()
        yield ""

    async with machine.life(paint, recovery=recovery, shutdown_timeout=0) as client:
        goal = await client.send_goal(1)
        await anext(aiter(goal.feedback))
        assert (await goal.cancel()).accepted
        await cleans_up.wait()
    async with machine.life(paint, recovery=recovery) as client:
        outcome = await outcome_of(client, goal.goal_id)
    assert outcome == End(GoalStatus.CANCELED, None, "the server was restarted")
    assert runs == 1


# Checkpoints


@pytest.mark.promise("KEEP-4", "KEEP-6")
async def test_an_executor_goes_on_from_its_last_checkpoint(machine: Machine) -> None:
    painter = Painter(stop_at=3)
    goal_id = await begun(machine, painter, recovery="rerun")
    async with machine.life(painter, recovery="rerun") as client:
        outcome = await outcome_of(client, goal_id)
    assert outcome == End(GoalStatus.SUCCEEDED, "painted 4", "")
    assert painter.runs == [Run(1, None), Run(2, 3)]


@pytest.mark.promise("KEEP-4")
@pytest.mark.parametrize("is_kept", [True, False])
async def test_a_checkpoint_of_another_type_is_an_error_of_the_executor(
    tmp_path: Path, is_kept: bool
) -> None:
    async def paint(goal: GoalHandle[int]) -> Painting:
        await goal.checkpoint("three")
        yield ""

    store = SqliteStore(tmp_path / "goals.db") if is_kept else None
    async with ActionServer(PAINT, paint, store=store) as server:
        goal = await ActionClient(server, PAINT).send_goal(1)
        outcome = await goal.outcome()
    assert outcome.status is GoalStatus.ABORTED
    assert outcome.reason.startswith("TypeError: ")


# IDs


@pytest.mark.promise("KEEP-5")
async def test_a_goal_that_is_sent_again_after_a_kill_gets_the_first_answer(
    machine: Machine,
) -> None:
    painter = Painter()
    async with machine.life(painter) as client:
        first = await client.send_goal(2)
        await first.outcome()
    async with machine.life(painter) as client:
        again = await client.send_goal(2, goal_id=first.goal_id)
        assert again.stamp == first.stamp
        assert await again.result() == "painted 2"
        with pytest.raises(GoalRejected, match="its ID is in use by another goal"):
            await client.send_goal(3, goal_id=first.goal_id)
    assert len(painter.runs) == 1


# What becomes of goals that were active


@pytest.mark.promise("KEEP-6")
async def test_the_server_asks_your_function_what_becomes_of_a_goal(machine: Machine) -> None:
    asked: list[tuple[int, int, int | None]] = []

    async def keep_on(goal: GoalHandle[int]) -> None:
        asked.append((goal.request, goal.attempt, goal.restored))

    painter = Painter(stop_at=2)
    goal_id = await begun(machine, painter, recovery=keep_on)
    assert asked == []
    async with machine.life(painter, recovery=keep_on) as client:
        assert (await outcome_of(client, goal_id)).result == "painted 4"
    assert [(request, restored) for request, _, restored in asked] == [(4, 2)]
    assert painter.runs[1] == Run(2, 2)


@pytest.mark.promise("KEEP-6")
async def test_your_function_ends_a_goal_with_a_reason_and_a_result(machine: Machine) -> None:
    def give_up(goal: GoalHandle[int]) -> None:
        raise GoalAborted("the paint is dry", result=f"painted {goal.restored}")

    painter = Painter(stop_at=2)
    goal_id = await begun(machine, painter, recovery=give_up)
    async with machine.life(painter, recovery=give_up) as client:
        outcome = await outcome_of(client, goal_id)
    assert outcome == End(GoalStatus.ABORTED, "painted 2", "the paint is dry")
    assert len(painter.runs) == 1


@pytest.mark.promise("KEEP-6")
async def test_goals_that_waited_for_their_turn_are_run_in_any_case_and_in_order(
    machine: Machine,
) -> None:
    schedule = Schedule(concurrency=1, queue=3)
    painter = Painter(stop_at=2)
    async with machine.life(painter, schedule=schedule) as client:
        first = await client.send_goal(4)
        waiting = [await client.send_goal(1) for _ in range(3)]
        await painter.waits.wait()
    order: list[GoalID] = []

    async def paint(goal: GoalHandle[int]) -> Painting:
        order.append(goal.goal_id)
        yield f"attempt {goal.attempt}"

    async with machine.life(paint, schedule=schedule) as client:
        assert await outcome_of(client, first.goal_id) == RESTARTED
        for goal in waiting:
            assert (await outcome_of(client, goal.goal_id)).result == "attempt 1"
    assert order == [goal.goal_id for goal in waiting]


@pytest.mark.promise("KEEP-6")
async def test_attempts_that_bring_a_goal_further_are_not_counted(machine: Machine) -> None:
    settings: dict[str, Any] = {"recovery": "rerun", "max_attempts": 2}
    goal_id = await begun(machine, Painter(stop_at=1), **settings)
    for stroke in (2, 3):
        painter = Painter(stop_at=stroke)
        async with machine.life(painter, **settings):
            await painter.waits.wait()
    async with machine.life(Painter(), **settings) as client:
        outcome = await outcome_of(client, goal_id)
    assert outcome == End(GoalStatus.SUCCEEDED, "painted 4", "")


@pytest.mark.promise("KEEP-6", "STOP-3")
@pytest.mark.parametrize("recovery", ["abort", "rerun"])
async def test_a_planned_restart_keeps_goals_and_counts_no_attempt_as_lost(
    remote: Machine, recovery: Any
) -> None:
    settings: dict[str, Any] = {"recovery": recovery, "max_attempts": 1, "at_stop": "keep"}
    painter = Painter(stop_at=2)
    async with connect_later(remote) as client:
        async with serving(remote, painter, **settings):
            await client.wait_for_server()
            goal = await client.send_goal(4)
            await painter.waits.wait()
        async with serving(remote, painter, **settings):
            assert await goal.result() == "painted 4"
            assert goal.attempt == 2
    assert painter.runs == [Run(1, None), Run(2, 2)]


@pytest.mark.promise("KEEP-6")
async def test_an_executor_that_yields_its_result_while_a_server_stops_has_succeeded(
    remote: Machine,
) -> None:
    runs = anyio.Event()

    async def paint(goal: GoalHandle[int]) -> Painting:
        runs.set()
        try:
            await anyio.sleep_forever()
        except anyio.get_cancelled_exc_class():
            yield "just done"

    async with connect_later(remote) as client:
        async with serving(remote, paint, at_stop="keep"):
            await client.wait_for_server()
            goal = await client.send_goal(4)
            await runs.wait()
        assert await goal.result() == "just done"


@pytest.mark.promise("KEEP-6")
async def test_an_executor_that_runs_again_can_be_a_client_of_its_own_server(
    machine: Machine,
) -> None:
    async def paint(goal: GoalHandle[int]) -> Painting:
        if goal.request == 1:
            yield "painted 1"
            return
        async with connect(machine.url, PAINT, **machine.settings) as own:
            yield await own.call(1)

    goal_id = await begun(machine, Painter(stop_at=2))
    async with machine.life(paint, recovery="rerun") as client:
        assert await outcome_of(client, goal_id) == End(GoalStatus.SUCCEEDED, "painted 1")


@pytest.mark.promise("KEEP-6")
async def test_no_executor_runs_at_a_server_whose_address_is_in_use(machine: Machine) -> None:
    goal_id = await begun(machine, painter := Painter(stop_at=2))
    store = MemoryStore()
    store.goals = machine.store.goals
    server = ActionServer(PAINT, painter, store=store, recovery="rerun", at_stop="keep")
    with anyio.fail_after(5):
        async with serve(ActionServer(PAINT, painter), machine.url):
            with pytest.raises(TransportError, match=r"in use|already served"):
                async with serve(server, machine.url):
                    pass
    assert painter.runs == [Run(1, None)]
    machine.store.goals = store.goals
    async with machine.life(Painter(), recovery="rerun", max_attempts=2) as client:
        assert (await outcome_of(client, goal_id)).result == "painted 4"


# Clients


@asynccontextmanager
async def serving(machine: Machine, executor: Any, **settings: Any) -> AsyncGenerator[Server, None]:
    """Run a server that is stopped in good order at the end."""
    server: Server = ActionServer(PAINT, executor, store=SqliteStore(machine.path), **settings)
    async with serve(server, machine.url):
        yield server


@asynccontextmanager
async def connect_later(machine: Machine) -> AsyncGenerator[Client, None]:
    """Give a client of a server that may not be there yet, and that it outlives."""
    with anyio.fail_after(15):
        async with connect(machine.url, PAINT, heartbeat=0.5) as client:
            yield client


class Awaited(Painter):
    """A painter that begins the second attempt when it is told to."""

    def __init__(self, stop_at: int = 0) -> None:
        super().__init__(stop_at)
        self.go_on = anyio.Event()

    async def __call__(self, goal: GoalHandle[int]) -> Painting:
        if goal.attempt > 1:
            await self.go_on.wait()
        async with aclosing(super().__call__(goal)) as painting:
            async for item in painting:
                yield item

    async def meet(self, client: Client) -> None:
        """Go on when a client follows its goals again."""
        await client.wait_for_server()
        await client.goals()  # answered behind what the client has sent before
        self.go_on.set()


@pytest.mark.promise("KEEP-7", "LOSS-3")
async def test_a_client_that_waits_goes_on_with_the_next_attempt(remote: Machine) -> None:
    painter = Awaited(stop_at=2)
    seen: list[tuple[int, int]] = []
    async with connect_later(remote) as client:
        async with remote.life(painter, recovery="rerun"):
            await client.wait_for_server()
            goal = await client.send_goal(4)
            feedback = aiter(goal.feedback)
            for _ in range(2):
                done = await anext(feedback)
                seen.append((goal.attempt, done))
        async with remote.life(painter, recovery="rerun"):
            await painter.meet(client)
            seen += [(goal.attempt, done) async for done in feedback]
            assert await goal.result() == "painted 4"
    assert seen == [(1, 1), (1, 2), (2, 3), (2, 4)]
    assert goal.feedback_dropped == 0


class Quick(Awaited):
    """A painter whose second attempt keeps nothing, and so is faster than its client reads."""

    async def __call__(self, goal: GoalHandle[int]) -> Painting:
        if goal.attempt > 1:
            await self.go_on.wait()
            for done in range(2, goal.request + 1):
                yield done
            yield f"painted {goal.request}"
            return
        async with aclosing(super().__call__(goal)) as painting:
            async for item in painting:
                yield item


@pytest.mark.promise("KEEP-7", "FEEDBACK-3")
async def test_a_goal_still_belongs_to_its_client_after_a_restart(remote: Machine) -> None:
    painter = Quick(stop_at=1)
    settings: dict[str, Any] = {"recovery": "rerun", "feedback_window": 4}
    async with connect_later(remote) as client:
        async with remote.life(painter, **settings):
            await client.wait_for_server()
            goal = await client.send_goal(1000)
            await painter.waits.wait()
        async with remote.life(painter, **settings):
            await painter.meet(client)
            seen = [done async for done in goal.feedback]
            assert await goal.result() == "painted 1000"
    # An observer would have lost most of it.
    assert seen[-999:] == list(range(2, 1001))
    assert goal.feedback_dropped == 0


@pytest.mark.promise("KEEP-7")
async def test_a_client_is_told_that_another_server_has_its_goal_and_stays_connected(
    remote: Machine,
) -> None:
    store = MemoryStore()
    painter = Painter(stop_at=1)
    with anyio.fail_after(10):
        async with serve(ActionServer(PAINT, painter, store=store), remote.url):
            async with connect(remote.url, PAINT) as client:
                goal = await client.send_goal(4)
                await painter.waits.wait()
                store.take("paint", goal.goal_id)
                with pytest.raises(ConnectionLost, match="another server has taken the goal over"):
                    await goal.result()
                store.fate = lambda _number, _what: Fate.TAKEN
                with pytest.raises(ConnectionLost, match="another server has taken the goal over"):
                    await client.send_goal(4)
                store.fate = lambda _number, _what: Fate.KEPT
                assert await client.call(0) == "painted 0"


# A store that cannot be used


@pytest.fixture
def leaving_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a client leave soon a server that answers nothing any more."""
    monkeypatch.setattr(attempts, "LEAVE_TIMEOUT", 0.05)


@pytest.mark.promise("KEEP-8")
@pytest.mark.usefixtures("leaving_soon")
async def test_if_nothing_can_be_written_nothing_is_told_and_the_server_stops(
    machine: Machine,
) -> None:
    store = CutStore()
    painter = Painter(stop_at=1)
    with anyio.fail_after(10), pytest.raises(StoreError, match="broken"):
        async with serve(ActionServer(PAINT, painter, store=store), machine.url):
            async with connect(machine.url, PAINT, **machine.settings) as client:
                goal = await client.send_goal(4)
                await painter.waits.wait()
                store.cut()
                with pytest.raises(ConnectionLost):
                    await client.send_goal(1)
                with pytest.raises(ConnectionLost):
                    await goal.outcome()
                await anyio.sleep_forever()
    assert painter.runs == [Run(1, None)]


@in_virtual_time()
async def test_a_kept_goal_has_all_its_time_from_when_clients_can_reach_the_server() -> None:
    store, settings = MemoryStore(), {"at_stop": "keep", "shutdown_timeout": 1.0}
    first: Server = ActionServer(PAINT, Painter(stop_at=1), store=store, **settings)  # type: ignore[arg-type]  # mypy does not see what the settings are
    async with first:
        sent = await ActionClient(first, PAINT).send_goal(2)
    schedule = Schedule(concurrency=1, run_timeout=10)
    second = ActionServer(PAINT, Painter(), store=store, schedule=schedule)
    second.hold_executors()
    async with second:
        goal = await ActionClient(second, PAINT).attach(sent.goal_id)
        await anyio.sleep(60)  # of virtual time: the address is in use, say
        second.start_executors()
        assert await goal.result() == "painted 2"


@pytest.mark.promise("KEEP-9")
async def test_a_store_that_is_in_use_cannot_be_opened_again(tmp_path: Path) -> None:
    path = tmp_path / "goals.db"
    async with ActionServer(PAINT, Painter(), store=SqliteStore(path)) as server:
        with pytest.raises(StoreError, match=re.escape(str(path))):
            async with ActionServer(PAINT, Painter(), store=SqliteStore(path)):
                raise AssertionError("two servers use one file")
        assert await ActionClient(server, PAINT).call(1) == "painted 1"
