"""`FleetEndpoint`: an action that any number of workers of a fleet serve.

Theory of operation
-------------------

A goal has one owner, which its record at the brokers names. A worker owns a goal when its write of
the record is the first one over the record before, so two workers never own one goal.

*Which worker gets a goal.* `RoomFinder` asks the workers that have room, and the brokers pass the
question to one of them: one that can run the goal now, or else one with room in its queue. The goal
is sent to that worker over a wire connection. The worker writes the record, and then accepts. If
it is busy by now, another worker is tried, until all have rejected the goal. If it cannot read the
goal, one whose action has other types is tried: it may be of another version. Any other rejection
is the answer. If the connection is lost before the answer, the record says what became of the
goal. With an owner that lives, the goal is sent again there, where its ID shows that it is the
same one. If it has ended and its owner is gone, its end is taken from the record. Without a
record no worker has accepted it, and any worker is tried.

*How a goal moves.* When the lease of a worker ends, when it lets go of a goal, or when a goal waits
there and another worker could run it, that other worker writes itself into the record: see
`takeover`. The client takes no part in it. `CallRoutes` reads the record until the owner lives, and
moves the same `RemoteGoal` to the connection to that worker, where it continues after the last
feedback that has arrived.

*What a client follows.* A goal is followed at its owner, which `feedback` finds by the record, and
the statuses of all goals are followed in their records (`AllStatuses`). Gateways are workers whose
goals have no records. So a goal without a record may be at any of them, and does not move.

*A goal that moves* between the look at its record and the question is not known to the worker that
is asked, or is said to have ended there. So these answers are believed only if the record says that
the goal has ended; otherwise the record is read again, and its owner asked (`_at_owner`).

*Requests about many goals*, or about one without a record, go to all workers, and their answers are
merged. A cancel of many then asks again for each goal that the records still have as active: it may
have moved meanwhile, or no living worker may have it.

Each call tries for `reconnect_timeout` seconds from its first failure (`RetryTime`).
"""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import TypeAlias, TypeVar

import anyio
from msgspec.structs import replace

from fibaction.border.abc import (
    Absence,
    Endpoint,
    GoalRequest,
    LogLine,
    StatusStream,
    cancel_each,
)
from fibaction.border.goal_store import checkpoint_to_tell
from fibaction.border.peer_text import excerpt
from fibaction.types.action import ActionInfo
from fibaction.wire.client.open_calls import OpenCalls
from fibaction.wire.client.remote_goal import OnLost, RemoteGoal
from fibaction.wire.messages import (
    LARGEST,
    AwaitServer,
    Done,
    Follow,
    SendGoal,
)
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    GoalRejected,
    InvalidMessage,
    RejectionCode,
    ServerNotFound,
    StoreError,
    TransportError,
    UnknownGoal,
)
from fibaction.words.goal_query import GoalQuery, PastPage, place_of, read_pages
from fibaction.words.goals import ID_IN_USE, CancelAnswer, CancelCode, GoalID, GoalInfo, digest_of
from fibaction.words.intake import Intake, IntakeChange, IntakeMode
from fibaction.words.meta import size_of
from fibaction.words.statuses import GoalStatus
from fibaction_transports.nats.client.call_routes import (
    CallRoutes,
    FoundGoal,
    RetryTime,
    ended_goal,
    gone,
    moving,
)
from fibaction_transports.nats.client.free_workers import Place, Placement, RoomFinder
from fibaction_transports.nats.client.statuses import AllStatuses
from fibaction_transports.nats.client.worker_connections import WorkerConnections
from fibaction_transports.nats.fleet_history import FleetHistory, first_of
from fibaction_transports.nats.workers import FleetWorkers

T = TypeVar("T")
_Request: TypeAlias = Callable[[int, int], Follow]

RECORD_OVERHEAD = 4096
"""Bytes of a record in addition to the goal, at most."""
_NOT_THERE = (CancelCode.UNKNOWN_GOAL_ID, CancelCode.GOAL_TERMINATED)
"""The answers of a worker that has lost or released a goal, or is about to; it may live on."""


@dataclass(frozen=True)
class FleetParts:
    """The parts of a connection to a fleet, which all its endpoints share."""

    workers: FleetWorkers
    connections: WorkerConnections
    routes: CallRoutes
    places: RoomFinder
    statuses: AllStatuses
    history: Callable[[str], FleetHistory]
    """The function that returns the history of the action of a name."""
    max_record: int


class FleetEndpoint(Endpoint):
    """An action of a fleet."""

    def __init__(self, parts: FleetParts, info: ActionInfo) -> None:
        self._parts = parts
        self._info = info
        self._history = parts.history(info.name)

    @property
    def info(self) -> ActionInfo:
        return self._info

    @property
    def absence(self) -> Absence | None:
        return self._parts.workers.absence

    # To send a goal

    async def offer_goal(self, request: GoalRequest) -> RemoteGoal:
        size = len(request.goal) + size_of(request.meta)
        limit = self._parts.max_record - RECORD_OVERHEAD
        if size > limit:
            raise InvalidMessage(
                f"the goal has {size} bytes, and {limit} are the limit of the brokers"
            )
        placement = Placement(self._parts.workers, self._info.name)
        patience = RetryTime(self._parts.routes)
        places = self._parts.places
        while True:
            place = Place("")
            try:
                # The end of a lease says that a goal is lost, so the leases are needed.
                await self._parts.workers.ready()
                place = Place(placement.owner or placement.reader)
                if not place.worker:
                    place = await places.take(self._info.name)
                placement.worker = place.worker
                sent = await self._parts.connections.calls_of(place.worker).send(
                    self._info.name, request, on_lost=self._lose_at(place.worker)
                )
                places.fill(self._info.name, place, sent)
                return sent
            except (GoalRejected, ConnectionLost, ServerNotFound) as exc:
                error = exc
            if place.is_used and isinstance(error, GoalRejected) and error.code.is_temporary:
                places.refuse(self._info.name, place)
                continue
            answer = placement.answer(error)
            if answer is not None:
                raise answer
            if isinstance(error, GoalRejected) and placement.reader:
                continue
            if not isinstance(error, ConnectionLost) and placement.worker and not placement.owner:
                await patience.wait(error)  # another worker may have room
                continue
            # Its answer may be lost, or another client may have sent the same goal before.
            found = await self._found(request.goal_id, patience)
            if found is None and not placement.worker:
                raise error
            if found is not None and found.goal.ended_at and not found.is_alive:
                return self._ended_sent(found, request)
            if not placement.goes_to(found):
                await patience.wait(error)

    def _ended_sent(self, found: FoundGoal, request: GoalRequest) -> RemoteGoal:
        """Return a goal that was sent again, and has ended before.

        Raises:
            GoalRejected: Another goal has this ID.
        """
        goal_id, goal = request.goal_id, request.goal
        if found.goal.digest != digest_of(goal):
            raise GoalRejected(ID_IN_USE, goal_id=goal_id, code=RejectionCode.DUPLICATE)
        call_id, credit = self._parts.connections.next_id(), 1 if request.feedback else None
        opening = SendGoal(call_id, self._info.name, goal_id, goal, credit)
        return ended_goal(opening, found.goal)

    # To follow a goal

    async def feedback(
        self,
        goal_id: GoalID,
        *,
        after: int | None = None,
        own: bool = False,
        attempt: int = 1,
    ) -> RemoteGoal:
        if after is not None:
            after = min(max(after, 0), LARGEST)  # as the server would do

        def request(call_id: int, credit: int) -> Follow:
            return Follow(call_id, self._info.name, goal_id, after, own, credit, attempt)

        try:
            return await self._feedback_now(goal_id, request)
        except (UnknownGoal, ServerNotFound):
            past = await self._in_history(self._history.past_goal(goal_id))
            if past is None:
                raise
            return ended_goal(request(self._parts.connections.next_id(), 1), past)

    async def _feedback_now(self, goal_id: GoalID, request: _Request) -> RemoteGoal:
        """Follow a goal that a worker has, or that has a record."""

        async def follow(found: FoundGoal) -> RemoteGoal:
            followed = await self._follow(found.goal.worker, goal_id, request)
            if found.goal.ended_at:
                followed.told_info = found.goal.info
            return followed

        def ended(found: FoundGoal, error: ActionError) -> RemoteGoal | None:
            if isinstance(error, UnknownGoal) and not found.goal.is_given_up:
                raise error  # its owner has forgotten it, and the record goes soon
            if isinstance(error, ConnectionLost) and found.is_alive:
                return None
            goal = ended_goal(request(self._parts.connections.next_id(), 1), found.goal)
            if found.goal.is_given_up:
                goal.checkpoint = checkpoint_to_tell(found.goal)
            return goal

        followed = await self._at_owner(goal_id, follow, ended)
        return followed or await self._feedback_without_record(goal_id, request)

    async def _feedback_without_record(self, goal_id: GoalID, request: _Request) -> RemoteGoal:
        error: ActionError = UnknownGoal(goal_id)
        for worker in await self.workers():
            if not self._parts.workers.is_kept(worker, self._info.name):
                try:
                    return await self._follow(worker, goal_id, request)
                except UnknownGoal:
                    pass
                except (ConnectionLost, ServerNotFound) as exc:
                    error = exc
        raise error

    # To cancel goals

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        if goal_id is not None and any(goal_id) and not stamp:
            return await self._cancel_one(goal_id)
        until = stamp or time.time_ns()
        asked = {
            found.goal.goal_id: found.goal.worker
            for found in await self._parts.routes.active(self._info.name)
            if found.is_alive
        }
        answer = await self._cancel_at_all(goal_id, stamp)
        canceled = {info.goal_id for info in answer.goals_canceling}
        left = [
            found.goal.goal_id
            for found in await self._parts.routes.active(self._info.name)
            if found.goal.status is GoalStatus.ACCEPTED
            and found.goal.goal_id not in canceled
            # Its worker has decided already, if it had the goal before it was asked.
            and not (found.is_alive and asked.get(found.goal.goal_id) == found.goal.worker)
            and (found.goal.stamp <= until or not (found.is_alive or stamp))
        ]
        return CancelAnswer.merged([answer, await cancel_each(self, left)])

    async def _cancel_one(self, goal_id: GoalID) -> CancelAnswer:
        async def cancel(found: FoundGoal) -> CancelAnswer:
            calls = self._parts.connections.calls_of(found.goal.worker)
            answer = await calls.cancel(self._info.name, goal_id, None)
            if answer.return_code in _NOT_THERE:
                raise UnknownGoal(goal_id)  # it moves, or has ended: the record tells
            return answer

        def ended(found: FoundGoal, error: ActionError) -> CancelAnswer | None:
            is_unanswered = found.is_alive and not isinstance(error, UnknownGoal)
            return None if is_unanswered else CancelAnswer(CancelCode.GOAL_TERMINATED)

        answer = await self._at_owner(goal_id, cancel, ended)
        return answer or await self._cancel_at_all(goal_id, None)

    async def _cancel_at_all(self, goal_id: GoalID | None, stamp: int | None) -> CancelAnswer:
        async def ask(worker: str) -> CancelAnswer:
            return await self._parts.connections.calls_of(worker).cancel(
                self._info.name, goal_id, stamp
            )

        return CancelAnswer.merged(await self.of_all(await self.workers(), ask))

    # All goals, and the server

    async def status(self) -> StatusStream:
        return await self._parts.statuses.follow(self._info.name)

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        async def ask(worker: str) -> list[GoalInfo]:
            return await self._parts.connections.calls_of(worker).past_goals(self._info.name, page)

        await self._parts.workers.ready()
        gateways = self._parts.workers.serving(self._info.name, is_kept=False)
        parts = await self.of_all([lease.worker for lease in gateways], ask)
        parts.append(await self._in_history(self._history.past_goals(page)))
        found = {place_of(info): info for part in parts for info in part}
        return list(first_of(found, page).values())

    async def read_past(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        await self._parts.workers.ready()
        for lease in self._parts.workers.serving(self._info.name, is_kept=False):
            calls = self._parts.connections.calls_of(lease.worker)
            await read_pages(partial(calls.past_goals, self._info.name), wanted, take)
        await self._in_history(self._history.read_past(wanted, take))

    async def _in_history(self, reading: Awaitable[T]) -> T:
        try:
            return await reading
        except StoreError as exc:
            raise ConnectionLost(str(exc)) from exc

    async def intake(self) -> Intake:
        return await self._operate(await self.workers())

    async def change_intake(self, change: IntakeChange) -> Intake:
        workers = await self.workers()
        if change.worker:
            if change.worker not in workers:
                raise ServerNotFound(
                    f"no worker {excerpt(change.worker)!r} serves {self._info.name!r}: there is"
                    f" {', '.join(map(repr, sorted(workers)))}"
                )
            if change.mode in (IntakeMode.HOLD, IntakeMode.REFUSE):
                raise TransportError("a pause is about all workers: drain a single one")
            workers = [change.worker]
        return await self._operate(workers, replace(change, worker=""))

    async def _operate(self, workers: list[str], change: IntakeChange | None = None) -> Intake:
        """Ask workers how they take goals, or to change that. One that drains is no example."""

        async def ask(worker: str) -> Intake:
            return await (await self._serving(worker)).operate(self._info.name, change)

        answers = await self.of_all(workers, ask)
        if not answers:
            raise self._parts.workers.not_served(self._info.name)
        return min(answers, key=lambda intake: intake.mode is IntakeMode.DRAIN)

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return await self._in_history(self._history.rerun(goal_id))

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        async def ask(worker: str) -> list[LogLine] | None:
            return await (await self._serving(worker)).log_lines(self._info.name, goal_id)

        # Each may have had an attempt at it; those of others are told without one that is away.
        told, away = await self._of_reachable(await self.workers(), ask)
        kept = [lines for lines in told if lines is not None]
        if away and not kept:
            raise away[0]
        return sorted(chain(*kept), key=lambda line: line.at) if kept else None

    async def wait_for_server(self) -> None:
        workers = self._parts.workers
        while True:
            try:
                await workers.ready()
                break
            except ConnectionLost:
                workers.check()  # the brokers may be away for as long as they like
        while not workers.serving(self._info.name):
            await workers.news.wait()
            workers.check()

    # Parts of these

    async def _found(self, goal_id: GoalID, patience: RetryTime) -> FoundGoal | None:
        """Return the goal by its record; wait for the brokers, if they are away."""
        return await patience.retry(lambda: self._parts.routes.find(self._info.name, goal_id))

    async def _at_owner(
        self,
        goal_id: GoalID,
        ask: Callable[[FoundGoal], Awaitable[T]],
        ended: Callable[[FoundGoal, ActionError], T | None],
    ) -> T | None:
        """Return the answer of the owner of a goal; ask again, as the goal may have another owner
        by then, as long as none answers. None if the goal has no record.

        `ended` gets the error about a goal that has ended, and may return the answer.
        """
        patience = RetryTime(self._parts.routes)
        while (found := await self._found(goal_id, patience)) is not None:
            error: ActionError = gone(found)
            if found.is_alive:
                try:
                    return await ask(found)
                except (UnknownGoal, ConnectionLost, ServerNotFound) as exc:
                    error = exc
            if found.goal.ended_at and (answer := ended(found, error)) is not None:
                return answer
            await patience.wait(moving(found) if isinstance(error, UnknownGoal) else error)
        return None

    async def _serving(self, worker: str) -> OpenCalls:
        """Return the calls at a worker as soon as it serves the action."""
        calls = self._parts.connections.calls_of(worker)
        await calls.ask(lambda call_id: AwaitServer(call_id, self._info.name), Done)
        return calls

    async def _follow(self, worker: str, goal_id: GoalID, request: _Request) -> RemoteGoal:
        calls = self._parts.connections.calls_of(worker)
        return await calls.follow(goal_id, request, on_lost=self._lose_at(worker))

    def _lose_at(self, worker: str) -> OnLost | None:
        """Return the function for a lost goal of a worker; None if its goals have no records."""
        is_kept = self._parts.workers.is_kept(worker, self._info.name)
        return self._parts.connections.lose_at(worker) if is_kept else None

    async def workers(self) -> list[str]:
        """Return the names of all workers that serve the action.

        Raises:
            ServerNotFound: There is none.
            ConnectionLost: The brokers do not answer.
        """
        workers = self._parts.workers
        await workers.ready()
        serving = workers.serving(self._info.name)
        if not serving:
            raise workers.not_served(self._info.name)
        return [lease.worker for lease in serving]

    async def of_all(self, workers: Iterable[str], ask: Callable[[str], Awaitable[T]]) -> list[T]:
        """Return the answers of all these workers, without those that are gone meanwhile.

        Raises:
            ActionError: The first error of a worker that is not gone.
        """
        answers, away = await self._of_reachable(workers, ask)
        if away:
            raise away[0]
        return answers

    async def _of_reachable(
        self, workers: Iterable[str], ask: Callable[[str], Awaitable[T]]
    ) -> tuple[list[T], list[ActionError]]:
        """Return the answers of all these workers, and the errors of those that live and are not
        reached.

        Raises:
            ActionError: The first error that a worker has answered with.
        """
        answers: list[T] = []
        away: list[ActionError] = []
        errors: list[ActionError] = []
        living = self._parts.workers

        async def ask_one(worker: str) -> None:
            def is_over() -> bool:
                return living.get(worker) is None or not living.is_kept(worker, self._info.name)

            patience = RetryTime(self._parts.routes)
            try:
                answers.append(await patience.retry(lambda: ask(worker), is_over))
            except (ConnectionLost, ServerNotFound) as exc:
                if living.get(worker) is not None:
                    away.append(exc)
            except ActionError as exc:
                errors.append(exc)

        async with anyio.create_task_group() as tasks:
            for worker in workers:
                tasks.start_soon(ask_one, worker)
        if errors:
            raise errors[0]
        return answers, away
