"""Clients of a server that is killed: each sends, follows, cancels and attaches to goals."""

from __future__ import annotations

import random
import time
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from typing import TypeAlias

import anyio

from fibaction import ActionClient, ClientGoal, GoalID, GoalRejected, connect
from tests.kills.ledger import Ledger, Told
from tests.kills.victim import WORK, Done, Work

PATIENCE = 60.0
"""Seconds after which a call that has not returned is a fault."""

Client: TypeAlias = ActionClient[Work, int, Done]


class Visitor:
    """A client with a connection of its own, which does one thing after another."""

    def __init__(self, url: str, seed: int, ledger: Ledger) -> None:
        self._url = url
        self._chance = random.Random(seed)
        self._ledger = ledger
        self._client: Client

    async def run(self, is_over: anyio.Event) -> None:
        """Do random things until it is over, but one at least: no server may be there before."""
        things: list[Callable[[], Awaitable[None]]] = [
            self.follow,
            self.follow,
            self.cancel,
            self.send_twice,
            self.send_another,
            self.attach_to_any,
            self.leave,
        ]
        async with connect(self._url, WORK, heartbeat=1, reconnect_timeout=PATIENCE) as client:
            self._client = client
            await client.wait_for_server()
            while True:
                thing = self._chance.choice(things)
                with self._returns(thing.__name__), anyio.fail_after(PATIENCE):
                    await thing()
                if is_over.is_set():
                    break

    @contextmanager
    def _returns(self, name: str) -> Generator[None, None, None]:
        """Note a call that fails or does not return."""
        self._ledger.calls[name] += 1
        try:
            yield
        except TimeoutError:
            self._ledger.faults.append(f"{name} did not return within {PATIENCE} s")
        except Exception as error:
            self._ledger.faults.append(f"{name} raised {error!r}")

    # What a client does

    async def follow(self) -> None:
        """Send a goal, read its feedback, and wait for its end."""
        goal = await self._send(self._work())
        attempt, seen = 0, 0
        async for steps in goal.feedback:
            if goal.attempt < attempt:
                self._fault(goal, f"went back from attempt {attempt} to {goal.attempt}")
            if goal.attempt == attempt and steps <= seen:
                self._fault(goal, f"told step {steps} after step {seen} in attempt {attempt}")
            attempt, seen = goal.attempt, steps
        await self._note_end(goal)

    async def cancel(self) -> None:
        """Cancel a goal after a while."""
        goal = await self._send(self._work())
        await anyio.sleep(self._chance.uniform(0, 0.3))
        told = self._ledger.goals[goal.goal_id]
        told.asked_to_cancel = True
        if (await goal.cancel()).accepted:
            told.canceled_at = time.monotonic_ns()
        await self._note_end(goal)

    async def send_twice(self) -> None:
        """Send a goal again with the same ID, while it runs and when it has ended."""
        work = self._work()
        goal = await self._send(work)
        again = await self._send(work, goal.goal_id)
        await self._note_end(goal)
        await self._note_end(again)
        await self._note_end(await self._send(work, goal.goal_id))

    async def send_another(self) -> None:
        """Send another goal with the ID of the first, which is rejected."""
        goal = await self._send(self._work())
        try:
            await self._client.send_goal(Work(1000, 0), goal_id=goal.goal_id)
        except GoalRejected as error:
            if "another goal" not in error.reason:
                self._fault(goal, f"was rejected: {error.reason}")
        else:
            self._fault(goal, "was accepted, and so was another goal with its ID")
        await self._note_end(goal)

    async def attach_to_any(self) -> None:
        """Wait for the end of a goal of any client, also one that has ended long ago."""
        if self._ledger.goals:
            goal_id = self._chance.choice(list(self._ledger.goals))
            await self._note_end(await self._client.attach(goal_id))

    async def leave(self) -> None:
        """Send a goal, and do not wait for it."""
        await self._send(self._work())

    # How

    def _work(self) -> Work:
        chance = self._chance
        return Work(
            steps=chance.choice((0, 1, 2, 5, 10, 30)),
            pause=chance.choice((0, 0.001, 0.02, 0.05)),
            fails=chance.random() < 0.1,
            tidying=chance.choice((0, 0.3)),
        )

    async def _send(self, work: Work, goal_id: GoalID | None = None) -> ClientGoal[int, Done]:
        goal = await self._client.send_goal(work, goal_id=goal_id)
        self._ledger.note_acceptance(goal.goal_id, work, goal.stamp)
        return goal

    async def _note_end(self, goal: ClientGoal[int, Done]) -> None:
        outcome = await goal.outcome()
        self._ledger.goals[goal.goal_id].outcomes.append(outcome)

    def _fault(self, goal: ClientGoal[int, Done], text: str) -> None:
        self._ledger.faults.append(f"{goal.goal_id} {text}")


async def settle(url: str, ledger: Ledger) -> None:
    """Ask for the end of each goal without further faults, by a client that knows none of them."""
    limit = anyio.Semaphore(50)

    async def ask(goal_id: GoalID, told: Told) -> None:
        async with limit:
            try:
                with anyio.fail_after(PATIENCE):
                    told.outcomes.append(await (await client.attach(goal_id)).outcome())
            except Exception as error:
                ledger.faults.append(f"{goal_id} has no end: {error!r}")

    async with connect(url, WORK, heartbeat=5) as client, anyio.create_task_group() as tasks:
        for goal_id, told in ledger.goals.items():
            tasks.start_soon(ask, goal_id, told)
