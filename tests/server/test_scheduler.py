"""The scheduler: what runs, what waits and what gives way."""

import math

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fibaction import GoalID
from fibaction.server.schedule import Schedule
from fibaction.server.scheduler import Act, Busy, Order, Scheduler


def goal(number):
    return GoalID(number.to_bytes(16, "big"))


ONE, TWO, THREE, FOUR = map(goal, range(1, 5))


class Fleet(RuleBasedStateMachine):
    """A scheduler beside a plain model: lists, and no data structures that could be wrong."""

    @initialize(
        concurrency=st.none() | st.integers(1, 3),
        total=st.none() | st.integers(1, 4),
        queue=st.integers(0, 3),
        when_full=st.sampled_from(["reject", "preempt", "replace"]),
        by_priority=st.booleans(),
        queue_timeout=st.sampled_from([math.inf, 5.0]),
        run_timeout=st.sampled_from([math.inf, 7.0]),
    )
    def begin(self, concurrency, total, queue, when_full, by_priority, queue_timeout, run_timeout):
        if concurrency is None and total is None:
            queue = 0
        if when_full == "replace" and not queue:
            when_full = "reject"
        self.rules = Schedule(
            concurrency=concurrency,
            total=total,
            queue=queue,
            when_full=when_full,
            priority=(lambda _: 0) if by_priority else None,
            queue_timeout=queue_timeout,
            run_timeout=run_timeout,
        )
        self.scheduler = Scheduler(self.rules, kill_after=3.0)
        self.now = 0.0
        self.count = 0
        self.running: list[GoalID] = []
        self.waiting: list[GoalID] = []
        self.interrupted: dict[GoalID, float] = {}
        self.killed: set[GoalID] = set()
        self.key: dict[GoalID, int] = {}
        self.urgency: dict[GoalID, tuple[float, int]] = {}
        self.since: dict[GoalID, float] = {}
        self.successors: dict[GoalID, GoalID] = {}  # by what they wait for

    def carry_out(self, orders, *, new=None):
        for act, goal_id, _ in orders:
            if act is Act.START:
                self.start(goal_id, new=new)
            elif act is Act.END:
                self.waiting.remove(goal_id)
                self.forget_successor(goal_id)
            elif act is Act.INTERRUPT:
                assert goal_id in self.running
                assert goal_id not in self.interrupted
                self.interrupted[goal_id] = self.now
            else:
                assert self.now >= self.interrupted[goal_id] + 3
                assert goal_id not in self.killed
                self.killed.add(goal_id)

    def start(self, goal_id, *, new):
        """Check that this goal is the one that the rules start."""
        key = self.key[goal_id]
        if goal_id in self.waiting:
            self.waiting.remove(goal_id)
            queued = [one for one in self.waiting if one not in self.successors.values()]
            if goal_id not in self.successors.values():
                assert all(
                    self.urgency[goal_id] < self.urgency[one]
                    for one in queued
                    if self.key[one] == key or self.has_place(self.key[one])
                )
            self.forget_successor(goal_id)
        else:
            assert goal_id == new
        assert self.has_place(key)
        self.running.append(goal_id)
        self.since[goal_id] = self.now

    def forget_successor(self, goal_id):
        self.successors = {a: b for a, b in self.successors.items() if b != goal_id}

    def has_place(self, key):
        at_key = sum(self.key[one] == key for one in self.running)
        rules = self.rules
        return (rules.concurrency is None or at_key < rules.concurrency) and (
            rules.total is None or len(self.running) < rules.total
        )

    @rule(key=st.integers(0, 2), urgency=st.integers(0, 2))
    def offer(self, key, urgency):
        self.count += 1
        new = goal(self.count)
        urgency = urgency if self.rules.priority else 0
        self.key[new], self.urgency[new] = key, (urgency, self.count)
        queued = [
            one
            for one in self.waiting
            if self.key[one] == key and one not in self.successors.values()
        ]
        had_place, had_room = self.has_place(key), len(queued) < self.rules.queue
        try:
            orders = self.scheduler.offer(new, key=key, urgency=urgency, now=self.now)
        except Busy as exc:
            assert not had_place
            assert not had_room
            assert "busy: " in str(exc)
            if self.rules.when_full == "preempt":
                at_key = [one for one in self.running if self.key[one] == key]
                assert all(
                    self.rules.priority and self.urgency[self.successors.get(one, one)][0] <= urgency
                    for one in at_key
                )
            else:
                assert self.rules.when_full == "reject"
            return
        self.since[new] = self.now
        acts = [order.act for order in orders]
        if had_place:
            assert orders == [Order(Act.START, new)]
        else:
            self.waiting.append(new)
            assert Act.START not in acts
            if had_room:
                assert orders == []
            elif self.rules.when_full == "replace":
                assert orders == [Order(Act.END, queued[-1], f"replaced by {new}")]
            else:
                assert all(order.reason == f"preempted by {new}" for order in orders)
        self.carry_out(orders, new=new)
        if not had_place and not had_room and self.rules.when_full == "preempt":
            (old,) = [one for one in self.running if self.scheduler.successor(one) == new]
            assert self.key[old] == key
            self.successors[old] = new

    @precondition(lambda self: self.running)
    @rule(data=st.data())
    def end(self, data):
        ended = data.draw(st.sampled_from(self.running))
        self.running.remove(ended)
        self.interrupted.pop(ended, None)
        self.killed.discard(ended)
        self.carry_out(self.scheduler.leave(ended, self.now))
        assert ended not in self.successors
        assert self.scheduler.leave(ended, self.now) == []

    @precondition(lambda self: self.waiting)
    @rule(data=st.data())
    def cancel(self, data):
        canceled = data.draw(st.sampled_from(self.waiting))
        self.waiting.remove(canceled)
        self.forget_successor(canceled)
        self.carry_out(self.scheduler.leave(canceled, self.now))

    @precondition(lambda self: self.running)
    @rule(data=st.data())
    def take_over(self, data):
        old = data.draw(st.sampled_from(self.running))
        successor = self.scheduler.take_over(old, self.now)
        assert successor == self.successors.pop(old, None)
        if successor is not None:
            self.running.remove(old)
            self.interrupted.pop(old, None)
            self.killed.discard(old)
            self.waiting.remove(successor)
            self.running.append(successor)
            self.since[successor] = self.now

    @rule(seconds=st.sampled_from([1.0, 2.0, 5.0]))
    def pass_time(self, seconds):
        self.now += seconds
        before = self.scheduler.next_due
        orders = self.scheduler.due(self.now)
        assert bool(orders) == (before <= self.now)
        self.carry_out(orders)
        for one in self.waiting:
            assert self.now < self.since[one] + self.rules.queue_timeout
        for one in self.running:
            if one not in self.interrupted:
                assert self.now < self.since[one] + self.rules.run_timeout
            elif one not in self.killed:
                assert self.now < self.interrupted[one] + 3

    @invariant()
    def no_goal_waits_beside_a_free_place(self):
        if hasattr(self, "rules"):
            queued = set(self.waiting) - set(self.successors.values())
            assert not any(self.has_place(self.key[one]) for one in queued)
            assert set(self.scheduler.places()) == set(self.waiting)

    def teardown(self):
        if not hasattr(self, "rules"):
            return
        while self.running:
            ended = self.running.pop()
            self.interrupted.pop(ended, None)
            self.killed.discard(ended)
            self.carry_out(self.scheduler.leave(ended, self.now))
        assert not self.waiting
        for table in ("_groups", "_entries", "_waiting", "_timed", "_interrupted"):
            assert not getattr(self.scheduler, table), table


TestFleet = Fleet.TestCase
TestFleet.settings = settings(max_examples=300, stateful_step_count=40, deadline=None)
