"""Deliberate mistakes in the schedule of a server, beside those of `faults`."""

from __future__ import annotations

import math
from typing import Any

from fibaction import GoalID
from fibaction.server.execution.executor import Execution
from fibaction.server.execution.runs import Runs
from fibaction.server.life import Event, Phase
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.scheduling.goal_dispatcher import GoalDispatcher
from fibaction.server.scheduling.scheduled_goals import Act, Busy, Entry, Group, Order, busy_text
from fibaction.server.scheduling.scheduler import Scheduler
from tests.simulation.faults import making, mistake

AnyRuns = Runs[Any, Any, Any]
AnyDispatcher = GoalDispatcher[Any]


# Places


@making(GoalDispatcher, "left", 3, 5)
def a_place_is_not_given_back(real: Any) -> Any:
    """Keep the place of every third goal."""
    calls = [0]

    def left(self: AnyDispatcher, goal_id: GoalID) -> None:
        calls[0] += 1
        if calls[0] % 3:
            real(self, goal_id)

    return left


@mistake(Scheduler, "_has_capacity", 5, 13, 16)
def a_limit_is_off_by_one(real: Any, self: Scheduler, group: Group) -> Any:
    """Let one more goal run than `concurrency` says."""
    limit = self._schedule.concurrency
    return real(self, group) or (limit is not None and len(group.running) == limit)


@mistake(Scheduler, "_has_capacity", 42, 60, 55)
def the_total_is_not_kept(_real: Any, self: Scheduler, group: Group) -> Any:
    """Limit the goals of each key only."""
    limit = self._schedule.concurrency
    return limit is None or len(group.running) < limit


@mistake(Scheduler, "leave", 29, 41, 40)
def two_goals_start_for_one_place(real: Any, self: Scheduler, goal_id: GoalID, now: float) -> Any:
    """Start the next waiting goal of the key, too, if a successor starts."""
    entry = self._entries.get(goal_id)
    orders: list[Order] = real(self, goal_id, now)
    if entry is not None and orders and (first := entry.group.first()) is not None:
        orders.append(self._start(first, now))
    return orders


@making(Scheduler, "leave", 5, 16)
def a_free_place_is_given_to_no_goal(real: Any) -> Any:
    """Start no waiting goal when one that was canceled leaves."""
    calls = [0]

    def leave(self: Scheduler, goal_id: GoalID, now: float) -> list[Order]:
        calls[0] += 1
        orders: list[Order] = real(self, goal_id, now)
        return [] if calls[0] % 4 == 3 else orders

    return leave


@mistake(Runs, "kill", 5, 22, 39)
def a_killed_goal_leaves_before_its_executor(
    real: Any, self: AnyRuns, goal_id: GoalID, reason: str = "", *, for_good: bool
) -> Any:
    """Free the place of a killed goal although its executor still runs."""
    real(self, goal_id, reason, for_good=for_good)
    self._dispatcher.left(goal_id)


# Waiting


@mistake(Runs, "cancel", 5, 25, 26)
def a_canceled_goal_is_left_waiting(
    real: Any, self: AnyRuns, goal: GoalRecord, *, interrupt: bool
) -> Any:
    """Tell that a goal is canceling, and let it wait on."""
    if goal.phase is Phase.WAITING:
        self._logs._tell(self._runs[goal.goal_id], goal.status)
    else:
        real(self, goal, interrupt=interrupt)


@mistake(GoalDispatcher, "offer", 5, 13, 26)
def priority_is_ignored(real: Any, self: AnyDispatcher, *args: Any) -> Any:
    """Start goals in the order of their arrival alone."""
    self._functions = [one for one in self._functions if one[0] != "priority"]
    return real(self, *args)


@mistake(GoalDispatcher, "offer", 27, 60, 66)
def keys_are_ignored(real: Any, self: AnyDispatcher, *args: Any) -> Any:
    """Count the goals of all keys together."""
    self._functions = [one for one in self._functions if one[0] != "key"]
    return real(self, *args)


@mistake(Group, "first", 48, 101, 41)
def the_goal_that_has_waited_longest_starts_last(_real: Any, self: Group) -> Any:
    """Start the goal that came last, whatever its urgency."""
    return next(reversed(self.queue.values()), None)


@mistake(Scheduler, "offer", 35, 29, 45)
def a_goal_is_rejected_though_it_may_wait(
    real: Any, self: Scheduler, goal_id: GoalID, **keywords: Any
) -> Any:
    """Let one goal less wait than `queue` says."""
    group = self._groups.get(keywords["key"])
    if group is not None and len(group.queue) == self._schedule.queue - 1:
        raise Busy(busy_text(self._schedule, group, self._running))
    return real(self, goal_id, **keywords)


@making(Scheduler, "next_due", 5, 16, 3)
def no_timeout_is_kept(_real: Any) -> Any:
    """Let goals wait, run and clean up for as long as they like."""
    return property(lambda _: math.inf)


@mistake(GoalDispatcher, "_keep_time", 5, 16, 3)
async def a_timeout_is_noticed_late(real: Any, self: AnyDispatcher) -> Any:
    """Do not set the timer anew for an order that is due earlier."""

    class Deaf:
        def notify(self) -> None:
            pass

        wait = self._shared.news.wait

    self._shared.news = Deaf()  # type: ignore[assignment]  # it has what is called
    await real(self)


# Giving way


@mistake(GoalDispatcher, "carry_out", 5, 16, 22)
def a_successor_starts_before_the_clean_up_has_ended(
    real: Any, self: AnyDispatcher, order: Order
) -> Any:
    """Free the place of a goal as soon as it is interrupted."""
    real(self, order)
    if order.act is Act.INTERRUPT:
        self.left(order.goal_id)


@mistake(Group, "oldest", 426, 150, 393)
def the_newest_goal_is_preempted(_real: Any, self: Group) -> Any:
    """Preempt the goal that has run for the shortest time."""
    return next(reversed(self.running.values()), None)


@mistake(Scheduler, "_give_way", 213, 101, 41)
def the_oldest_goal_is_replaced(real: Any, self: Scheduler, entry: Entry, reason: str) -> Any:
    """Replace the goal that has waited longest."""
    if reason.startswith("replaced"):
        entry = next(iter(entry.group.queue.values()))
    return real(self, entry, reason)


@mistake(Runs, "interrupt", 5, 16)
def a_reason_is_not_told(real: Any, self: AnyRuns, goal_id: GoalID, _reason: str) -> Any:
    """End goals without the reason of the schedule."""
    real(self, goal_id, "the server ended it")


@mistake(Scheduler, "_remove", 5, 40, 42)
def a_goal_is_preempted_for_one_that_has_left(real: Any, self: Scheduler, entry: Entry) -> Any:
    """Interrupt a goal after its handover although its successor was canceled."""
    predecessor, entry.predecessor = entry.predecessor, None
    real(self, entry)
    if predecessor is not None and predecessor.goal_id not in self._timed.told:
        predecessor.successor = None


# Taking over


@mistake(Runs, "take_over", 104, 40)
def a_take_over_keeps_both_goals(
    _real: Any, self: AnyRuns, goal_id: GoalID, successor: GoalID
) -> Any:
    """Let the first goal go on beside the one that was taken over."""
    old, new = self._runs[goal_id], self._runs[successor]
    old.execution.go_on_as(new.execution.handle, new.log)
    new.execution = old.execution
    self._step(new, Event.TAKE_OVER)


@mistake(Scheduler, "take_over", 104, 40, 55)
def a_take_over_takes_a_second_place(
    _real: Any, self: Scheduler, goal_id: GoalID, now: float
) -> Any:
    """Keep the place of the goal that ended when its successor was taken over."""
    entry = self._timed.told.pop(goal_id)
    successor, entry.successor = entry.successor, None
    assert successor is not None
    successor.predecessor = None
    self._start(successor, now)
    return successor.goal_id


@mistake(Runs, "is_interrupted", 150, 448, 481)
def a_goal_is_taken_over_in_the_clean_up(_real: Any, self: AnyRuns, goal_id: GoalID) -> Any:
    """Let an executor that was canceled take its successor over."""
    return goal_id not in self._runs


@mistake(Execution, "go_on_as", 227, 331, 40)
def feedback_goes_to_the_goal_before(
    real: Any, self: Execution[Any, Any, Any], handle: Any, log: Any
) -> Any:
    """Append the feedback of a goal that was taken over to the log of the first one."""
    before = self._log
    real(self, handle, log)
    self._log = before
