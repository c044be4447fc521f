"""The crowd of an attack: a victim with a meter, an honest peer of it, and an attacker."""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator, Sequence
from contextlib import ExitStack, asynccontextmanager
from statistics import median
from time import perf_counter

import anyio

from fibaction_transports.rtps.events import EndpointMatched, Event, SampleReceived
from fibaction_transports.rtps.limits import MOST_REPAIRS
from fibaction_transports.rtps.network import open_network
from fibaction_transports.rtps.ports import DomainSettings
from fibaction_transports.rtps.qos import Qos
from tests.hostile.arena import (
    PROCESSES,
    ROOT,
    SHUTDOWN,
    Figures,
    Server,
    environment,
    started_by,
)
from tests.hostile.raw_client import until
from tests.hostile.rtps import echo_victim
from tests.hostile.rtps.datagram_attacks import (
    DATAGRAM_ATTACKS,
    Attacker,
    DatagramAttack,
    attacker_of,
)
from tests.hostile.rtps.echo_victim import ANSWERED, ASKED, EchoIdentity
from tests.hostile.verdict import faults
from tests.support.ros_domain import claim_domain
from tests.transports.rtps.world import TYPE, payload

PATIENCE = 50.0
"""Seconds for one attack in its short form."""
WORK = 0.3
"""Seconds of the processor that the victim uses until it has answered, at the 99th percentile: some
datagrams of the attack, at their dearest. On a busy machine more of them wait, so it is a bound of
the trials only.
"""
HONEST_QUESTIONS = 10
"""Questions of the honest peer during an attack, at least."""


def broken_bounds(attack: DatagramAttack, found: Figures, *, is_trial: bool = False) -> list[str]:
    """Return the bounds that were broken."""
    wrong = faults(attack, found, is_trial=is_trial)
    if is_trial and found.work_of(0.99) > WORK:
        wrong.append(f"{found.work_of(0.99) * 1000:.0f} ms of work until an answer")
    most = attack.factor * found.attacked + MOST_REPAIRS
    if found.attacked and found.sent > most:
        wrong.append(f"it sent {found.sent:,} bytes for {found.attacked:,}")
    return wrong


class HonestPeer:
    """A peer that asks one question after another, and checks the answers."""

    def __init__(self, victim: Server) -> None:
        self.latencies: list[float] = []
        self.work: list[float] = []
        self._victim = victim
        self._matched = 0
        self._answers: list[bytes] = []
        self._news = anyio.Event()

    def told(self, event: Event) -> None:
        """Take an event of its participant."""
        self._matched += isinstance(event, EndpointMatched)
        if isinstance(event, SampleReceived):
            self._answers.append(event.sample.payload)
        self._news.set()

    async def ask(self, domain: int) -> None:
        """Ask until canceled. Each answer is the question that was just asked."""
        async with open_network(DomainSettings(domain=domain), self.told) as network:
            writer = network.create_writer(ASKED, TYPE, Qos())
            network.create_reader(ANSWERED, TYPE, Qos())
            while self._matched < 2:
                await self._told()
            for number in range(10**9):
                question = payload(f"question {number} of the honest peer")
                begun, used = perf_counter(), self._victim.cpu
                network.write(writer, question)
                while question not in self._answers:
                    await self._told()
                self._answers.clear()
                self.latencies.append(perf_counter() - begun)
                self.work.append(self._victim.cpu - used)
                await anyio.sleep(0.002)

    def clear(self) -> None:
        """Forget the figures so far."""
        self.latencies.clear()
        self.work.clear()

    async def _told(self) -> None:
        self._news = anyio.Event()
        await self._news.wait()


async def repeat(name: str, attacker: Attacker, waves: list[float], *, is_long: bool) -> None:
    """Attack again and again.

    The short form pauses between datagrams and waves, since it has to end soon on a busy machine.
    """
    while True:
        for _ in DATAGRAM_ATTACKS[name].wave(attacker):
            await anyio.sleep(0 if is_long else 0.005)
        waves.append(perf_counter())
        await anyio.sleep(0 if is_long else 0.2)


@asynccontextmanager
async def attacked(
    name: str, victim: EchoIdentity, *, is_long: bool
) -> AsyncGenerator[Attacker | None, None]:
    """Attack inside of the block: by a process, or by this one after a first wave."""
    if is_long:
        command = [sys.executable, "-m", "tests.hostile.attacker", name, *_words(victim)]
        async with await anyio.open_process(
            command, cwd=ROOT, env=environment(), stderr=None
        ) as it:
            assert it.stdout is not None
            await it.stdout.receive()
            yield None
            it.kill()
        return
    waves = list[float]()
    async with attacker_of(victim) as attacker, anyio.create_task_group() as tasks:
        tasks.start_soon(lambda: repeat(name, attacker, waves, is_long=False))
        await until(lambda: len(waves) > 0)
        yield attacker
        tasks.cancel_scope.cancel()


def _words(victim: EchoIdentity) -> list[str]:
    names = (victim.prefix, victim.reader, victim.writer, victim.large)
    return [str(victim.domain), str(victim.address[1]), *(name.hex() for name in names)]


def victim_in(words: Sequence[str]) -> EchoIdentity:
    """Return the victim in the words of a command."""
    prefix, *entities = map(bytes.fromhex, words[2:])
    return EchoIdentity(int(words[0]), prefix, ("127.0.0.1", int(words[1])), *entities)


async def figures_of(name: str, seconds: float = 0.0) -> Figures:
    """Attack a victim beside an honest peer, and end it during the attack."""
    with ExitStack() as stack:
        domain, claim = claim_domain(20)
        stack.enter_context(claim)
        total = PROCESSES.Value("Q", 0)
        server = stack.enter_context(started_by(echo_victim.run, domain, total))
        victim = EchoIdentity(*server.told)
        honest = HonestPeer(server)
        with anyio.fail_after(PATIENCE + 4 * seconds):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(honest.ask, domain)
                await until(lambda: len(honest.latencies) >= 10)
                idle, before = (await server.reset()).memory, total.value
                quiet = median(honest.work)
                honest.clear()
                async with attacked(name, victim, is_long=seconds > 0) as attacker:
                    if seconds:
                        idle, before = (await server.reset()).memory, total.value
                        honest.clear()
                        await anyio.sleep(seconds)
                    await until(lambda: len(honest.latencies) >= HONEST_QUESTIONS)
                    reading, sent = await server.read(), total.value - before
                    said = 0 if attacker is None else attacker.sent
                    stopped, code = await server.stop(SHUTDOWN + 10)
                tasks.cancel_scope.cancel()
        above = (reading.peak - idle) / 2**20
        times = sorted(honest.latencies), sorted(honest.work), quiet, stopped
        return Figures(reading, above, *times, code, attacked=said, sent=sent)
