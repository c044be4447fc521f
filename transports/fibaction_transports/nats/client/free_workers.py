"""The search for workers that have room for the new goals of a client.

A client that has new goals asks all workers of the action at once (`RoomQuestion`), and one of
those that have room answers with the number of goals that it takes (`RoomOffer`): by chance, one of
those that can run a goal now, and only if there is none, one with room in its queue. There is one
question at a time for each action, for as many goals as wait by then: a hundred goals that are sent
at once cost few questions.

An offer tells that a worker has room. For `OFFER_LIFE` seconds after it, the place of a goal that
has ended there is used again without another question, so goals that are quick need few questions,
too. If the worker has given the room to another goal meanwhile, it rejects this one as busy, and
then a question finds a place. As offers end soon, a client that continues comes to all workers.

A worker that is frozen, or whose machine was switched off, still gets its share of the questions
until the broker notices, and does not answer. So the first wait is short, and the next ones are
longer, for a fleet that is only slow. A question without a subscriber is answered by the broker at
once: then no worker has room. The leases tell whether there are any. A worker that is the only one
gets the goal in any case, and tells by its rejection how many goals run and wait.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any, NamedTuple, TypeVar

import anyio
from anyio import current_time
from anyio.abc import TaskGroup

from fibaction.border.peer_text import excerpt
from fibaction.types.action import ActionInfo
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    GoalRejected,
    ProtocolError,
    RejectionCode,
    copy_of,
)
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, NoResponders
from fibaction_transports.nats.client.call_routes import FoundGoal
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import LeaseEntry, RoomQuestion, encode, offer
from fibaction_transports.nats.workers import FleetWorkers

E = TypeVar("E", bound=ActionError)

FIRST_WAIT, LONGEST_WAIT = 0.25, 2.0
"""Seconds that a question waits for an answer, at first and later."""
OFFER_LIFE = 0.25
"""Seconds after an offer in which the places of goals that have ended are used again."""
ROOM_WAIT = 0.25
"""Seconds in which a worker that has room by its lease must be found by questions."""
RETURN_WAIT = 2.5
"""Seconds after this client has its connection to the brokers back in which a worker may not have
its own back: longer than its pauses between two attempts."""
ROOM_PAUSE = 0.02
"""Seconds between two questions without a subscriber, within that time."""
MOST_LEFT = 256
"""The most places of one action that are kept for other goals."""


class Place(NamedTuple):
    """A place for one goal."""

    worker: str
    until: float = 0.0
    """Time until which it can be used again, after a goal that has ended."""
    is_used: bool = False
    """True if it is used again, so that the worker may have no room any more."""


class _Ticket:
    """A goal that waits for a place."""

    __slots__ = ("done", "error", "place")

    def __init__(self) -> None:
        self.done = anyio.Event()
        self.place = Place("")
        self.error: ActionError | None = None


class RoomFinder:
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
        self._left: dict[str, deque[Place]] = {}  # by goals that have ended; the newest is last

    async def take(self, action: str) -> Place:
        """Return a place at a worker that has room for one more goal of an action.

        Raises:
            GoalRejected: All workers of the action are busy.
            ServerNotFound: The action is not served in this fleet.
            ConnectionLost: No worker has answered.
        """
        place = self._place_left(action)
        if place is not None:
            return place
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
        return ticket.place

    def fill(self, action: str, place: Place, goal: RemoteGoal) -> None:
        """Use a place for a goal; when that has ended, it is there for another one."""
        if place.until <= current_time():
            return
        leave = partial(self._leave, action, place._replace(is_used=True))
        if goal.status.is_terminal:
            leave()
        else:
            goal.when_ended(leave)

    def refuse(self, action: str, place: Place) -> None:
        """Note that a worker has no room any more."""
        left = self._left.get(action, ())
        self._left[action] = deque(
            (one for one in left if one.worker != place.worker), maxlen=MOST_LEFT
        )

    def _leave(self, action: str, place: Place) -> None:
        """Note that a place is there for another goal."""
        waiting = self._waiting.get(action)
        if waiting and place.until > current_time():
            self._give(waiting.popleft(), place, None)
        else:
            self._left.setdefault(action, deque(maxlen=MOST_LEFT)).append(place)

    def _place_left(self, action: str) -> Place | None:
        """Return a place that a goal has left, if there is one."""
        left = self._left.get(action)
        while left:
            place = left.pop()
            if place.until > current_time() and self._workers.get(place.worker) is not None:
                return place
        return None

    def _give(self, ticket: _Ticket, place: Place, error: ActionError | None) -> None:
        ticket.place, ticket.error = place, error
        ticket.done.set()

    async def _ask(self, action: str, waiting: deque[_Ticket]) -> None:
        """Ask for the goals of an action until none waits."""
        while waiting:
            asked = len(waiting)
            error: ActionError | None = None
            try:
                place, count = await self._offered(action, asked)
            except ActionError as exc:
                place, count, error = Place(""), asked, exc
            for _ in range(min(count, len(waiting))):
                self._give(waiting.popleft(), place, error)
        del self._waiting[action]

    async def _offered(self, action: str, goals: int) -> tuple[Place, int]:
        """Return a place, and the number of goals that the worker takes."""
        question = encode(RoomQuestion(goals))
        wait = FIRST_WAIT
        began = current_time()
        while True:
            asked_at = current_time()
            try:
                return await self._one_answer(action, question, wait)
            except NoResponders:
                worker = await self._last_resort(action, current_time() - began)
                if worker:
                    return Place(worker), goals
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

    async def _one_answer(self, action: str, question: bytes, wait: float) -> tuple[Place, int]:
        """Ask those that can run a goal now, then those that have room in their queue."""
        until = current_time() + OFFER_LIFE
        try:
            answer = await self._broker.request(self._names.offer(action), question, wait)
        except NoResponders:
            answer = await self._broker.request(self._names.queue(action), question, wait)
            until = 0.0  # the room of a goal that ends is for one that waits
        offered = offer(answer)
        return Place(offered.worker, until), max(offered.goals, 1)

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
        # A worker that has room again, is new, or has lost the brokers listens again in a moment.
        is_early = waited < ROOM_WAIT or current_time() < self._broker.reconnected_at + RETURN_WAIT
        if is_early and any(lease.has_room for lease in serving):
            return ""
        raise GoalRejected(
            f"busy: all {len(serving)} workers of action {excerpt(action)!r} are busy",
            code=RejectionCode.BUSY,
        )


class Placement:
    """One goal that is to be sent, and the workers that it was sent to."""

    def __init__(self, workers: FleetWorkers, action: str) -> None:
        self._workers = workers
        self._action = action
        self._refused: set[str] = set()
        self._types: list[dict[str, Any]] = []  # those of goals that do not fit this one
        self._rejections: list[GoalRejected] = []  # since then
        self._lost: list[str] = []  # the workers that did not answer
        self.owner = ""
        """The worker that has the goal by its record; empty if it may go to any."""
        self.worker = ""
        """The worker that it was sent to last; empty if there was no place for it."""

    @property
    def reader(self) -> str:
        """The worker to go to after one that cannot read the goal, because its action has other
        types; empty if there is none.
        """
        if not self._types:
            return ""
        serving = self._workers.serving(self._action)
        readers = [
            lease
            for lease in serving
            if lease.worker not in self._refused and self._type_at(lease) not in self._types
        ]
        readers.sort(key=lambda lease: (self._lost.count(lease.worker), not lease.has_room))
        return readers[0].worker if readers else ""

    def answer(self, error: ActionError) -> ActionError | None:
        """Return the answer by an error of a worker; None if another worker is to be asked."""
        if not self.worker:
            return None
        if isinstance(error, GoalRejected):
            return self._answer_by(error)
        if not self._workers.is_kept(self.worker, self._action):
            return error  # no record tells whether a gateway has the goal
        if isinstance(error, ConnectionLost):
            self._lost.append(self.worker)
        if self.owner or isinstance(error, ConnectionLost):
            return None
        return self._next_or(error)

    def _answer_by(self, rejected: GoalRejected) -> GoalRejected | None:
        """Return the answer by a rejection: that of a worker that can read the goal, if any can."""
        is_unreadable = rejected.code is RejectionCode.UNREADABLE
        if self.owner or not (rejected.code.is_temporary or is_unreadable):
            return rejected
        lease = self._workers.get(self.worker)
        if is_unreadable and lease is not None:
            self._types.append(self._type_at(lease))
        if not self._types:
            return self._next_or(rejected)
        self._refused.add(self.worker)
        self._rejections.append(rejected)
        if self.reader:
            return None
        return next((one for one in self._rejections if one.code.is_temporary), self._rejections[0])

    def _next_or(self, error: E) -> E | None:
        """Return None to ask another worker; the error if all of them were asked."""
        self._refused.add(self.worker)
        serving = self._workers.serving(self._action)
        return error if self._refused.issuperset(lease.worker for lease in serving) else None

    def _type_at(self, lease: LeaseEntry) -> dict[str, Any]:
        """Return the type of goals at a worker, as a JSON Schema."""
        served = (one.info for one in lease.actions if one.info.name == self._action)
        return next(served, ActionInfo(self._action)).goal

    def goes_to(self, found: FoundGoal | None) -> bool:
        """Go to the owner of the goal next, or to any worker if it has none; return whether that
        can be at once.
        """
        before = self.owner
        self.owner = found.goal.worker if found is not None and found.is_alive else ""
        self.worker = ""
        return bool(self.owner) and self.owner != before
