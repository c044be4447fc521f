"""`OpenCalls`: the calls that a client has open, whatever connection they are on.

Theory of operation
-------------------

A call is a request that is over with its answer, a goal or a watch of statuses. It is open from
`_start` until its last message, and outlives connections: `reopen` has the openings of all open
calls written on the next one, and a call's `opening` says by itself how far it had come. Without a
connection calls wait, or fail at once with `_absent`, if the owner has said so by `fail`.

What only its caller needs is held weakly: goals that are observed, and watches, which all callers
of an action share. When the last of them is dropped, nothing of it is opened again. A goal that
this client has sent is held until it is over, as its result must not be lost.

Openings wait in `_unopened`, and the link fetches as many as fill a write; a call that was given up
meanwhile is left out. A message from the server goes to its call by the ID in it. One that belongs
to no call is not an error here: it may have crossed the call's end.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any
from weakref import WeakValueDictionary

from fibaction._runtime.text import shortened
from fibaction.border.abc import GoalRequest, LogLine
from fibaction.wire.channel import CHUNK
from fibaction.wire.client.calls import Call, PendingRequest, unfitting
from fibaction.wire.client.remote_goal import OnLost, RemoteGoal
from fibaction.wire.client.remote_statuses import RemoteStatuses, StatusWatch, info_of
from fibaction.wire.errors import error_of, sendable
from fibaction.wire.frames import MAX_FRAME
from fibaction.wire.link import Link
from fibaction.wire.messages import (
    LARGEST,
    AskLog,
    AskPlaces,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Done,
    Failed,
    Finished,
    Follow,
    FromClient,
    GoalChanged,
    Logged,
    Operate,
    Operated,
    Places,
    Rerun,
    RunsAgain,
    SendGoal,
    Watching,
    WatchStatus,
    encode,
    label_fields,
    past_fields,
    word_fields,
)
from fibaction.words.errors import (
    ActionError,
    InvalidMessage,
    ServerNotFound,
    TransportError,
    copy_of,
)
from fibaction.words.goal_query import MOST_PAST, PastPage, place_of
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID, GoalInfo
from fibaction.words.intake import FIXED_INTAKE, MOST_CHANGES, OPEN_INTAKE, Intake, IntakeChange
from fibaction.words.meta import checked_meta

BURST = 32
"""Calls that are written at once, in the middle of a turn of the event loop: both ends then work at
the same time."""


OPERATE, RERUN, ASK_LOG = 28, 29, 30
"""The tags of `Operate`, `Rerun` and `AskLog`, which servers of earlier versions do not know."""


class PastCall(Call):
    """A page of the history of an action.

    A server that does not know the history answers with the goals that it remembers. So goals that
    do not belong to the page are left out here, and the call ends when as many goals have come as
    the server has announced.
    """

    def __init__(self, call_id: int, action: str, page: PastPage) -> None:
        super().__init__(call_id)
        self._page = page
        limit = min(page.limit, MOST_PAST)
        fields = past_fields(page), label_fields(page), word_fields(page)
        self._opening = WatchStatus(call_id, action, limit, *fields)
        self._left: int | None = None  # goals that are still to come; None before the answer
        self._infos: list[GoalInfo] = []

    def opening(self) -> FromClient:
        self._left, self._infos = None, []
        return self._opening

    def on_message(self, message: Any) -> bool:
        if isinstance(message, Failed):
            self.fail(error_of(message))
        elif isinstance(message, Watching) and self._left is None:
            self._left = min(message.known, self._opening.credit)
        elif isinstance(message, GoalChanged) and self._left:
            self._left -= 1
            self._infos.append(info_of(message))
        elif not (isinstance(message, Finished) and self._left is not None):
            raise unfitting(message)
        is_last = isinstance(message, Failed | Finished)
        if not self.is_answered and self.error is None and (is_last or self._left == 0):
            self.is_answered = True
            self.news.notify()
        return is_last

    @property
    def infos(self) -> list[GoalInfo]:
        """The goals that have come, in the order of the page."""
        infos = [info for info in self._infos if self._page.has(info)]
        return sorted(infos, key=place_of, reverse=self._page.newest_first)


class OpenCalls:
    """The open calls of one client, by their IDs, and those that wait to be sent."""

    def __init__(
        self,
        window: int,
        most_places: int,
        ids: Iterator[int] | None = None,
    ) -> None:
        """Ask for the places of at most `most_places` goals, for which a message from the server
        has room. `ids` has the IDs of new calls, if other connections share them.
        """
        self._absent: ActionError | None = None  # why new calls fail at once
        self._most_places = most_places
        self._link: Link | None = None
        self._newest = 0  # the highest tag that the server knows; 0 before the first connection
        self._max_frame = MAX_FRAME
        self._calls: dict[int, Call] = {}
        # Those of observers, for as long as the caller keeps them: one goal may have many.
        self._observed: WeakValueDictionary[int, RemoteGoal] = WeakValueDictionary()
        # One for each action, for all who follow its statuses here.
        self._watches: WeakValueDictionary[str, StatusWatch] = WeakValueDictionary()
        self._unopened: deque[Call] = deque()  # on this connection; in turn, as they may be large
        self._ids = itertools.count(1) if ids is None else ids
        # At least two: one can be dropped for the next. With one unread, the end would not come.
        self._goal_window = max(window, 2)
        self._window = window

    # For endpoints

    async def ask(self, request: Callable[[int], FromClient], kind: type[Any]) -> Any:
        """Send a request, on this connection or the next, and return its answer.

        Raises:
            ActionError: The server answers with an error, or cannot be asked.
        """
        call_id = next(self._ids)
        pending = PendingRequest(call_id, request(call_id))
        await self._open(pending)
        return pending.answer(kind)

    async def send(
        self, action: str, request: GoalRequest, *, on_lost: OnLost | None = None
    ) -> RemoteGoal:
        """Send a goal. `on_lost` gets it if it has to continue somewhere else: see `RemoteGoal`.

        Raises:
            ActionError: As for `ask`.
        """
        credit = self._goal_window if request.feedback else None
        meta = checked_meta(request.meta) if request.meta else None
        opening = SendGoal(
            next(self._ids),
            action,
            request.goal_id,
            request.goal,
            credit,
            meta=meta,
            checked=request.checked,
        )
        goal = RemoteGoal(
            request.goal_id, opening, self._goal_window, self.post, request.deadline, on_lost
        )
        await self._open(goal)
        return goal

    async def follow(
        self,
        goal_id: GoalID,
        request: Callable[[int, int], Follow],
        *,
        on_lost: OnLost | None = None,
    ) -> RemoteGoal:
        """Follow a goal that was sent before; `request` gets the ID of the call, and the credit.
        `on_lost` is as for `send`.

        Raises:
            ActionError: As for `ask`.
        """
        opening = request(next(self._ids), self._goal_window)
        goal = RemoteGoal(goal_id, opening, self._goal_window, self.post, on_lost=on_lost)
        await self._open(goal)
        if not goal.is_own and self._calls.pop(goal.id, None) is not None:
            self._observed[goal.id] = goal
        return goal

    async def follow_statuses(self, action: str) -> RemoteStatuses:
        """Follow the statuses of all goals of an action.

        Raises:
            ActionError: As for `ask`.
        """
        while True:
            if self._absent is not None:
                raise copy_of(self._absent)
            watch = self._watch_of(action)
            if not watch.is_answered:
                break
            # All that the server has told before this answer is known then: a goal that this client
            # has sent, for example. Places of goals that wait are told here only, since each start
            # of a goal changes those of all others.
            has_places = watch.has_accepted
            if has_places:
                asking = partial(AskPlaces, action=action, most=self._most_places)
                answer: Places = await self.ask(asking, Places)
                watch.set_places(answer.goals)
            else:
                await self.ask(lambda call_id: AwaitServer(call_id, action), Done)
            is_current = watch is self._watches.get(action) and watch.is_complete
            if is_current and (has_places or not watch.has_accepted):
                break
        statuses = watch.follow()
        try:
            await watch.answered()
        except BaseException:
            statuses.close()
            raise
        return statuses

    async def cancel(self, action: str, goal_id: GoalID | None, stamp: int | None) -> CancelAnswer:
        """Cancel the goals of an action that an ID and a stamp mean.

        Raises:
            ActionError: As for `ask`.
        """
        if stamp:  # 0 is not a stamp; a number that cannot be sent keeps its meaning
            stamp = min(max(stamp, 1), LARGEST)
        answer: CancelAnswered = await self.ask(
            lambda call_id: CancelGoals(call_id, action, goal_id, stamp), CancelAnswered
        )
        goals = tuple(GoalInfo(GoalID(one), when, status) for one, when, status in answer.goals)
        return CancelAnswer(CancelCode(answer.return_code), goals, shortened(answer.reason))

    async def operate(self, action: str, change: IntakeChange | None = None) -> Intake:
        """Change how an action takes goals, or only ask; an older server has no levers.

        Raises:
            ActionError: As for `ask`.
            TransportError: The server is older, and cannot be paused.
        """
        if self._newest < OPERATE:
            if change is None:
                return FIXED_INTAKE if self._newest else OPEN_INTAKE
            raise self._not_known("and cannot be paused")

        def opening(call_id: int) -> Operate:
            if change is None:
                return Operate(call_id, action)
            reason, by = sendable(change.reason), sendable(change.by)
            return Operate(call_id, action, change.mode, reason, by, change.worker)

        answer: Operated = await self.ask(opening, Operated)
        changes = (IntakeChange(*one) for one in answer.changes[:MOST_CHANGES])
        return Intake(answer.mode, tuple(changes), answer.schedule, answer.has_levers)

    async def rerun(self, action: str, goal_id: GoalID) -> GoalID | None:
        """Run a goal again that was given up, and return the ID of the new one.

        Raises:
            ActionError: As for `ask`.
            TransportError: The server is older, and cannot do so.
        """
        if self._newest < RERUN:
            raise self._not_known("and runs no goal again")
        answer: RunsAgain = await self.ask(
            lambda call_id: Rerun(call_id, action, goal_id), RunsAgain
        )
        return None if answer.new_id is None else GoalID(answer.new_id)

    async def log_lines(self, action: str, goal_id: GoalID) -> list[LogLine] | None:
        """Return the newest log records of a goal; None if the server keeps none, or is older.

        Raises:
            ActionError: As for `ask`.
        """
        if self._newest < ASK_LOG:
            return None
        answer: Logged = await self.ask(lambda call_id: AskLog(call_id, action, goal_id), Logged)
        return None if answer.lines is None else [LogLine(*line) for line in answer.lines]

    def _not_known(self, consequence: str) -> TransportError:
        """Return the error of a request that the server does not know."""
        if self._newest:
            return TransportError(f"the server is of an earlier version, {consequence}")
        return ServerNotFound("the server has not answered yet")

    async def past_goals(self, action: str, page: PastPage) -> list[GoalInfo]:
        """Return a page of the history of an action.

        Raises:
            ActionError: As for `ask`.
        """
        call = PastCall(next(self._ids), action, page)
        await self._open(call)
        if self._calls.pop(call.id, None) is not None:  # its last message is still to come
            self.post(call.giving_up())
        return call.infos

    def _watch_of(self, action: str) -> StatusWatch:
        """Return the open watch of an action, or open one."""
        watch = before = self._watches.get(action)
        if watch is None or not watch.is_complete:
            watch = StatusWatch(next(self._ids), action, self._window, self.post)
            if before is not None and not before.is_over:
                watch.take_over(before)
            self._watches[action] = watch
            self._start(watch)
        return watch

    def post(self, message: FromClient) -> None:
        """Send a small message, if there is a connection."""
        if self._link is not None:
            self._link.post(encode(message))

    async def _open(self, call: Call) -> None:
        """Open a call, and wait until the server has answered; give it up after an error."""
        if self._absent is not None:
            raise copy_of(self._absent)
        self._start(call)
        try:
            await call.answered()
        except BaseException:
            if self._calls.pop(call.id, None) is not None:
                self.post(call.giving_up())
            raise

    def _start(self, call: Call) -> None:
        """Send the opening of a call, if there is a connection."""
        self._calls[call.id] = call
        if self._link is not None:
            self._unopened.append(call)
            # Calls that are opened in the same turn of the event loop are written together, but of
            # very many the server begins with the first before the last is opened.
            is_first = len(self._calls) == 1
            self._link.wake_writer(at_once=is_first or len(self._unopened) >= BURST)

    @property
    def is_empty(self) -> bool:
        """True if no call is open."""
        return not (self._calls or self._observed or self._watches)

    def adopt(self, goal: RemoteGoal, on_lost: OnLost) -> None:
        """Continue here with a goal that another connection has given up; `on_lost` gets it if
        that cannot be done.
        """
        goal.move_to(self.post, on_lost)
        self._start(goal)
        if not goal.is_own:
            del self._calls[goal.id]
            self._observed[goal.id] = goal

    # For the connection

    def reopen(self, link: Link, max_frame: int, newest: int) -> None:
        """Open all calls on a new connection, whose server takes frames of so many bytes, and knows
        the messages with tags up to `newest`.
        """
        self._newest = newest
        self._link, self._max_frame, self._absent = link, max_frame, None
        self._unopened.clear()
        self._unopened.extend((*self._calls.values(), *self._observed.values()))
        link.wake_writer()

    def detach(self) -> None:
        """Wait for another connection: this one has ended."""
        self._link = None
        self._unopened.clear()
        for watch in tuple(self._watches.values()):
            watch.detach()

    def openings(self) -> list[bytes]:
        """Return frames that open calls on this connection, as many as fill one write."""
        frames: list[bytes] = []
        size = 0
        while self._unopened and size < CHUNK:
            call = self._unopened.popleft()
            if call is not (self._calls.get(call.id) or self._observed.get(call.id)):
                continue  # given up since
            if call.is_over:
                self._drop(call)
                continue
            try:
                frame = encode(call.opening())
            except (TypeError, ValueError, OverflowError) as exc:
                # The caller has given something else than the types say. Other calls continue.
                self._reject(call, f"the message cannot be sent: {exc}")
                continue
            if len(frame) <= self._max_frame:
                frames.append(frame)
                size += len(frame)
            else:
                self._reject(
                    call,
                    f"the message has {len(frame)} bytes, and the server accepts"
                    f" {self._max_frame}: serve(..., limits=Limits(frame=...)) sets its limit",
                )
        return frames

    def handle(self, message: Any) -> bool:
        """Hand a message to its call; return False if it does not belong to one.

        Raises:
            ProtocolError: The message does not answer that call.
        """
        call_id = getattr(message, "id", -1)
        call = self._calls.get(call_id) or self._observed.get(call_id)
        if call is None:
            return False
        if call.on_message(message):
            self._drop(call)
        return True

    def fail(self, error: ActionError, absent: ActionError) -> None:
        """End all calls with an error, and let new ones fail with `absent` until `reopen`."""
        self._absent = absent
        calls = (*self._calls.values(), *self._observed.values())
        self._calls = {}
        self._observed.clear()
        for call in calls:
            call.lose(error)

    def fail_unanswered(self, error: ActionError) -> None:
        """End the calls that the server has not answered, and continue with all others."""
        for call in tuple(self._calls.values()):
            if not call.is_answered:
                self._drop(call)
                call.fail(error)

    def _reject(self, call: Call, text: str) -> None:
        self._drop(call)
        call.fail(InvalidMessage(text))

    def _drop(self, call: Call) -> None:
        if self._calls.pop(call.id, None) is None:
            self._observed.pop(call.id, None)
