"""`RequestHandlers`: the requests of a client beside goals.

A task works on each of them. They know neither connections nor permissions: `find` checks
permissions, and `say` sends.

Some requests concern all goals, all actions or all clients, and may be answered at length: a cancel
of several goals, and the lists. One client could send a thousand of them at once. So each client
has one cancel of several goals, and one list, of an action at work at a time; the next has its turn
when the answer to the one before is under way. The two do not wait for each other, since a cancel
may wait for a decision of the user's; nor do those of other actions, since behind a bridge the
server of an action may be away.

A client may follow the statuses of an action once on a connection. They are read one by one, as far
as there is credit, in slices between which other clients have their turn. A page of the history is
asked for and told in the same way; it is a list of an action.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeAlias

from anyio import CancelScope, Lock

from fibaction._runtime.notify import Notifier
from fibaction._runtime.text import excerpt, sendable
from fibaction.border.abc import Endpoint, StatusStream
from fibaction.border.event_loop import Slices
from fibaction.wire.auth import Permission
from fibaction.wire.messages import (
    Actions,
    AskLog,
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Done,
    Finished,
    GoalChanged,
    ListActions,
    Logged,
    Operate,
    Operated,
    Peers,
    Places,
    Rerun,
    RunsAgain,
    Watching,
    WatchStatus,
    parent_fields,
    past_from,
    told_labels,
)
from fibaction.wire.server.subscriptions import RequestSubscription
from fibaction.words.errors import ServerNotFound
from fibaction.words.goals import NO_GOAL, GoalID, GoalInfo
from fibaction.words.intake import IntakeChange, IntakeMode
from fibaction.words.statuses import GoalStatus

Request: TypeAlias = (
    CancelGoals
    | WatchStatus
    | AwaitServer
    | ListActions
    | AskPeers
    | AskPlaces
    | Operate
    | Rerun
    | AskLog
)
Answer: TypeAlias = (
    CancelAnswered
    | Done
    | Watching
    | GoalChanged
    | Finished
    | Actions
    | Peers
    | Places
    | Operated
    | RunsAgain
    | Logged
)

PART = 256
"""Goals of a long answer that are prepared at once."""


class ChangingEndpoints(dict[str, Endpoint]):
    """The endpoints of a server whose actions come and go, by the names of the actions."""

    def __init__(self) -> None:
        super().__init__()
        self.changed = Notifier()
        """Notified when an action has come."""

    def add(self, endpoint: Endpoint) -> None:
        """Serve one more action. Clients that wait for it are told."""
        self[endpoint.info.name] = endpoint
        self.changed.notify()


class RequestHandlers:
    """Answers the requests of one client."""

    def __init__(
        self,
        endpoints: Mapping[str, Endpoint],
        find: Callable[[str, Permission], Awaitable[Endpoint]],
        clients_of: Callable[[str], list[str]],
        say: Callable[[Answer], Awaitable[None]],
        change_of: Callable[[IntakeMode, str, str, str], IntakeChange],
    ) -> None:
        """Let `find` return the endpoint of an action, if the client has that permission for it,
        `clients_of` the names of all clients that use an action, and `change_of` a change by this
        client.
        """
        self._change_of = change_of
        self._endpoints = endpoints
        self._changed = endpoints.changed if isinstance(endpoints, ChangingEndpoints) else None
        self._find = find
        self._clients_of = clients_of
        self._say = say
        self._canceling: defaultdict[str, Lock] = defaultdict(Lock)
        self._listing: defaultdict[str, Lock] = defaultdict(Lock)
        self._watched: dict[str, RequestSubscription] = {}  # by the action
        self._handlers: dict[type, Callable[[Any, RequestSubscription], Awaitable[None]]] = {
            CancelGoals: self._cancel_goals,
            WatchStatus: self._watch,
            AwaitServer: self._await_server,
            ListActions: self._list_actions,
            AskPeers: self._ask_peers,
            AskPlaces: self._ask_places,
            Operate: self._operate,
            Rerun: self._rerun,
            AskLog: self._ask_log,
        }

    def limit_for(self, request: Request) -> str:
        """Return a sentence about the limit that forbids this request now; empty if none does."""
        if type(request) is not WatchStatus or request.past is not None:
            return ""
        watched = self._watched.get(request.action)
        if watched is None or watched.closed:
            return ""
        return (
            f"this connection follows the statuses of the action {excerpt(request.action)!r}"
            f" already; close that request first"
        )

    def begin(self, request: Request, subscription: RequestSubscription) -> None:
        """Count a request, in the order of arrival; `handle` must follow."""
        if type(request) is WatchStatus and request.past is None:
            self._watched[request.action] = subscription

    async def handle(self, request: Request, subscription: RequestSubscription) -> None:
        """Send all answers to a request; of statuses, as many as the client has credit for.

        Raises:
            ActionError: The request cannot be answered.
        """
        await self._handlers[type(request)](request, subscription)

    async def _cancel_goals(self, message: CancelGoals, _subscription: RequestSubscription) -> None:
        endpoint = await self._find(message.action, Permission.CANCEL)
        goal_id = None if message.goal_id is None else GoalID(message.goal_id)
        if goal_id in (None, NO_GOAL) or message.stamp:
            async with self._canceling[message.action]:
                await self._cancel(message, endpoint, goal_id)
        else:
            await self._cancel(message, endpoint, goal_id)

    async def _cancel(
        self, message: CancelGoals, endpoint: Endpoint, goal_id: GoalID | None
    ) -> None:
        answer = await endpoint.cancel_goals(goal_id, message.stamp)
        goals: list[tuple[bytes, int, GoalStatus]] = []
        slices = Slices()
        for start in range(0, len(answer.goals_canceling), PART):
            part = answer.goals_canceling[start : start + PART]
            # `bytes`, because other classes take several times as long to encode.
            goals += [(bytes(info.goal_id), info.stamp, info.status) for info in part]
            await slices.pause()
        await self._say(
            CancelAnswered(message.id, answer.return_code, goals, sendable(answer.reason))
        )

    async def _watch(self, message: WatchStatus, subscription: RequestSubscription) -> None:
        if message.past is None:
            await self._watch_status(message, subscription)
            return
        endpoint = await self._find(message.action, Permission.OBSERVE)
        async with self._listing[message.action]:
            infos = await endpoint.past_goals(
                past_from(message.past, message.labels, message.words)
            )
            await self._say(Watching(message.id, len(infos)))
            slices = Slices()
            for info in infos:
                if not await self._tell(message.id, info, 0, subscription):
                    break
                await slices.pause()
        await self._say(Finished(message.id))

    async def _watch_status(self, message: WatchStatus, subscription: RequestSubscription) -> None:
        try:
            endpoint = await self._find(message.action, Permission.OBSERVE)
            async with self._listing[message.action]:
                statuses = await endpoint.status()
                subscription.stop_with(statuses.close)
                try:
                    await self._say(Watching(message.id, statuses.known))
                except BaseException:
                    statuses.close()
                    raise
            with statuses:
                await self._tell_statuses(message.id, statuses, subscription)
        finally:
            if self._watched.get(message.action) is subscription:
                del self._watched[message.action]
        await self._say(Finished(message.id))

    async def _tell_statuses(
        self, request: int, statuses: StatusStream, subscription: RequestSubscription
    ) -> None:
        slices = Slices()
        while (info := await statuses.receive()) is not None:
            if not await self._tell(request, info, statuses.dropped, subscription):
                break
            await slices.pause()

    async def _tell(
        self, request: int, info: GoalInfo, dropped: int, subscription: RequestSubscription
    ) -> bool:
        """Tell of a goal, when there is credit; return False if the client wants no more."""
        await subscription.wait()
        if subscription.closed:
            return False
        subscription.credit -= 1
        changed = GoalChanged(
            request,
            bytes(info.goal_id),
            info.stamp,
            info.status,
            dropped,
            info.feedback_count,
            info.client,
            info.place,
            info.queue_length,
            info.attempt,
            parent_fields(info.parent),
            info.began_at,
            info.ended_at,
            info.reason and sendable(info.reason),
            told_labels(info.labels),
            info.worker and sendable(info.worker),
        )
        await self._say(changed)
        return True

    async def _await_server(self, message: AwaitServer, subscription: RequestSubscription) -> None:
        with CancelScope() as scope:
            subscription.stop_with(scope.cancel)
            endpoint = await self._awaited(message.action)
            await endpoint.wait_for_server()
            await self._say(Done(message.id))

    async def _awaited(self, action: str) -> Endpoint:
        """Return the endpoint of an action. If the actions can change, wait until it is served."""
        while True:
            try:
                return await self._find(action, Permission.OBSERVE)
            except ServerNotFound:
                if self._changed is None:
                    raise
            await self._changed.wait()

    async def _ask_peers(self, message: AskPeers, _subscription: RequestSubscription) -> None:
        await self._find(message.action, Permission.OBSERVE)
        async with self._listing[message.action]:
            await self._say(Peers(message.id, self._clients_of(message.action)))

    async def _ask_places(self, message: AskPlaces, _subscription: RequestSubscription) -> None:
        endpoint = await self._find(message.action, Permission.OBSERVE)
        async with self._listing[message.action]:
            # The answer comes behind all statuses that were told before, as `Done` does: a gateway
            # asks the server behind it before it lists the goals.
            with await endpoint.status() as statuses:
                infos = await statuses.listed()
            goals: list[tuple[bytes, int, int]] = []
            slices = Slices()
            for info in infos:
                if info.place and len(goals) < message.most:
                    goals.append((bytes(info.goal_id), info.place, info.queue_length))
                await slices.pause()
            await self._say(Places(message.id, goals))

    async def _operate(self, message: Operate, _subscription: RequestSubscription) -> None:
        permission = Permission.OBSERVE if message.mode is None else Permission.OPERATE
        endpoint = await self._find(message.action, permission)
        async with self._listing[message.action]:
            if message.mode is None:
                intake = await endpoint.intake()
            else:
                change = self._change_of(message.mode, message.reason, message.by, message.worker)
                intake = await endpoint.change_intake(change)
            changes = [(one.mode, one.reason, one.by, one.at) for one in intake.changes]
            more = intake.schedule, intake.has_levers
            await self._say(Operated(message.id, intake.mode, changes, *more))

    async def _rerun(self, message: Rerun, _subscription: RequestSubscription) -> None:
        endpoint = await self._find(message.action, Permission.OPERATE)
        async with self._listing[message.action]:
            new = await endpoint.rerun(GoalID(message.goal_id))
            await self._say(RunsAgain(message.id, new))

    async def _ask_log(self, message: AskLog, _subscription: RequestSubscription) -> None:
        endpoint = await self._find(message.action, Permission.OBSERVE)
        async with self._listing[message.action]:
            lines = await endpoint.log_lines(GoalID(message.goal_id))
            told = None
            if lines is not None:
                told = [(one.at, one.level, one.logger, one.text) for one in lines]
            await self._say(Logged(message.id, told))

    async def _list_actions(self, message: ListActions, _subscription: RequestSubscription) -> None:
        infos = [endpoint.info for endpoint in self._endpoints.values()]
        await self._say(Actions(message.id, infos))
