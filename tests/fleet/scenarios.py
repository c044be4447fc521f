"""The runs: what is killed or frozen while clients use a fleet, and the report of each."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import anyio
import msgspec

from tests.fleet.clients import PATIENCE, Crowd, Load, crowd
from tests.fleet.servers import Servers, servers
from tests.fleet.verdict import (
    Case,
    Handover,
    Rules,
    faults_of,
    faults_of_keys,
    handover,
    key_pauses,
    longest_pause,
    moves,
    unseen,
)
from tests.fleet.witness import Witness, Write, witness
from tests.fleet.workers import Crew, Setup, WorkerProcess, workers
from tests.kills.clients import settle
from tests.kills.ledger import Ledger, attempts_of
from tests.kills.victim import entries_of

FLEET = "trial"
ROUNDS = 6
"""How many times a worker is killed and another one stopped in the chaos."""
GRACE = 2.0
"""Seconds after the end of a lease within which the goals of a lost worker are safe."""
AWAY = 8.0
"""Seconds for which one broker of three is away, longer than the others need to replace it."""
PAUSE = 30.0
"""Seconds that a fleet may stand still when one broker of three is killed. The two others wait for
4 to 9 s before one of them asks to lead, and as long again if both have asked at once."""


class Run(msgspec.Struct, frozen=True):
    """The settings of a run."""

    recovery: Literal["abort", "rerun"]
    load: Load
    lease: float | None = None
    """Seconds; None for the default."""
    seed: int = 1
    stream: Literal["goals", "workers"] = "goals"
    """The stream whose leader is killed."""
    limit: int = 0
    """The goals of each key that may run in the whole fleet; 0 for any number."""


class Report(msgspec.Struct):
    """The figures of a run, and the contradictions."""

    scenario: str
    recovery: str
    goals: int
    """The number of goals whose acceptance was told."""
    answered: int
    """The number of goals whose end was told to the client that has sent them."""
    ends: Mapping[str, int]
    writes: int
    """The number of records that the brokers have stored."""
    unseen_writes: int
    moves: int
    """How many times a worker took a goal from another."""
    attempts: Mapping[int, int]
    dropped_feedback: int
    longest_pause: float
    """The most seconds between two records."""
    rejoined: list[str]
    """The workers that were fenced, and have joined the fleet again."""
    handovers: Mapping[str, Handover]
    key_pauses: Mapping[str, Mapping[int, float]]
    """For each lost worker and each key that a goal of it had, the seconds until the next one."""
    seconds: float
    faults: list[str]


class Scene(NamedTuple):
    """A fleet at work."""

    servers: Servers
    witness: Witness
    workers: Crew
    crowd: Crowd
    run: Run

    @property
    def lease(self) -> float:
        """The seconds of a lease."""
        default = 5.0 if len(self.servers.by_name) == 1 else 15.0
        return default if self.run.lease is None else self.run.lease


class Loss(NamedTuple):
    """A worker that has lost its goals."""

    worker: str
    at: float
    """Time of the loss: seconds since 1970."""
    within: float
    """Seconds after which all of them are safe."""
    is_released: bool = False


Act: TypeAlias = Callable[[Scene], Awaitable[list[Loss]]]
"""Does the harm, and returns the workers that have lost their goals by it."""


# The scenarios


async def lose_workers(scene: Scene) -> list[Loss]:
    """Kill a worker, and freeze another for longer than its lease."""
    killed, frozen, _ = scene.workers
    if scene.run.limit:
        await _begins_a_goal(killed)
    losses = [Loss(one.name, time.time(), scene.lease + GRACE) for one in (killed, frozen)]
    killed.kill()
    frozen.freeze()
    scene.crowd.go_on()
    await anyio.sleep(scene.lease * 1.5 + 1)
    frozen.thaw()
    return losses


async def _begins_a_goal(worker: WorkerProcess) -> None:
    """Wait until a worker has just begun a goal, which is some time after its acceptance: in a new
    fleet, no goal with a limit begins before the time of a lease.
    """
    while (entries := [*entries_of(worker.diary)]) == [] or entries[-1].what != "began":  # noqa: ASYNC110
        await anyio.sleep(0.02)


async def lose_places(scene: Scene) -> list[Loss]:
    """Kill a worker whose goals have slots of keys."""
    killed, *_ = scene.workers
    await _begins_a_goal(killed)
    losses = [Loss(killed.name, time.time(), scene.lease + GRACE)]
    killed.kill()
    scene.crowd.go_on()
    await anyio.sleep(scene.lease + GRACE)
    return losses


async def lose_places_and_their_leader(scene: Scene) -> list[Loss]:
    """Kill a worker, and then the broker that leads the stream of the places."""
    losses = await lose_places(scene)
    leader = await scene.witness.leader("keys")
    await scene.witness.lead_elsewhere(leader)
    killed = scene.servers.by_name[leader]
    killed.kill()
    await anyio.sleep(AWAY)
    killed.start(wait=False)
    return losses


async def lose_the_broker(scene: Scene) -> list[Loss]:
    """Kill the only broker, start it after a second, and freeze it for two seconds later."""
    (broker,) = scene.servers.by_name.values()
    broker.kill()
    scene.crowd.go_on()
    await anyio.sleep(1)
    broker.start(wait=False)
    await anyio.sleep(1)
    broker.freeze()
    await anyio.sleep(2)
    broker.thaw()
    return []


async def lose_the_leader(scene: Scene) -> list[Loss]:
    """Kill the broker that leads a stream of the fleet."""
    leader = await scene.witness.leader(scene.run.stream)
    await scene.witness.lead_elsewhere(leader)
    killed = scene.servers.by_name[leader]
    killed.kill()
    scene.crowd.go_on()
    await anyio.sleep(AWAY)
    killed.start(wait=False)
    return []


async def drain(scene: Scene) -> list[Loss]:
    """Stop a worker in good order."""
    scene.crowd.go_on()
    return await _drain(scene.workers[0])


async def _drain(drained: WorkerProcess) -> list[Loss]:
    at = time.time()
    code = await drained.stop()
    if code != 0:
        raise RuntimeError(f"the drained worker has ended with the exit code {code}")
    return [Loss(drained.name, at, GRACE, is_released=True)]


async def chaos(scene: Scene) -> list[Loss]:
    """Kill a worker, stop another in good order, and let new ones come, again and again."""
    losses: list[Loss] = []
    scene.crowd.go_on()
    for _ in range(ROUNDS):
        killed, drained = scene.workers[-3:-1]
        losses.append(Loss(killed.name, time.time(), PATIENCE))
        killed.kill()
        losses += [one._replace(within=PATIENCE) for one in await _drain(drained)]
        number = len(scene.workers)
        names = f"w{number + 1}", f"w{number + 2}"
        await scene.workers.start(*map(killed.setup.renamed, names))
        await anyio.sleep(scene.lease + GRACE)
    return losses


class Scenario(NamedTuple):
    """Some brokers, and the harm that is done to a fleet of three workers."""

    act: Act
    brokers: int = 1


SCENARIOS = {
    "workers": Scenario(lose_workers),
    "broker": Scenario(lose_the_broker),
    "leader": Scenario(lose_the_leader, brokers=3),
    "drain": Scenario(drain),
    "chaos": Scenario(chaos),
    "places": Scenario(lose_places, brokers=3),
    "keys": Scenario(lose_places_and_their_leader, brokers=3),
}


async def _rejoined(scene: Scene) -> dict[str, bytes]:
    """Return the incarnations of the workers when all that live have one: on a busy machine, one
    that was frozen may join again after the last goal has ended.
    """
    found: dict[str, bytes] = {}
    with anyio.move_on_after(PATIENCE):
        while not all(one.name in found for one in scene.workers if one.is_alive):
            await anyio.sleep(0.1)
            found = await scene.witness.incarnations(*(one.name for one in scene.workers))
    return found


async def run(name: str, settings: Run, folder: Path) -> Report:
    """Run a scenario with files in a folder, and return the report."""
    began = time.monotonic()
    epoch = time.time() - time.monotonic()
    scenario, ledger = SCENARIOS[name], Ledger()
    async with _scene(scenario, settings, folder, ledger) as scene:
        before = await scene.witness.incarnations(*(one.name for one in scene.workers))
        async with anyio.create_task_group() as following:
            following.start_soon(scene.witness.follow)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(scene.crowd.run)
                await scene.crowd.are_running()
                losses = await scenario.act(scene)
            following.cancel_scope.cancel()
        await settle(_url(scene.servers), ledger)
        after = await _rejoined(scene)
        writes = await scene.witness.writes()
        diary = sorted(
            (entry for one in scene.workers for entry in entries_of(one.diary)),
            key=lambda entry: entry.at,
        )
        crowd = scene.crowd
    rules = Rules(
        settings.recovery == "rerun",
        lost=frozenset(one.worker for one in losses if not one.is_released),
        released=frozenset(one.worker for one in losses if one.is_released),
        limit=settings.limit,
    )
    handovers = {one.worker: handover(writes, one.worker, one.at) for one in losses}
    rejoined = [one for one, found in after.items() if found != before.get(one, found)]
    case = Case(ledger, diary, writes, rules, epoch)
    faults = [*faults_of(case), *faults_of_keys(case)]
    if len(ledger.goals) < settings.load.goals or crowd.answered < settings.load.goals:
        faults.append(f"{len(ledger.goals)} were accepted, and {crowd.answered} answered")
    diaries = {one.name: one.diary for one in scene.workers}
    pauses = {
        one.worker: key_pauses(case, entries_of(diaries[one.worker]), one.at) for one in losses
    }
    faults += _faults_of_time(losses, handovers, writes, scenario, pauses if settings.limit else {})
    faults += [f"{one} was fenced" for one in rejoined if one not in rules.lost]
    return Report(
        scenario=name,
        recovery=settings.recovery,
        goals=len(ledger.goals),
        answered=crowd.answered,
        ends=dict(ledger.ends()),
        writes=len(writes),
        unseen_writes=unseen(writes),
        moves=moves(writes),
        attempts=attempts_of(diary),
        dropped_feedback=crowd.dropped,
        longest_pause=round(longest_pause(writes), 2),
        rejoined=rejoined,
        handovers=handovers,
        key_pauses=pauses if settings.limit else {},
        seconds=round(time.monotonic() - began, 1),
        faults=faults,
    )


def _faults_of_time(
    losses: list[Loss],
    handovers: Mapping[str, Handover],
    writes: list[Write],
    scenario: Scenario,
    pauses: Mapping[str, Mapping[int, float]],
) -> list[str]:
    within = {one.worker: one.within for one in losses}
    found = [
        f"key {key} of {worker} was free after {seconds} s, and {within[worker]:g} s are allowed"
        for worker, of_worker in pauses.items()
        for key, seconds in of_worker.items()
        if seconds > within[worker]
    ]
    found += [
        f"goals of {one.worker} were safe after {handovers[one.worker].longest} s, and"
        f" {one.within:g} s are allowed"
        for one in losses
        if handovers[one.worker].longest > one.within and not pauses  # with keys, they wait
    ]
    if scenario.brokers > 1 and longest_pause(writes) > PAUSE:
        found.append(f"the fleet stood still for {longest_pause(writes):.1f} s")
    return found


@asynccontextmanager
async def _scene(
    scenario: Scenario, settings: Run, folder: Path, ledger: Ledger
) -> AsyncGenerator[Scene, None]:
    async with AsyncExitStack() as stack:
        brokers = stack.enter_context(servers(scenario.brokers))
        lease = "" if settings.lease is None else f"&lease={settings.lease:g}"
        setups = [
            Setup(
                name,
                f"{_url(brokers)}?worker={name}{lease}",
                str(folder / f"{name}.diary"),
                settings.recovery,
                limit=settings.limit,
            )
            for name in ("w1", "w2", "w3")
        ]
        started = await stack.enter_async_context(workers(*setups))
        seen = await stack.enter_async_context(witness(brokers.urls, FLEET))
        await seen.begin()
        clients = await stack.enter_async_context(
            crowd(_url(brokers), settings.load, settings.seed, ledger)
        )
        yield Scene(brokers, seen, started, clients, settings)


def _url(servers: Servers) -> str:
    return f"nats://{servers.hosts}/{FLEET}"
