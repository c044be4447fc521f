"""`Places`: workers that have room for the new goals of a client.

A client that has new goals asks all workers of the action at once, and one of those that have room
answers with the number of goals that it takes (`Question`, `Offer`). There is one question at a
time for each action, for as many goals as wait by then: a hundred goals that are sent at once cost
few questions.

A worker that is frozen, or whose machine was switched off, still gets its share of the questions
until the broker notices, and does not answer. So the first wait is short, and the next ones are
longer, for a fleet that is only slow. A question that nobody gets is answered by the broker at
once: then no worker has room. The leases tell whether there are any. A worker that is the only one
gets the goal in any case, and tells by its rejection how many goals run and wait.
"""

from __future__ import annotations

from collections import deque

import anyio
from anyio import current_time
from anyio.abc import TaskGroup

from fibaction._text import excerpt
from fibaction.exceptions import (
    ActionError,
    ConnectionLost,
    GoalRejected,
    ProtocolError,
    copy_of,
)
from fibaction_transports.nats.broker import Broker, BrokerAway, NobodyListens
from fibaction_transports.nats.fleet_names import FleetNames
from fibaction_transports.nats.fleet_records import Question, encode, offer
from fibaction_transports.nats.fleet_workers import FleetWorkers

FIRST_WAIT, LONGEST_WAIT = 0.25, 2.0
"""Seconds that a question waits for an answer, at first and later."""
ROOM_WAIT = 0.25
"""Seconds in which a worker that has room by its lease must be found by questions."""
ROOM_PAUSE = 0.02
"""Seconds between two questions that nobody gets, within that time."""


class _Ticket:
    """A goal that waits for a place."""

    __slots__ = ("done", "error", "worker")

    def __init__(self) -> None:
        self.done = anyio.Event()
        self.worker = ""
        self.error: ActionError | None = None


class Places:
    """Finds workers for new goals."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        workers: FleetWorkers,
        tasks: TaskGroup,
        patience: float,
    ) -> None:
        """Let a question without any answer end after `patience` seconds."""
        self._broker = broker
        self._names = names
        self._workers = workers
        self._tasks = tasks
        self._patience = patience
        self._waiting: dict[str, deque[_Ticket]] = {}  # of the actions for which a task asks

    async def take(self, action: str) -> str:
        """Return the name of a worker that has room for one more goal of an action.

        Raises:
            GoalRejected: All workers of the action are busy.
            ServerNotFound: The action is not served in this fleet.
            ConnectionLost: No worker has answered.
        """
        ticket = _Ticket()
        waiting = self._waiting.get(action)
        if waiting is None:
            waiting = self._waiting[action] = deque()
            self._tasks.start_soon(self._ask, action, waiting)
        waiting.append(ticket)
        try:
            await ticket.done.wait()
        finally:
            if not ticket.done.is_set():
                waiting.remove(ticket)
        if ticket.error is not None:
            raise copy_of(ticket.error)
        return ticket.worker

    async def _ask(self, action: str, waiting: deque[_Ticket]) -> None:
        """Ask for the goals of an action until none waits."""
        while waiting:
            asked = len(waiting)
            error: ActionError | None = None
            try:
                worker, places = await self._offered(action, asked)
            except ActionError as exc:
                worker, places, error = "", asked, exc
            for _ in range(min(places, len(waiting))):
                ticket = waiting.popleft()
                ticket.worker, ticket.error = worker, error
                ticket.done.set()
        del self._waiting[action]

    async def _offered(self, action: str, goals: int) -> tuple[str, int]:
        """Return a worker, and the number of goals that it takes."""
        question = encode(Question(goals))
        wait = FIRST_WAIT
        began = current_time()
        while True:
            asked_at = current_time()
            try:
                return await self._one_answer(action, question, wait)
            except NobodyListens:
                worker = await self._last_resort(action, current_time() - began)
                if worker:
                    return worker, goals
                await anyio.sleep(ROOM_PAUSE)
            except (BrokerAway, ProtocolError) as exc:
                if current_time() - began >= self._patience:
                    raise ConnectionLost(
                        f"no worker of action {excerpt(action)!r} has answered within"
                        f" {self._patience:g} s: {exc}"
                    ) from exc
                # Without a connection, there is an error at once.
                await anyio.sleep_until(asked_at + wait)
                wait = min(2 * wait, LONGEST_WAIT)

    async def _one_answer(self, action: str, question: bytes, wait: float) -> tuple[str, int]:
        """Ask those that can run a goal now, then those that have room in their queue."""
        try:
            answer = await self._broker.request(self._names.offer(action), question, wait)
        except NobodyListens:
            answer = await self._broker.request(self._names.queue(action), question, wait)
        offered = offer(answer)
        return offered.worker, max(offered.goals, 1)

    async def _last_resort(self, action: str, waited: float) -> str:
        """Return the worker to send goals to if none gets a question; empty to ask again.

        Raises:
            GoalRejected, ServerNotFound, ConnectionLost: As for `take`.
        """
        await self._workers.ready()
        serving = self._workers.serving(action)
        if not serving:
            raise self._workers.not_served(action)
        if len(serving) == 1:
            return serving[0].worker  # it says itself how busy it is
        # A worker that has room again, or is new, listens again in a moment.
        if waited < ROOM_WAIT and any(lease.has_room for lease in serving):
            return ""
        raise GoalRejected(
            f"busy: all {len(serving)} workers of action {excerpt(action)!r} are busy"
        )
