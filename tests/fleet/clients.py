"""Clients of a fleet: each goal is sent, followed, sometimes canceled, and asked for by others."""

from __future__ import annotations

import random
import time
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TypeAlias

import anyio
import msgspec

from fibaction import ActionClient, CancelCode, ClientGoal, connect
from tests.kills.ledger import Ledger
from tests.kills.victim import WORK, Done, Work

PATIENCE = 90.0
"""Seconds after which a goal without an end is a fault."""

Client: TypeAlias = ActionClient[Work, int, Done]


class Load(msgspec.Struct, frozen=True):
    """The goals of a run."""

    goals: int
    steps: tuple[int, int]
    """The least and the most steps of a goal."""
    pause: float
    """Seconds of a step."""
    late: float = 0.2
    """The share of the goals that are sent after the fault."""
    keys: int = 1
    """The number of keys that the goals have."""
    spread: float = 3.0
    """Seconds over which they are sent, both before and after the fault."""
    canceled: float = 0.05
    """The share of the goals that are canceled, at some time until they would end."""


class Crowd:
    """Some connections, and the goals that are sent over them."""

    def __init__(self, clients: list[Client], load: Load, seed: int, ledger: Ledger) -> None:
        self._clients = clients
        self._load = load
        self._chance = random.Random(seed)
        self._ledger = ledger
        self._left = load.goals - round(load.goals * load.late)
        self._fault = anyio.Event()
        self._early = anyio.Event()
        self.answered = 0
        """The number of goals whose client was told their end."""
        self.dropped = 0
        """The number of feedback messages that were lost."""

    async def run(self) -> None:
        """Send all goals, and wait for their ends."""
        late = round(self._load.goals * self._load.late)
        async with anyio.create_task_group() as tasks:
            for number in range(self._load.goals):
                client = self._clients[number % len(self._clients)]
                other = self._clients[(number + 1) % len(self._clients)]
                tasks.start_soon(self._visit, client, other, number < late)

    async def are_running(self) -> None:
        """Wait until all goals that are sent before the fault are accepted."""
        await self._early.wait()

    def go_on(self) -> None:
        """Send the goals that are sent after the fault."""
        self._fault.set()

    async def _visit(self, client: Client, other: Client, is_late: bool) -> None:
        chance, work = self._chance, self._work()
        if is_late:
            await self._fault.wait()
        await anyio.sleep(chance.uniform(0, self._load.spread))
        name = "a goal that was not accepted"
        try:
            with anyio.fail_after(PATIENCE):
                goal = await client.send_goal(work)
                name = str(goal.goal_id)
                self._ledger.note_acceptance(goal.goal_id, work, goal.stamp)
                if not is_late:
                    self._left -= 1
                    if not self._left:
                        self._early.set()
                await self._follow(goal, other, chance.random())
        except TimeoutError:
            self._ledger.faults.append(f"{name} had no end within {PATIENCE} s")
        except Exception as error:
            self._ledger.faults.append(f"{name} raised {error!r}")

    async def _follow(self, goal: ClientGoal[int, Done], other: Client, kind: float) -> None:
        told = self._ledger.goals[goal.goal_id]
        canceled = self._load.canceled
        if kind < canceled:
            await anyio.sleep(self._load.pause * told.work.steps * kind / canceled)
            told.asked_to_cancel = True
            answer = await goal.cancel()
            if answer.accepted:
                told.canceled_at = time.monotonic_ns()
            elif answer.return_code is not CancelCode.GOAL_TERMINATED:
                self._fault_of(goal, f"is kept, and its cancel was answered {answer}")
        elif kind < canceled + 0.1:  # another client waits for some
            told.outcomes.append(await (await other.attach(goal.goal_id)).outcome())
        again, seen = 0, 0
        async for steps in goal.feedback:
            again += steps <= seen
            if again >= goal.attempt:
                self._fault_of(goal, f"told step {steps} after {seen} in attempt {goal.attempt}")
            seen = steps
        told.outcomes.append(await goal.outcome())
        self.answered += 1
        self.dropped += goal.feedback_dropped

    def _fault_of(self, goal: ClientGoal[int, Done], text: str) -> None:
        self._ledger.faults.append(f"{goal.goal_id} {text}")

    def _work(self) -> Work:
        chance = self._chance
        return Work(
            steps=chance.randint(*self._load.steps),
            pause=self._load.pause,
            fails=chance.random() < 0.05,
            key=chance.randrange(self._load.keys),
        )


@asynccontextmanager
async def crowd(
    url: str, load: Load, seed: int, ledger: Ledger, connections: int = 4
) -> AsyncGenerator[Crowd, None]:
    """Open connections for a load while the block lasts."""
    async with AsyncExitStack() as stack:
        clients = [
            await stack.enter_async_context(connect(url, WORK, reconnect_timeout=PATIENCE))
            for _ in range(connections)
        ]
        yield Crowd(clients, load, seed, ledger)
