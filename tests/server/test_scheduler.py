"""The scheduler: the order in which goals run, wait and give way."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fibaction import GoalID, Schedule
from fibaction.server.scheduling.scheduled_goals import Act, Busy, Order
from fibaction.server.scheduling.scheduler import EXPIRED, Scheduler
from tests.server.held import id_of

KILL_AFTER = 3.0
LASTS = st.sampled_from([math.inf, math.inf, 0.0, 2.0])
"""Seconds until a goal expires."""


ONE, TWO, THREE = map(id_of, range(1, 4))


def rules_of(
    *,
    concurrency: int | None,
    total: int | None,
    queue: int,
    when_full: Any,
    by_priority: bool,
    queue_timeout: float,
    run_timeout: float,
    handover: float,
) -> Schedule:
    """Return the nearest schedule that is valid."""
    if concurrency is None and total is None:
        queue, when_full = 0, "reject"
    if when_full == "replace" and not queue:
        when_full = "reject"
    return Schedule(
        concurrency=concurrency,
        total=total,
        queue=queue,
        when_full=when_full,
        priority=(lambda _: 0) if by_priority and (concurrency or total) else None,
        queue_timeout=queue_timeout if queue or when_full == "preempt" else math.inf,
        run_timeout=run_timeout,
        handover=handover if when_full == "preempt" else 0.0,
    )


class Fleet(RuleBasedStateMachine):
    """A scheduler beside a plain model: lists, and no data structures that could be wrong."""

    @initialize(
        concurrency=st.none() | st.integers(1, 3),
        total=st.none() | st.integers(1, 4),
        queue=st.integers(0, 3),
        when_full=st.sampled_from(["reject", "preempt", "preempt", "replace"]),
        by_priority=st.booleans(),
        queue_timeout=st.sampled_from([math.inf, 5.0]),
        run_timeout=st.sampled_from([math.inf, 7.0]),
        handover=st.sampled_from([0.0, 2.0, math.inf]),
    )
    def begin(self, **rules: Any) -> None:
        self.limits = rules_of(**rules)
        self.scheduler = Scheduler(self.limits, kill_after=KILL_AFTER)
        self.now = 0.0
        self.count = 0
        self.running: list[GoalID] = []  # in the order of their start
        self.queue: list[GoalID] = []  # in the order in which they came into it
        self.successors: dict[GoalID, GoalID] = {}  # by their predecessors
        self.told: dict[GoalID, float] = {}
        self.interrupted: dict[GoalID, float] = {}
        self.killed: set[GoalID] = set()
        self.key: dict[GoalID, int] = {}
        self.urgency: dict[GoalID, tuple[float, int]] = {}
        self.since: dict[GoalID, float] = {}
        self.expires: dict[GoalID, float] = {}

    def has_place(self, key: int) -> bool:
        at_key = sum(self.key[one] == key for one in self.running)
        rules = self.limits
        return (rules.concurrency is None or at_key < rules.concurrency) and (
            rules.total is None or len(self.running) < rules.total
        )

    def room(self, key: int) -> int:
        return self.limits.queue - sum(self.key[one] == key for one in self.queue)

    def forget(self, goal_id: GoalID) -> None:
        """Note that a waiting goal waits no longer."""
        if goal_id in self.queue:
            self.queue.remove(goal_id)
        for predecessor, successor in tuple(self.successors.items()):
            if successor == goal_id:
                del self.successors[predecessor]
                self.told.pop(predecessor, None)

    def start(self, goal_id: GoalID) -> None:
        self.forget(goal_id)
        assert self.has_place(self.key[goal_id])
        self.running.append(goal_id)
        self.since[goal_id] = self.now

    def start_next(self) -> list[Order]:
        """Start the goals of the queue that have a place now, and return the orders for it."""
        orders = []
        while able := [one for one in self.queue if self.has_place(self.key[one])]:
            first = min(able, key=lambda one: self.urgency[one])
            orders.append(self.turn(first))
        return orders

    def turn(self, goal_id: GoalID) -> Order:
        """Start a goal that has waited, unless it has expired."""
        if self.expires[goal_id] <= self.now:
            self.forget(goal_id)
            return Order(Act.END, goal_id, EXPIRED)
        self.start(goal_id)
        return Order(Act.START, goal_id)

    def predecessor_of(self, new: GoalID) -> GoalID | None:
        """Return the goal that the rules preempt for a new one."""
        key = self.key[new]
        rules = self.limits
        if rules.when_full != "preempt" or (self.room(key) > 0 and not rules.priority):
            return None
        at_key = [one for one in self.running if self.key[one] == key]
        able = [one for one in at_key if one not in self.successors] or at_key
        if not able:
            return None
        last = {one: self.successors.get(one, one) for one in able}
        if not rules.priority:
            if able == at_key and all(one in self.successors for one in able):
                return min(able, key=lambda one: self.urgency[last[one]][1])
            return able[0]
        least = max(able, key=lambda one: (self.urgency[last[one]][0], -self.urgency[last[one]][1]))
        return least if self.urgency[new][0] < self.urgency[last[least]][0] else None

    def arrive(self, key: int, urgency: int, lasts: float) -> tuple[GoalID, dict[str, Any]]:
        """Return a new goal, and what the scheduler is told of it."""
        self.count += 1
        new = id_of(self.count)
        self.key[new] = key
        self.urgency[new] = (urgency if self.limits.priority else 0, self.count)
        self.expires[new] = self.now + lasts
        told = {"urgency": self.urgency[new][0], "now": self.now, "expires": self.expires[new]}
        return new, {"key": key, **told}

    @rule(key=st.integers(0, 2), urgency=st.integers(0, 2), lasts=LASTS)
    def offer(self, key: int, urgency: int, lasts: float) -> None:
        new, told = self.arrive(key, urgency, lasts)
        expected = self.place(new)
        if expected is None:
            with pytest.raises(Busy, match=r"^busy: \d of \d running"):
                self.scheduler.offer(new, **told)
        else:
            assert self.scheduler.offer(new, **told) == expected

    @rule(
        key=st.integers(0, 2),
        urgency=st.integers(0, 2),
        waited=st.sampled_from([0.0, 0.0, 4.0, 5.0, 9.0]),
        lasts=LASTS,
    )
    def restore(self, key: int, urgency: int, waited: float, lasts: float) -> None:
        new, told = self.arrive(key, urgency, lasts)
        self.since[new] = self.now - waited
        expected = []
        if waited >= self.limits.queue_timeout:
            expected.append(Order(Act.END, new, "waited for 5 s"))
        elif not lasts:
            expected.append(Order(Act.END, new, EXPIRED))
        elif self.has_place(key):
            self.start(new)
            expected.append(Order(Act.START, new))
        else:
            self.queue.append(new)  # beyond any limit
        assert self.scheduler.restore(new, waited=waited, **told) == expected

    def place(self, new: GoalID) -> list[Order] | None:
        """Give a new goal its place in the model, and return the orders; None if it has none."""
        key = self.key[new]
        self.since[new] = self.now
        if self.has_place(key):
            self.start(new)
            return [Order(Act.START, new)]
        predecessor = self.predecessor_of(new)
        if predecessor is not None:
            return self.preempt(predecessor, new)
        if self.room(key) > 0:
            self.queue.append(new)
            return []
        if self.limits.when_full == "replace":
            newest = [one for one in self.queue if self.key[one] == key][-1]
            self.queue.remove(newest)
            self.queue.append(new)
            return [Order(Act.END, newest, f"replaced by {new}")]
        return None

    def preempt(self, predecessor: GoalID, new: GoalID) -> list[Order]:
        orders = []
        reason = f"preempted by {new}"
        if predecessor in self.successors:
            earlier = self.successors.pop(predecessor)
            if self.room(self.key[new]) > 0:
                self.queue.append(earlier)
            else:
                orders.append(Order(Act.END, earlier, reason))
        self.successors[predecessor] = new
        if predecessor in self.interrupted or predecessor in self.told:
            return orders
        if self.limits.handover:
            self.told[predecessor] = self.now
            return [*orders, Order(Act.TELL, predecessor)]
        self.interrupted[predecessor] = self.now
        return [*orders, Order(Act.INTERRUPT, predecessor, reason)]

    def gone(self, goal_id: GoalID) -> GoalID | None:
        """Note that a running goal has left; return its successor."""
        self.running.remove(goal_id)
        self.interrupted.pop(goal_id, None)
        self.told.pop(goal_id, None)
        self.killed.discard(goal_id)
        return self.successors.pop(goal_id, None)

    @precondition(lambda self: self.running)
    @rule(data=st.data())
    def end(self, data: st.DataObject) -> None:
        self.end_one(data.draw(st.sampled_from(self.running)))

    def end_one(self, ended: GoalID) -> None:
        successor = self.gone(ended) or self.next_successor(self.key[ended])
        if successor is None:
            expected = self.start_next()
        else:
            order = self.turn(successor)
            expected = [order, *(() if order.act is Act.START else self.start_next())]
        assert self.scheduler.leave(ended, self.now) == expected
        assert self.scheduler.leave(ended, self.now) == []

    def next_successor(self, key: int) -> GoalID | None:
        """Return the goal that waits for another one, and has a free place now."""
        able = [one for one in self.successors.values() if self.key[one] == key]
        if not self.has_place(key):
            return None
        return min(able, key=lambda one: self.urgency[one], default=None)

    @precondition(lambda self: self.queue or self.successors)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        canceled = data.draw(st.sampled_from([*self.queue, *self.successors.values()]))
        self.forget(canceled)
        assert self.scheduler.leave(canceled, self.now) == []

    @precondition(lambda self: self.running)
    @rule(data=st.data())
    def take_over(self, data: st.DataObject) -> None:
        old = data.draw(st.sampled_from(self.running))
        expected = self.successors[old] if old in self.told else None
        assert self.scheduler.successor(old) == expected
        assert self.scheduler.take_over(old, self.now) == expected
        if expected is not None:
            self.gone(old)
            self.start(expected)

    @rule(seconds=st.sampled_from([1.0, 2.0, 5.0]), limit=st.sampled_from([None, 1, 2]))
    def pass_time(self, seconds: float, limit: int | None) -> None:
        self.now += seconds
        while True:
            is_due = self.scheduler.next_due <= self.now
            orders = self.scheduler.due(self.now, limit)
            assert bool(orders) is is_due
            if not orders:
                break
            assert limit is None or len(orders) <= limit
            for order in orders:
                self.carry_out(order)
        rules = self.limits
        for one in (*self.queue, *self.successors.values()):
            assert self.now < self.since[one] + rules.queue_timeout
        for one in self.running:
            if one not in self.interrupted:
                assert self.now < self.since[one] + rules.run_timeout
                assert self.now < self.told.get(one, math.inf) + rules.handover
            elif one not in self.killed:
                assert self.now < self.interrupted[one] + KILL_AFTER

    def carry_out(self, order: Order) -> None:
        """Carry out an order whose time has come in the model, after a check that it has."""
        rules, (act, goal_id, reason, _) = self.limits, order
        if act is Act.END:
            assert self.now >= self.since[goal_id] + rules.queue_timeout
            assert reason == "waited for 5 s"
            self.forget(goal_id)
        elif act is Act.KILL:
            assert self.now >= self.interrupted[goal_id] + KILL_AFTER
            assert goal_id not in self.killed
            self.killed.add(goal_id)
        else:
            assert act is Act.INTERRUPT
            assert goal_id not in self.interrupted
            self.interrupted[goal_id] = self.now
            told_at = self.told.pop(goal_id, math.inf)
            if reason == "took longer than 7 s":
                assert self.now >= self.since[goal_id] + rules.run_timeout
            else:
                assert self.now >= told_at + rules.handover
                assert reason == f"preempted by {self.successors[goal_id]}"

    @invariant()
    def no_goal_waits_beside_a_free_place(self) -> None:
        assert not any(self.has_place(self.key[one]) for one in self.queue)

    @invariant()
    def the_places_are_in_the_order_of_their_start(self) -> None:
        expected: dict[GoalID, tuple[int, int]] = {}
        for key in range(3):
            # Successors are ahead of the queue.
            waiting = [
                *((0, self.urgency[one], one) for one in self.successors.values()),
                *((1, self.urgency[one], one) for one in self.queue),
            ]
            ordered = [one for *_, one in sorted(waiting) if self.key[one] == key]
            expected |= {one: (place, len(ordered)) for place, one in enumerate(ordered, 1)}
        assert self.scheduler.positions() == expected
        assert self.scheduler.waiting == len(expected)

    def teardown(self) -> None:
        """Check that every goal that waits runs in the end, and that nothing is left behind."""
        while self.running:
            self.end_one(self.running[-1])
        assert not self.queue
        for name, table in vars(self.scheduler).items():
            if isinstance(table, dict):
                assert not table, name


TestFleet = Fleet.TestCase
TestFleet.settings = settings(stateful_step_count=40)


# Sentences


@pytest.mark.parametrize(
    ("rules", "running", "sentence"),
    [
        (Schedule(concurrency=1), 1, "busy: 1 of 1 running, 0 of 0 waiting"),
        (Schedule(concurrency=2, queue=1), 3, "busy: 2 of 2 running, 1 of 1 waiting"),
        (Schedule(total=2), 2, "busy: 2 of 2 running, 0 of 0 waiting"),
        (
            Schedule(concurrency=1, queue=2, fleet_limit="arms"),
            3,
            "busy: 2 of 2 waiting at this worker",
        ),
        (
            Schedule(concurrency=2, total=3),
            2,
            "busy: 2 of 2 running (2 of 3 in all), 0 of 0 waiting",
        ),
    ],
)
def test_a_goal_without_a_place_is_told_the_limits(
    rules: Schedule, running: int, sentence: str
) -> None:
    scheduler = Scheduler(rules)
    for number in range(1, running + 1):
        scheduler.offer(id_of(number), now=0)
    with pytest.raises(Busy) as caught:
        scheduler.offer(id_of(9), now=0)
    assert str(caught.value) == sentence


def told(handover: float, **rules: Any) -> Scheduler:
    """Return a scheduler in which ONE was told of its successor TWO, at 1."""
    schedule = Schedule(concurrency=1, when_full="preempt", handover=handover, **rules)
    scheduler = Scheduler(schedule, kill_after=KILL_AFTER)
    scheduler.offer(ONE, now=0)
    assert scheduler.offer(TWO, now=1) == [Order(Act.TELL, ONE)]
    return scheduler


def test_a_goal_that_is_lost_is_told_and_ordered_nothing_more() -> None:
    scheduler = told(2, run_timeout=7)
    scheduler.lose(ONE)
    assert scheduler.successor(ONE) is None
    assert scheduler.next_due == math.inf
    assert scheduler.due(100) == []
    assert scheduler.leave(ONE, 100) == [Order(Act.START, TWO)]


def test_a_goal_that_was_lost_and_goes_on_has_all_its_time_and_gives_way() -> None:
    scheduler = told(2, run_timeout=7)
    scheduler.lose(ONE)
    assert scheduler.go_on(id_of(9), 100) == scheduler.go_on(TWO, 100) == []
    assert scheduler.go_on(ONE, 100) == [Order(Act.INTERRUPT, ONE, f"preempted by {TWO}")]
    scheduler.leave(ONE, 101)
    scheduler.lose(TWO)
    assert scheduler.go_on(TWO, 200) == []
    assert scheduler.next_due == 207


def test_an_id_that_is_used_again_has_its_own_successor() -> None:
    scheduler = Scheduler(Schedule(concurrency=2, when_full="preempt", handover=math.inf))
    three, four, five = map(id_of, (3, 4, 5))
    scheduler.offer(ONE, now=0)
    scheduler.offer(three, now=0)
    scheduler.offer(TWO, now=0)
    assert scheduler.take_over(ONE, 0) == TWO
    scheduler.leave(three, 0)
    scheduler.offer(ONE, now=0)
    assert scheduler.offer(four, now=0) == [Order(Act.TELL, TWO)]
    assert scheduler.offer(five, now=0) == [Order(Act.TELL, ONE)]
    assert scheduler.leave(TWO, 0) == [Order(Act.START, four)]
    assert scheduler.successor(ONE) == five


def test_a_successor_waits_in_the_queue_when_a_more_urgent_goal_takes_its_place() -> None:
    rules = Schedule(concurrency=1, queue=1, when_full="preempt", priority=lambda _: 0)
    scheduler = Scheduler(rules)
    scheduler.offer(ONE, urgency=3, now=0)
    interruption = Order(Act.INTERRUPT, ONE, f"preempted by {TWO}")
    assert scheduler.offer(TWO, urgency=2, now=0) == [interruption]
    assert scheduler.offer(THREE, urgency=1, now=0) == []
    assert scheduler.leave(ONE, 0) == [Order(Act.START, THREE)]
    assert scheduler.positions() == {TWO: (1, 1)}


@pytest.mark.parametrize(
    ("rules", "running", "waiting"),
    [
        (Schedule(), math.inf, 0),
        (Schedule(concurrency=3, queue=4), 1, 4),
        (Schedule(total=5), 3, 0),
        (Schedule(concurrency=3, total=2, queue=1), 0, 1),
        (Schedule(concurrency=4, total=3), 1, 0),
        (Schedule(concurrency=2, when_full="preempt"), 0, math.inf),
        (Schedule(concurrency=2, queue=1, when_full="replace"), 0, math.inf),
        (Schedule(concurrency=1, queue=1, key=lambda _: None), math.inf, math.inf),
        (Schedule(concurrency=1, key=lambda _: None), math.inf, 0),
    ],
)
def test_the_room_for_more_is_that_of_the_limits(
    rules: Schedule, running: float, waiting: float
) -> None:
    scheduler = Scheduler(rules)
    for number in (1, 2):
        scheduler.offer(id_of(number), key=number if rules.key else None, now=0)
    assert scheduler.capacity() == (running, waiting)


def test_there_is_no_room_where_more_goals_were_restored_than_the_limits_allow() -> None:
    scheduler = Scheduler(Schedule(concurrency=1, queue=1))
    assert scheduler.capacity() == (1, 1)
    for number in range(1, 5):
        scheduler.restore(id_of(number), now=0)
    assert scheduler.waiting == 3
    assert scheduler.capacity() == (0, 0)


def test_keys_keep_their_order_when_those_that_are_out_of_date_are_removed() -> None:
    scheduler = Scheduler(Schedule(total=1, queue=100, priority=lambda _: 0, key=lambda _: None))
    scheduler.offer(ONE, key=0, now=0)
    urgencies = {id_of(number): number * 37 % 101 for number in range(2, 40)}
    for number, (goal_id, urgency) in enumerate(urgencies.items()):
        scheduler.offer(goal_id, key=number % 12 + 1, urgency=urgency, now=0)
    newest = [id_of(number) for number in range(100, 160)]
    for urgency, goal_id in enumerate(newest):  # each is the first of its key, for a while
        scheduler.offer(goal_id, key=13, urgency=-1 - urgency, now=0)
    assert len(scheduler._heads) < 50
    ended = [ONE]
    while orders := scheduler.leave(ended[-1], 0):
        ended.append(orders[0].goal_id)
    assert ended == [ONE, *reversed(newest), *sorted(urgencies, key=lambda one: urgencies[one])]


def test_a_queue_keeps_its_order_when_goals_that_have_left_are_removed_from_it() -> None:
    scheduler = Scheduler(Schedule(concurrency=1, queue=300, priority=lambda _: 0))
    scheduler.offer(ONE, urgency=-1, now=0)
    urgencies = {id_of(number): number * 37 % 211 for number in range(2, 200)}
    for goal_id, urgency in urgencies.items():
        scheduler.offer(goal_id, urgency=urgency, now=0)
    for number in range(20, 190):
        scheduler.leave(id_of(number), 0)
        del urgencies[id_of(number)]
    scheduler.offer(id_of(200), urgency=1000, now=0)
    (group,) = scheduler._groups.values()
    assert len(group._heap) < 2 * len(group.queue) + 20
    ended = [ONE]
    while orders := scheduler.leave(ended[-1], 0):
        ended.append(orders[0].goal_id)
    assert ended == [ONE, *sorted(urgencies, key=lambda one: urgencies[one]), id_of(200)]
