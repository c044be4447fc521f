"""`GoalDispatcher`: carries out a schedule: starts, ends, interrupts and kills goals on time.

Theory of operation
-------------------

The `Scheduler` knows the rules, and returns orders; `Runs` can start and end goals. The dispatcher
stands between them. `Admission` asks it for a place (`offer`) before it accepts a goal, and says
when the goal is `accepted`, so that no goal gives way to one that is rejected after all. `Runs`
tells it when a goal has `left`, which frees the place.

With a store, a goal has its place while its acceptance is still being written, and `Runs` does not
have it yet. Orders for such a goal are held back (`_held`), and carried out when it is accepted. So
are those that it causes: the interruption of another goal may come later than its kill is due. If
the goal is not accepted after all, those for other goals are carried out anyway, because the
scheduler counts on them.

A goal that another server has taken over keeps its place until its executor is gone, and gets no
more orders (`lost`).

One task, `_keep_time`, waits for the next time at which an order is due. It is woken only if that
time becomes earlier.

The scheduler is that of all servers with the same schedule: see `shared_scheduler`. An order of one
of them may concern a goal of another.

It is also the `Succession` by which an executor takes its successor over.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Coroutine, Hashable
from typing import TYPE_CHECKING, Any

import anyio
from anyio import current_time
from anyio.abc import TaskGroup

from fibaction._runtime.notify import Notifier
from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import OpenKeySlots
from fibaction.server.admission.callbacks import failures_as
from fibaction.server.admission.sender_argument import with_sender
from fibaction.server.execution.executor_ends import warn_of_kill
from fibaction.server.scheduling.dispatcher import DispatchedGoals, Dispatcher
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.scheduling.scheduled_goals import Act, Order
from fibaction.server.scheduling.shared_scheduler import SharedScheduler, portable
from fibaction.types.action import GoalT
from fibaction.words.errors import FAILURES, GoalRejected, text_of
from fibaction.words.goals import GoalID, Sender

if TYPE_CHECKING:
    from fibaction.server.goal_handle import GoalHandle

ORDERS_IN_A_TURN = 200
"""Orders that are carried out in one turn of the event loop when their time has come."""

MANY, POSITIONS_TIME = 1000, 0.1
"""If more goals wait than that, the seconds for which their places are not computed again."""


class GoalDispatcher(Dispatcher[GoalT]):
    """The schedule of one server at work."""

    def __init__(self, schedule: Schedule, *, action: str, kill_after: float) -> None:
        """Kill executors that have not ended `kill_after` seconds after they were interrupted."""
        super().__init__()
        self._schedule = schedule
        self._shared: SharedScheduler
        as_key: Callable[[Any], Hashable] = portable if schedule.fleet_limit else _hashable
        self._functions = [
            (name, check, with_sender(name, function))
            for name, check, function in (
                ("key", as_key, schedule.key),
                ("priority", _number, schedule.priority),
            )
            if function is not None
        ]
        self._changed: Callable[[], None]
        self._action = action
        self.kill_after = kill_after
        self._reads_clock = (
            schedule.when_full == "preempt"
            or schedule.skip_expired
            or min(schedule.queue_timeout, schedule.run_timeout) < math.inf
        )
        self._skips_expired = schedule.skip_expired
        self._successor_news: dict[GoalID, Notifier] = {}
        self._held: dict[GoalID, list[Order]] = {}  # for goals that are not accepted yet
        self._overdue: set[GoalID] = set()  # to be killed when their interruption is carried out
        self._positioned_at = -math.inf
        self._is_started, self._news_of_start = False, Notifier()

    async def open(
        self,
        tasks: TaskGroup,
        goals: DispatchedGoals[GoalT],
        changed: Callable[[], None],
        key_slots: OpenKeySlots,
    ) -> None:
        self._goals, self._changed = goals, changed
        self._shared = await self._join(key_slots)
        tasks.start_soon(self._keep_time, name=f"schedule of {self._action}")

    def start(self) -> None:
        if not self._is_started:
            self._is_started = True
            self._shared.scheduler.restart(self, current_time())
            self._news_of_start.notify()

    async def _join(self, key_slots: OpenKeySlots) -> SharedScheduler:
        """Return the scheduler of all servers with this schedule."""
        schedule = self._schedule
        if not schedule.fleet_limit:
            return SharedScheduler.join(schedule, self)
        assert schedule.concurrency is not None
        slots = await key_slots(schedule.fleet_limit, schedule.concurrency)
        return SharedScheduler.join(schedule, self, slots)

    # Goals

    def offer(self, goal_id: GoalID, request: GoalT, sender: Sender, deadline: float) -> bool:
        key, urgency = self._rank(request, sender)
        orders = self._shared.scheduler.offer(
            goal_id,
            owner=self,
            key=key,
            urgency=urgency,
            now=self._now(),
            expires=self._expires(deadline),
        )
        self._held[goal_id] = orders
        return any(order.act is Act.START for order in orders)

    def resume(
        self, goal_id: GoalID, request: GoalT, sender: Sender, deadline: float, waited: float
    ) -> None:
        key, urgency = self._rank(request, sender)
        orders = self._shared.scheduler.restore(
            goal_id,
            owner=self,
            key=key,
            urgency=urgency,
            now=self._now(),
            waited=waited,
            expires=self._expires(deadline),
        )
        self._shared.carry_out(orders)

    def failure_of(self, request: GoalT, sender: Sender) -> str:
        for name, check, function in self._functions:
            try:
                _asked(check, function, request, sender)
            except GoalRejected:
                return ""  # as the function wants it
            except FAILURES as exc:
                return f"{name} failed: {text_of(exc)}"
        return ""

    def _expires(self, deadline: float) -> float:
        return deadline if self._skips_expired else math.inf

    def _rank(self, request: GoalT, sender: Sender) -> tuple[Hashable, float]:
        """Return the key of a goal, and its urgency in a queue: the smaller, the more urgent.

        Raises:
            GoalRejected: A function of the schedule raised this or another exception, or its answer
                cannot be used.
        """
        rank: dict[str, Any] = {"key": None, "priority": 0.0}
        for name, check, function in self._functions:
            with failures_as(GoalRejected, name, self._action):
                rank[name] = _asked(check, function, request, sender)
        return rank["key"], -rank["priority"]  # in a queue, the smallest number is the first

    def accepted(self, goal_id: GoalID) -> None:
        self._shared.carry_out(self._held.pop(goal_id, ()))

    def withdraw(self, goal_id: GoalID) -> None:
        held = self._held.pop(goal_id, ())
        self._shared.carry_out(order for order in held if order.goal_id != goal_id)
        self.left(goal_id)

    def capacity(self) -> tuple[float, float]:
        return self._shared.scheduler.capacity()

    def carry_out(self, order: Order) -> None:
        """Carry out an order for a goal of this server."""
        if self._is_closed:
            return
        act, goal_id, reason, _ = order
        if self._held and goal_id in self._held:
            self._held[goal_id].append(order)
        elif act is Act.START:
            self._goals.begin(goal_id)
        elif act is Act.TELL:
            self._tell(goal_id)
        elif act is Act.KILL:
            if self._goals.is_interrupted(goal_id):
                self._kill(goal_id)
            else:
                self._overdue.add(goal_id)
        else:
            self._goals.interrupt(goal_id, reason)
            if act is Act.INTERRUPT and self._overdue and goal_id in self._overdue:
                self._kill(goal_id)

    def _kill(self, goal_id: GoalID) -> None:
        self._overdue.discard(goal_id)
        warn_of_kill(goal_id, self._action, self.kill_after)
        self._goals.kill(goal_id, for_good=False)

    def left(self, goal_id: GoalID) -> None:
        self._overdue.discard(goal_id)
        self._tell(goal_id)
        self._shared.leave(self, goal_id, self._now())

    def note_change(self) -> None:
        """Tell the server that a place has become free."""
        self._changed()

    def hold(self, goal_id: GoalID) -> None:
        self._shared.scheduler.lose(goal_id)

    def go_on(self, goal_id: GoalID) -> None:
        self._shared.carry_out(self._shared.scheduler.go_on(goal_id, self._now()))

    def lost(self, goal_id: GoalID) -> None:
        self._overdue.discard(goal_id)
        self._shared.scheduler.lose(goal_id)

    def _now(self) -> float:
        """Return the time; 0 if no rule of the schedule needs it, because anyio takes a while to
        find the clock.
        """
        return current_time() if self._reads_clock else 0.0

    async def _keep_time(self) -> None:
        shared = self._shared
        try:
            if not self._is_started:
                await self._news_of_start.wait()
            while True:
                shared.wake_at = shared.scheduler.next_due
                with anyio.CancelScope(deadline=shared.wake_at):
                    await shared.news.wait()
                shared.carry_out(shared.scheduler.due(current_time(), ORDERS_IN_A_TURN))
        finally:
            shared.quit(self, current_time())

    def note_positions(self) -> None:
        """Note in the records of waiting goals their places in the queue, for observers.

        If very many wait, the places may be POSITIONS_TIME old, since any observer may ask often.
        """
        now = current_time()
        is_fast = self._shared.scheduler.waiting <= MANY
        if not self._is_closed and (is_fast or now >= self._positioned_at + POSITIONS_TIME):
            self._positioned_at = now
            for goal_id, position in self._shared.scheduler.positions().items():
                if (record := self._goals.record_of(goal_id)) is not None:
                    record.place = position

    # As a succession

    def successor(self, goal_id: GoalID) -> GoalHandle[GoalT] | None:
        # An interrupted executor ends, and would end its successor as well.
        if self._is_closed or self._goals.is_interrupted(goal_id):
            return None
        successor = self._shared.scheduler.successor(goal_id)
        if successor is None or successor in self._held:
            return None
        return self._goals.handle_of(successor)

    def news_of(self, goal_id: GoalID) -> Notifier:
        return self._successor_news.setdefault(goal_id, Notifier())

    def take_over(self, goal_id: GoalID) -> GoalHandle[GoalT]:
        successor = self.successor(goal_id)
        if successor is None:
            raise RuntimeError(f"goal {goal_id} has no successor that it may take over")
        self._goals.take_over(goal_id, successor.goal_id)
        self._shared.scheduler.take_over(goal_id, current_time())
        self._tell(goal_id)
        self._shared.carry_out(())
        return successor

    def _tell(self, goal_id: GoalID) -> None:
        news = self._successor_news.pop(goal_id, None)
        if news is not None:
            news.notify()


def _asked(
    check: Callable[[Any], Any],
    function: Callable[[GoalT, Sender], Any],
    request: GoalT,
    sender: Sender,
) -> Any:
    """Return what a function of the schedule returns, as `check` returns it."""
    answer = function(request, sender)
    if isinstance(answer, Awaitable):
        if isinstance(answer, Coroutine):
            answer.close()  # or Python warns that it was never awaited
        raise TypeError("it returned something to await, and not a value")
    return check(answer)


def _hashable(key: Hashable) -> Hashable:
    """Return a key that can be found again.

    Raises:
        TypeError, ValueError: It is not hashable, or not equal to itself.
    """
    hash(key)
    if key != key:
        raise ValueError(f"it returned {excerpt(repr(key))}, which is not equal to itself")
    return key


def _number(urgency: object) -> float:
    """Return an urgency that can be compared with others.

    Raises:
        TypeError, ValueError: It is not a number, or not a number that can be compared.
    """
    if not isinstance(urgency, int | float):
        raise TypeError(f"it returned {excerpt(repr(urgency))}, which is not a number")
    if math.isnan(urgency):
        raise ValueError("it returned nan, which is not before or after any number")
    return urgency
