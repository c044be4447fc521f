"""The deeds of the simulation's clients, one method for each kind.

They use fibaction as its users do, with `send_goal`, `call`, `attach` and so on, and report to the
record, which checks what they saw.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable

import anyio
import anyio.lowlevel
from anyio import create_task_group, move_on_after

from fibaction import (
    ActionError,
    ClientConnection,
    ClientGoal,
    GoalAborted,
    GoalCanceled,
    GoalFeedback,
    GoalID,
    GoalStatus,
    Outcome,
)
from fibaction.border.abc import FeedbackItem
from tests.simulation.facts import ClientState
from tests.simulation.goal_names import goal_names
from tests.simulation.invariants import Record
from tests.simulation.scenario import SIMULATED, Deed, Done, Step, Work
from tests.simulation.views import View, Watch

WATCHED = 2.0
"""Seconds for which events are followed at most, in addition to the deed's own delay."""
LONGEST_READ = 0.5
"""Seconds that a slow reader takes over one message at most."""


class Deeds:
    """The deeds of one client over its connection."""

    def __init__(self, record: Record, state: ClientState, connection: ClientConnection) -> None:
        self._record = record
        self._state = state
        self._plan = state.plan
        self._connection = connection
        self._client = connection.client(SIMULATED)

    async def do(self, deed: Deed) -> None:
        """Do a deed.

        Raises:
            ActionError: The deed failed.
        """
        await getattr(self, f"_{deed.kind.replace(' ', '_')}")(deed)

    # Seeing

    def _view(self, goal: ClientGoal[Step, Done], *, start: int = 0, own: bool = True) -> View:
        view = View(
            self._record,
            self._state,
            goal.goal_id,
            goal.stamp,
            start=start,
            attempt=goal.attempt,
        )
        view.own = view.own and own
        view.losses = goal_names.get().losses
        view.status(goal.status)
        return view

    async def _read(
        self,
        goal: ClientGoal[Step, Done],
        view: View,
        *,
        pause: float = 0.0,
        most: float = math.inf,
    ) -> None:
        """Read the feedback, at most `most` messages."""
        seen = 0
        if not most:
            return
        async for step in goal.feedback:
            self._record.tell(f"{self._plan.name} reads {step.count} of {view.name}")
            view.status(goal.status)
            view.feedback(step, goal.feedback_dropped)
            seen += 1
            if seen >= most:
                return
            if pause:
                await anyio.sleep(pause)
        view.status(goal.status)
        view.end_of_feedback(goal.feedback_dropped)

    async def _see_outcome(self, goal: ClientGoal[Step, Done], view: View) -> None:
        outcome = await goal.outcome()
        self._record.tell(f"{self._plan.name} is told {view.name} {outcome.status.name}")
        view.outcome(outcome)

    def _some_goal(self, deed: Deed) -> tuple[GoalID, Work]:
        """Return a goal that any client has sent; if none was sent, an ID that the server has not
        seen.
        """
        sent = self._record.sent
        if not sent:
            return GoalID.random(), deed.work
        goal_id, work = sent[deed.target % len(sent)]
        goal_names.get().goal_id = goal_id
        if (
            deed.patience < math.inf
            or self._plan.leaves_at < math.inf
            or self._plan.dies_at < math.inf
        ):
            self._record.may_cancel(goal_id)  # if the deed sends it, the send may be canceled
        return goal_id, work

    # Sending

    async def _send(self, deed: Deed) -> None:
        goal = await self._client.send_goal(deed.work)
        view = self._view(goal)
        pause = min(deed.delay, LONGEST_READ) if deed.kind == "slow" else 0.0
        view.attentive = not pause
        await self._read(goal, view, pause=pause)
        await self._see_outcome(goal, view)

    _slow = _send

    async def _call(self, deed: Deed) -> None:
        mine = goal_names.get()
        view = View(self._record, self._state, GoalID(bytes(15) + b"?"), None, start=0)
        pause = deed.delay if deed.delay < LONGEST_READ else 0.0
        view.attentive = not pause

        def on_feedback(step: Step) -> Awaitable[None] | None:
            assert mine.goal_id is not None
            view.goal_id = mine.goal_id
            view.feedback(step, None)
            return anyio.sleep(pause) if pause else None

        self._record.may_cancel(None)  # any failure of a call cancels its goal
        try:
            outcome = Outcome(
                GoalStatus.SUCCEEDED, await self._client.call(deed.work, on_feedback=on_feedback)
            )
        except GoalAborted as error:
            outcome = Outcome(GoalStatus.ABORTED, error.result, error.reason)
        except GoalCanceled as error:
            outcome = Outcome(GoalStatus.CANCELED, error.result, error.reason)
        assert mine.goal_id is not None
        view.goal_id = mine.goal_id
        view.own = True
        view.outcome(outcome)
        view.losses = mine.losses
        view.end_of_call()

    async def _call_quietly(self, deed: Deed) -> None:
        mine = goal_names.get()
        try:
            result = await self._client.call(deed.work)
        except (GoalAborted, GoalCanceled):
            return
        assert mine.goal_id is not None
        view = View(self._record, self._state, mine.goal_id, None, start=0)
        view.outcome(Outcome(GoalStatus.SUCCEEDED, result))

    async def _leave(self, deed: Deed) -> None:
        goal_id = GoalID.random()
        self._record.may_cancel(goal_id)
        async with self._client.send_goal(deed.work, goal_id=goal_id) as goal:
            view = self._view(goal)
            await self._read(goal, view, most=deed.count)
            await anyio.sleep(deed.delay)
        await self._see_outcome(goal, view)

    async def _cancel(self, deed: Deed) -> None:
        goal = await self._client.send_goal(deed.work)
        view = self._view(goal)
        await self._read(goal, view, most=deed.count)
        await anyio.sleep(deed.delay)
        self._record.may_cancel(goal.goal_id)
        asked_at = self._record.now()
        answer = await goal.cancel()
        self._record.cancel_answered(answer, goal.goal_id, asked_at, None)
        view.status(goal.status)
        if deed.target % 2:
            await self._read(goal, view)
        await self._see_outcome(goal, view)

    async def _unread(self, deed: Deed) -> None:
        goal = await self._client.send_goal(deed.work)
        view = self._view(goal)
        if deed.target % 2:
            goal.close()
        await anyio.sleep(deed.delay)
        await self._see_outcome(goal, view)

    async def _beside(self, deed: Deed) -> None:
        goal = await self._client.send_goal(deed.work)
        view = self._view(goal)
        view.attentive = True

        async def read() -> None:
            try:
                await self._read(goal, view)
            except ActionError as error:
                self._record.failed(self._state, error, deed.kind, goal.goal_id)

        async with create_task_group() as tasks:
            tasks.start_soon(read)
            # The executor waits for the reader only after the reader has begun.
            await anyio.lowlevel.checkpoint()
            try:
                # A view of its own, because the outcome may be known before the feedback is read.
                await self._see_outcome(goal, self._view(goal))
            except ActionError as error:
                self._record.failed(self._state, error, deed.kind, goal.goal_id)

    async def _twice(self, deed: Deed) -> None:
        goal_id, work = GoalID.random(), deed.work
        if deed.target % 3 == 0 and self._record.sent:
            goal_id, work = self._some_goal(deed)
        self._record.sent_again.add(goal_id)

        async def once() -> None:
            try:
                goal = await self._client.send_goal(work, goal_id=goal_id)
                view = self._view(goal)
                await self._read(goal, view)
                await self._see_outcome(goal, view)
            except ActionError as error:
                self._record.failed(self._state, error, deed.kind, goal_id)

        async with create_task_group() as tasks:
            tasks.start_soon(once)
            await anyio.sleep(deed.delay)
            tasks.start_soon(once)

    async def _clash(self, deed: Deed) -> None:
        goal_id, _ = self._some_goal(deed)
        self._record.clashes.add(goal_id)
        self._record.sent_again.add(goal_id)
        goal = await self._client.send_goal(deed.work, goal_id=goal_id)
        goal.close()

    # Following

    async def _attach(self, deed: Deed) -> None:
        goal_id, _ = self._some_goal(deed)
        await anyio.sleep(deed.delay)
        after = deed.count if deed.target % 2 else None
        goal = await self._client.attach(goal_id, after=after)
        view = self._view(goal, start=goal.feedback.stream.cursor, own=False)
        await self._read(goal, view)
        await self._see_outcome(goal, view)

    async def _follow(self, deed: Deed) -> None:
        goal_id, _ = self._some_goal(deed)
        after = deed.count if deed.target % 2 else None
        with await self._client.endpoint.feedback(goal_id, after=after) as stream:
            view = View(
                self._record,
                self._state,
                goal_id,
                stream.stamp,
                start=stream.cursor,
                attempt=stream.attempt,
            )
            view.own = False
            told = View(self._record, self._state, goal_id, stream.stamp, start=0)
            told.own = False
            async for update in stream:
                if isinstance(update, FeedbackItem):
                    step = SIMULATED.feedback.decode(update.payload)
                    view.feedback(step, stream.dropped, update.number)
                elif isinstance(update, GoalStatus):
                    told.status(update)
                else:
                    told.outcome(_decoded(update))
            view.status(stream.status)
            view.end_of_feedback(stream.dropped)

    async def _get_result(self, deed: Deed) -> None:
        goal_id, _ = self._some_goal(deed)
        view = View(self._record, self._state, goal_id, None, start=0)
        view.own = False
        view.outcome(_decoded(await self._client.endpoint.get_result(goal_id)))

    # Canceling

    async def _cancel_goals(self, deed: Deed) -> None:
        goal_id: GoalID | None = None
        stamp: int | None = None
        if deed.kind in ("cancel by id", "cancel by both"):
            goal_id, _ = self._some_goal(deed)
        if deed.kind in ("cancel by stamp", "cancel by both"):
            truths = [truth for life in self._record.lives for truth in life.goals.values()]
            stamp = truths[deed.count % len(truths)].stamp if truths else 1
        self._record.may_cancel(None if stamp else goal_id)
        asked_at = self._record.now()
        answer = await self._client.cancel_goals(goal_id, before=stamp)
        self._record.cancel_answered(answer, goal_id, asked_at, stamp)

    _cancel_by_id = _cancel_by_stamp = _cancel_by_both = _cancel_all = _cancel_goals

    # Statuses and events

    async def _goals(self, deed: Deed) -> None:
        watch = Watch(self._record, self._state, exact=False)
        infos = await self._client.goals()
        for info in infos:
            watch.info(info, is_known=True)
        if len({info.goal_id for info in infos}) < len(infos):
            how = " (its connection was lost)" if self._state.losses else ""
            self._record.fail("status", f"{self._plan.name}: a goal is listed twice{how}: {infos}")

    async def _events(self, deed: Deed) -> None:
        watch = Watch(self._record, self._state, exact=self._record.scenario.climate == "calm")
        with move_on_after(deed.delay + WATCHED):
            async with self._client.events(feedback=bool(deed.count)) as events:
                async for event in events:
                    if isinstance(event, GoalFeedback):
                        watch.feedback(event.goal_id, event.number, event.feedback)
                    else:
                        watch.info(event, is_known=True)

    async def _statuses(self, deed: Deed) -> None:
        watch = Watch(self._record, self._state, exact=self._record.scenario.climate == "calm")
        with move_on_after(deed.delay + WATCHED):
            with await self._client.endpoint.status() as statuses:
                known = statuses.known
                while (info := await statuses.receive()) is not None:
                    watch.info(info, is_known=known > 0)
                    known -= 1

    async def _wait_for_server(self, deed: Deed) -> None:
        await self._client.wait_for_server()

    async def _ask(self, deed: Deed) -> None:
        names = [info.name for info in await self._connection.actions()]
        peers = await self._connection.peers(SIMULATED.name)
        if names != [SIMULATED.name] or not all("-" in name for name in peers.clients):
            self._record.fail("outcome", f"{self._plan.name} is told of {names} and {peers}")


def _decoded(outcome: Outcome[bytes]) -> Outcome[Done]:
    return outcome.decoded(SIMULATED.result.decode)
