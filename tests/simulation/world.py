"""A world for one scenario: the real server, client and wire code, in virtual time.

It sets up what the scenario plans, runs it, and checks what is left at the end. The product is the
real one down to its connections; its `machine` is made from the seed. The rules are in
`invariants`.
"""

from __future__ import annotations

import gc
import hashlib
import itertools
import math
import random
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import anyio
import msgspec
from anyio import CancelScope, create_task_group, current_time
from anyio.abc import TaskGroup

from fibaction import ActionError, ActionServer, serve
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.wire.auth import Peer, Permission
from fibaction.wire.server.session import Session
from fibaction.wire.settings import ClientSettings, Limits, WireSettings
from fibaction.wire.wire_server import WireServer
from fibaction.words.errors import StoreError
from tests.simulation import loop as virtual
from tests.simulation.clients import Client
from tests.simulation.custody import excesses, holders, left_for_clients, left_without_clients
from tests.simulation.executors import (
    decide_cancel,
    decide_cancel_later,
    decide_goal,
    decide_goal_later,
    executor_for,
    recover,
    recover_later,
)
from tests.simulation.facts import HONEST_TOKEN, HOSTILE_TOKEN, Life
from tests.simulation.hostile import Hostile
from tests.simulation.hostile_generator import last_attack_of
from tests.simulation.invariants import Record, Violation
from tests.simulation.machine import made_up
from tests.simulation.network import Line, Network
from tests.simulation.scenario import SIMULATED, Done, Fault, Scenario, Step, StorePlan, Work
from tests.simulation.streams import Manner
from tests.simulation.transport import SimulatedTransport
from tests.simulation.witness import listening, lost, recorded
from tests.support.memory_store import Fate, MemoryStore

PATIENCE = 900.0
"""Seconds that a run may take after the last fault: several times the longest timeout."""


CHECKED = 0.1
"""Seconds between two looks at what a server holds for clients that have sent no message."""
EMPTY_WITHIN = 90.0
"""Seconds after which a server without clients has nothing left of them: four heartbeats of the
longest that it grants, and some."""


class Report(msgspec.Struct, frozen=True):
    """The report of a run."""

    scenario: Scenario
    violations: list[Violation]
    trace: list[str]
    goals: int
    connections: int
    cuts: int
    restarts: int
    seconds: float
    """Virtual seconds of the run."""
    places: dict[str, int]
    """The number of events of schedules, for each kind."""
    crashes: dict[str, int]
    """The number of faults of the store, for each kind."""
    checks: dict[str, int]
    """The number of checks of the rules of stores, for each kind."""

    @property
    def digest(self) -> str:
        """The digest of the trace, equal for equal runs."""
        return hashlib.sha256("\n".join(self.trace).encode()).hexdigest()


class _Hopeless(Exception):
    """A wait of the run that took too long."""


class World:
    """The run of one scenario."""

    def __init__(self, scenario: Scenario, loop: virtual.VirtualLoop) -> None:
        self.scenario = scenario
        self.record = Record(scenario, lambda: loop.now - virtual.EPOCH)
        self.network = Network(loop, random.Random(f"network {scenario.seed}"), self.record.tell)
        self.hub: WireServer | None = None
        plan = scenario.server
        self.limits = Limits(
            connections=plan.connections,
            queue=plan.queue,
            goals=plan.goals,
            follows=plan.follows,
            requests=plan.requests,
        )
        self._loop = loop
        self._store = None if plan.store is None else self._new_store(plan.store)
        self._writes: Counter[str] = Counter()
        """The number of writes to the store, for each method, and of all."""
        self.crashes: Counter[str] = Counter()
        """The number of faults of the store, for each kind."""
        self._is_ending = False
        self._server: ActionServer[Work, Step, Done] | None = None
        self._life_scope: CancelScope
        self._stop = anyio.Event()
        self._lines = [self.network.line(plan.name, plan.weather) for plan in scenario.clients]
        self._clients = [
            Client(self.record, plan, self._client_transport(line, number))
            for number, (plan, line) in enumerate(zip(scenario.clients, self._lines, strict=True))
        ]
        self._hostile = [
            Hostile(
                self.record,
                plan,
                self.network.line(plan.name, plan.weather),
                lambda number: self._clients[number % len(self._clients)].session(),
            )
            for plan in scenario.hostile
        ]
        self._lives = 0
        """The number of servers that have not stopped, those included that have crashed."""
        self._tasks: TaskGroup

    def _client_transport(self, line: Line, number: int) -> SimulatedTransport:
        plan = self.scenario.clients[number]
        keeping = ClientSettings(
            heartbeat=plan.heartbeat,
            reconnect=plan.reconnect,
            reconnect_timeout=plan.reconnect_timeout,
            window=plan.window,
            token=HONEST_TOKEN if self.scenario.server.asks_for_tokens else "",
        )
        calls_back = self.scenario.calls_back
        return SimulatedTransport(self.network, line, keeping, calls_back=calls_back)

    def on_hub(self, opened: WireServer) -> None:
        """Keep the wire server that an action server has opened."""
        self.hub = opened

    async def _check_often(self) -> None:
        """Check what is held for all clients, and the places of goals."""
        while not all(hostile.has_left for hostile in self._hostile) or self._lives:
            self._check_now()
            await anyio.sleep(CHECKED)

    def _check_now(self) -> None:
        # In a frame of its own, which does not hold the last session while the time passes.
        for life in self.record.lives[-1:]:
            self.record.places.check(life)
        for session in self.hub._sessions if self.hub is not None else ():
            self.on_message(session)

    def on_message(self, session: Session) -> None:
        """Check what is held for a client that has sent a message."""
        for excess in excesses(session, self.limits):
            self.record.fail("held", f"for {session._link.peer}: {excess}")

    def on_hold(self, log: FeedbackLog[Any]) -> None:
        """Check for whom the executor of a goal is about to wait."""
        assert self.hub is not None
        truth = self.record.truth(log.goal.goal_id, log.goal.stamp)
        if truth is None:
            return
        for session in self.hub._sessions:
            peer = session._link.peer
            name = peer.partition(":")[0]
            is_other = name not in truth.sender
            if is_other and any(stream._log is log for stream in holders(session)):
                self.record.fail("hold", f"a goal of {truth.sender} waits for {peer}")

    # The servers

    def _new_server(self) -> ActionServer[Work, Step, Done]:
        plan = self.scenario.server
        on_goal = {"none": None, "sync": decide_goal, "async": decide_goal_later}
        on_cancel = {"none": None, "sync": decide_cancel, "async": decide_cancel_later}
        return ActionServer(
            SIMULATED,
            executor_for(self.record, len(self.record.lives)),
            on_goal=on_goal[plan.on_goal],
            on_cancel=on_cancel[plan.on_cancel],
            interrupt_on_cancel=plan.interrupt_on_cancel,
            feedback=plan.feedback,
            feedback_window=plan.feedback_window,
            stall_timeout=plan.stall_timeout,
            result_timeout=plan.result_timeout,
            max_results=plan.max_results,
            shutdown_timeout=plan.shutdown_timeout,
            schedule=None if plan.schedule is None else plan.schedule.schedule(),
            store=self._store,
            recovery=self._recovery(),
            max_attempts=(plan.store or StorePlan()).max_attempts,
            at_stop=(plan.store or StorePlan()).at_stop,
            watchdog=0,  # its thread reads the real clock, by which a run may be stopped for long
        )

    def _server_transport(self, life: Life) -> SimulatedTransport:
        plan = self.scenario.server

        may = {hostile.name: hostile.may for hostile in self.scenario.hostile}

        def decide(peer: Peer, _action: str, permission: Permission) -> bool:
            return permission in may.get(peer.address.partition(":")[0], Permission)

        async def decide_later(peer: Peer, action: str, permission: Permission) -> bool:
            await anyio.sleep(0.002)
            return decide(peer, action, permission)

        rules: dict[str, Any] = {"open": None, "sync": decide, "async": decide_later}
        tokens = {HONEST_TOKEN: "honest", HOSTILE_TOKEN: "hostile"}
        terms = WireSettings(
            heartbeat=plan.heartbeat,
            limits=self.limits,
            tokens=tokens if plan.asks_for_tokens else None,
            authorize=rules[plan.authorize],
            orphans=plan.orphans,
            grace=plan.grace,
        )
        return SimulatedTransport(
            self.network,
            terms=terms,
            calls_back=self.scenario.calls_back,
            is_alive=lambda: not life.is_dead,
        )

    async def _live(self, after: float) -> None:
        """Run a server, from its start until it is stopped or killed."""
        self._lives += 1
        await anyio.sleep(after)
        store, host = self._store, self.network.host
        if store is not None:
            await self._until(
                lambda: not store.journals and host.listener is None, "the server before to stop"
            )
        server = self._new_server()
        self._stop = anyio.Event()
        stop = self._stop
        with CancelScope() as self._life_scope:
            self._server = server

            def owns(part: object) -> bool:
                return part is server._dispatcher or part is server._parts.runs._registry

            life = Life(len(self.record.lives) + 1, self.record.now(), owns)
            self.record.lives.append(life)
            self.record.tell(f"server {life.number} starts")
            try:
                async with serve(server, self._server_transport(life)):
                    await stop.wait()
                life.is_orderly = not life.is_dead
            except StoreError as error:
                self.record.tell(f"server {life.number} fails: {error}")
                self._end_life(life)
        self.record.tell(f"server {life.number} has stopped")
        self._lives -= 1
        if server._parts.runs and not life.is_dead:
            self.record.fail("rest", f"goals run on in a server that has stopped: {server!r}")

    async def _restart(self, fault: Fault) -> None:
        """Stop or crash this server, and start another one, which has no goals."""
        if not self._is_served:
            return
        self.record.lives[-1].stops_at = self.record.now()
        if fault.kind == "crash":
            self._die(fault.manner)
        else:
            self._stop.set()
            await self._until(lambda: self.network.host.listener is None, "the server to close")
        self._tasks.start_soon(self._live, fault.seconds)

    def _die(self, manner: Manner) -> None:
        """End the process of the server at once."""
        # Its connections are cut first, so the clean-up of its tasks reaches no client.
        self.network.host.die(manner)
        if self._store is not None:
            self.record.lives[-1].is_dead = True
            assert self.scenario.server.store is not None
            self._store.die(self.scenario.server.store.survivors)
            self._store.bury()
        self._life_scope.cancel()

    # The store

    def _new_store(self, plan: StorePlan) -> MemoryStore:
        store = MemoryStore(self._fate, clock=lambda: virtual.PAST + int(self._loop.now * 1e9))
        delays = itertools.cycle(plan.delays)
        store.delay = lambda: next(delays)
        store.on_kept = self.record.keeping.kept
        store.on_claim = self.record.keeping.claimed
        store.on_forget = self.record.keeping.forgotten
        store.on_death = self._on_death
        return store

    def _recovery(self) -> Any:
        plan = self.scenario.server.store or StorePlan()
        return {"sync": recover, "async": recover_later}.get(plan.recovery, plan.recovery)

    def _fate(self, _number: int, what: str) -> Fate:
        assert self.scenario.server.store is not None
        if self._is_ending:
            return Fate.KEPT
        self._writes[what] += 1
        self._writes[""] += 1
        for fault in self.scenario.server.store.faults:
            if fault.number == self._writes[fault.what] and fault.what in ("", what):
                self.record.tell(f"FAULT {fault.fate.value} {what}")
                self.crashes[f"{fault.fate.value} {what}"] += 1
                if fault.fate in (Fate.FAILED, Fate.DOUBTFUL):
                    self._end_life(self.record.lives[-1])
                return fault.fate
        return Fate.KEPT

    def _on_death(self) -> None:
        life = self.record.lives[-1]
        self._end_life(life)
        self._die("reset")

    def _end_life(self, life: Life) -> None:
        """Start the next server after a while, unless another part of the run does."""
        if life.stops_at == math.inf and not self._is_ending:
            assert self.scenario.server.store is not None
            life.stops_at = self.record.now()
            self._tasks.start_soon(self._live, self.scenario.server.store.away)

    # What goes wrong

    async def _fail_as_planned(self) -> None:
        for fault in self.scenario.faults:
            await anyio.sleep_until(virtual.EPOCH + fault.at)
            line = self._lines[fault.client % len(self._lines)]
            self.record.tell(f"FAULT {fault.kind} {line.name} {fault.manner} {fault.seconds:g}")
            if fault.kind in ("restart", "crash"):
                await self._restart(fault)
            elif fault.kind == "cut":
                line.cut(fault.manner)
            elif fault.kind == "half-close":
                line.half_close(fault.directions[0])
            elif fault.kind == "freeze":
                line.freeze(fault.seconds, *fault.directions)
            elif fault.kind == "stale":
                line.freeze(fault.seconds, *fault.directions, new_too=False)
            elif fault.kind == "reject":
                line.rejects_until = current_time() + fault.seconds
                line.cut(fault.manner)
            else:
                line.dies_at_once = 2
                line.cut(fault.manner)

    async def _be_a_client(self, client: Client, line: Line) -> None:
        dies_at = current_time() + client.plan.starts_at + client.plan.dies_at
        with CancelScope() as scope:
            async with create_task_group() as tasks:
                tasks.start_soon(self._let_die, dies_at, client, line, scope)
                await client.run()
                tasks.cancel_scope.cancel()
        client.is_done = client.has_left = True

    async def _let_die(self, at: float, client: Client, line: Line, scope: CancelScope) -> None:
        if at == math.inf:
            return
        await anyio.sleep_until(at)
        self.record.tell(f"FAULT {client.plan.name} dies")
        client.state.is_leaving = True
        for goal_id in client.state.goals:
            self.record.may_cancel(goal_id)
        line.die()
        scope.cancel()

    # The whole

    async def run(self) -> None:
        """Run the scenario, and check what is left at the end."""
        async with create_task_group() as self._tasks:
            self._tasks.start_soon(self._live, self.scenario.server_at)
            for client, line in zip(self._clients, self._lines, strict=True):
                self._tasks.start_soon(self._be_a_client, client, line)
            for hostile in self._hostile:
                self._tasks.start_soon(hostile.run)
            self._tasks.start_soon(self._check_often)
            async with create_task_group() as faults:
                faults.start_soon(self._fail_as_planned)
                await self._until_all_is_done()
            for hostile in self._hostile:
                hostile.may_leave.set()
            await self._until(lambda: all(one.has_left for one in self._hostile), "to leave")
            await self._until_nothing_is_left()
            await self._end()
        for task in virtual.waiting_tasks():
            self.record.fail("rest", f"a task is left: {task}")
        for end in self.network.open_ends():
            self.record.fail("rest", f"a connection is left open: {end}")
        if left := self._left_by_goals():
            self.record.fail("rest", f"left when all have gone: {left}")
        self.record.over()

    @property
    def _is_served(self) -> bool:
        return bool(self.record.lives) and self.record.lives[-1].stops_at == math.inf

    async def _until_all_is_done(self) -> None:
        scenario = self.scenario
        last = max((fault.at + 1 for fault in scenario.faults), default=0.0)
        for plan in scenario.clients:
            last = max(last, *(plan.starts_at + deed.at + 1 for deed in plan.deeds))
        last = max(last, scenario.server_at, *map(last_attack_of, scenario.hostile))
        await anyio.sleep_until(virtual.EPOCH + last)
        give_up_at = current_time() + PATIENCE
        while not self._is_quiet():
            if current_time() >= give_up_at:
                self._give_up()
            # Long goals are canceled, so that the run ends.
            if self._is_served and self._server is not None:
                self.record.may_cancel(None)
                with suppress(ActionError):  # its store may fail just now
                    await self._server.cancel_goals()
            await anyio.sleep(2)

    def _is_quiet(self) -> bool:
        is_idle = self._server is not None and self._is_served and not self._server._parts.runs
        are_done = all(client.is_done for client in self._clients)
        return is_idle and are_done and all(hostile.is_done for hostile in self._hostile)

    def _give_up(self) -> None:
        for client in self._clients:
            for deed, since in client.under_way.items():
                at = since - virtual.EPOCH
                text = f"{client.plan.name} still waits for {deed.kind!r}, begun at {at:.6f}"
                self.record.fail("answer", text)
        raise _Hopeless("\n".join(["tasks still wait:", *virtual.waiting_tasks()]))

    async def _until_nothing_is_left(self) -> None:
        """Wait until nothing is kept for clients, which are all done."""
        give_up_at = current_time() + 4 * 60
        while left := self._left_by_goals():
            gc.collect()  # a goal is released when its reader is collected
            if current_time() >= give_up_at:
                self.record.fail("rest", f"left when all is done: {left}")
                return
            await anyio.sleep(2)

    def _left_by_goals(self) -> list[str]:
        left: list[str] = []
        if self.hub is not None:
            left += left_for_clients(self.hub)
        for client in self._clients:
            left += (f"a call of {client.plan.name}: {one}" for one in client.calls())
        return left

    async def _end(self) -> None:
        """Let the clients and the server leave, in an order that depends on the seed."""
        self._is_ending = True
        if self.scenario.seed % 2:
            await self._stop_server()
        for client in self._clients:
            client.may_leave.set()
        await self._until(lambda: all(client.has_left for client in self._clients), "to leave")
        await self._until_server_is_empty()
        await self._stop_server()

    async def _until_server_is_empty(self) -> None:
        """Wait until the server has nothing, now that all clients have left."""
        if self.hub is None or self._server is None or not self._is_served:
            return
        hub, server = self.hub, self._server
        give_up_at = current_time() + EMPTY_WITHIN
        while left := list(left_without_clients(hub, server)):
            gc.collect()  # bytes are counted until the last that has them is collected
            if current_time() >= give_up_at:
                self.record.fail("rest", f"left when all clients have gone: {left}")
                return
            await anyio.sleep(1)

    async def _stop_server(self) -> None:
        if self._is_served:
            self.record.lives[-1].stops_at = self.record.now()
        self._stop.set()
        await self._until(lambda: not self._lives, "the server to stop")

    async def _until(self, is_so: Callable[[], bool], what: str) -> None:
        give_up_at = current_time() + 60
        while not is_so():
            if current_time() >= give_up_at:
                waiting = "\n".join(virtual.waiting_tasks())
                raise _Hopeless(f"waited in vain for {what}:\n{waiting}")
            await anyio.sleep(0.01)


def simulate(scenario: Scenario) -> Report:
    """Run a scenario, and return its report."""
    loop = virtual.VirtualLoop(longest=20_000, most_turns=1_000_000)
    world = World(scenario, loop)
    record = world.record
    with (
        listening(record),
        made_up(loop, scenario.seed),
        recorded(record, world.on_hub, world.on_message, world.on_hold),
    ):
        try:
            virtual.run(world.run, loop, lambda context: lost(record, context))
        except* (virtual.Deadlock, virtual.Livelock, _Hopeless) as group:
            for error in _leaves(group):
                record.fail("answer", f"{type(error).__name__}: {error}")
        except* Exception as group:
            for error in _leaves(group):
                record.fail("log", "".join(traceback.format_exception(error)))
    return Report(
        scenario=scenario,
        violations=record.violations,
        trace=[f"{at:.6f} {text}" for at, text in record.trace],
        goals=sum(len(life.goals) for life in record.lives),
        connections=world.network.opened,
        cuts=world.network.cuts,
        restarts=max(0, len(record.lives) - 1),
        seconds=loop.now - virtual.EPOCH,
        places=record.places.counts,
        crashes=dict(world.crashes),
        checks=dict(record.keeping.counts),
    )


def _leaves(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [leaf for inner in error.exceptions for leaf in _leaves(inner)]
    return [error]
