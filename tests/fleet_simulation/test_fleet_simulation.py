"""Some seeds of the simulation of fleets, and mistakes that it finds."""

from __future__ import annotations

import functools
import math
import os
from typing import Any

import pytest

from fibaction.border.goal_store import StoredGoal, Then
from fibaction_transports.nats.client import endpoint
from fibaction_transports.nats.records import next_entry
from fibaction_transports.nats.worker import fleet_limits
from fibaction_transports.nats.worker.journal import FleetJournal
from fibaction_transports.nats.worker.lease import Membership, Term
from fibaction_transports.nats.worker.lost_workers import LostWorkers
from tests.fleet_simulation import __main__ as program
from tests.fleet_simulation.world import simulate
from tests.support.memory_broker import MemoryBrokers

FEWER = "FIBACTION_EXAMPLES" in os.environ
"""True where the tests run once more, with other versions."""
SEEDS = range(1000, 1006 if FEWER else 1030)
MANY = range(1000, 1200)
"""Seeds in which a mistake has to be found."""

simulated = functools.cache(simulate)
"""The report of a seed without a mistake, for all tests that look at it."""


@pytest.mark.promise("FLEET-1", "FLEET-2", "FLEET-4", "FLEET-5", "FLEET-12", "FLEET-15")
@pytest.mark.parametrize("seed", SEEDS)
def test_a_fleet_keeps_its_promises_whatever_happens(seed: int) -> None:
    assert simulated(seed).violations == []


def test_a_seed_is_the_same_each_time() -> None:
    assert simulate(1003) == simulated(1003)


def test_workers_are_killed_and_cut_off_and_goals_taken_over() -> None:
    reports = [simulated(seed) for seed in range(1000, 1010)]

    assert sum(report.kills for report in reports) > 5
    assert sum(report.cuts for report in reports) > 5
    assert sum(report.takeovers for report in reports) > 5


# Mistakes


def stores_whatever_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the brokers refuse no record."""

    def put(self: Any, subject: str, data: bytes, expected: int, ttl: float) -> Any:
        return self.store(subject, data, ttl)

    monkeypatch.setattr(MemoryBrokers, "put", put)


def never_fences_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    def stored(self: Any) -> None:
        self.valid_until = math.inf
        self.renew_at = self._sent + self.lease / 3
        self._sent = None

    monkeypatch.setattr(Term, "stored", stored)


def joins_again_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Membership, "_rest_until", -math.inf, raising=False)
    fence = Membership._fence

    def without_rest(self: Any, why: str) -> None:
        fence(self, why)
        self._rest_until = -math.inf

    monkeypatch.setattr(Membership, "_fence", without_rest)


def says_too_early_that_a_checkpoint_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    write = FleetJournal.checkpoint

    def checkpoint(self: Any, goal: StoredGoal, then: Then) -> None:
        then(None)
        write(self, goal, lambda _error: None)

    monkeypatch.setattr(FleetJournal, "checkpoint", checkpoint)


def takes_goals_of_workers_that_live(monkeypatch: pytest.MonkeyPatch) -> None:
    async def is_gone(self: Any, entry: Any) -> bool:
        return True

    monkeypatch.setattr(LostWorkers, "is_gone", is_gone)


def leaves_the_goals_of_the_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    async def is_gone(self: Any, entry: Any) -> bool:
        return not entry.incarnation

    monkeypatch.setattr(LostWorkers, "is_gone", is_gone)


def gives_a_place_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    def next_one(entry: Any, demand: Any, gone: Any, most: int, *, gives: bool) -> Any:
        return next_entry(entry, demand, gone, most + 1, gives=gives)

    monkeypatch.setattr(fleet_limits, "next_entry", next_one)


def leaves_places_to_the_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    def next_one(entry: Any, demand: Any, gone: Any, most: int, *, gives: bool) -> Any:
        return next_entry(entry, demand, set(), most, gives=gives)

    monkeypatch.setattr(fleet_limits, "next_entry", next_one)


def believes_a_worker_that_does_not_know_a_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endpoint, "_NOT_THERE", ())


@pytest.mark.timeout(180)  # many seeds, on a busy machine
@pytest.mark.parametrize(
    ("mistake", "known"),
    [
        (stores_whatever_comes, 1002),
        (never_fences_itself, 1000),
        (joins_again_at_once, 1120),
        (says_too_early_that_a_checkpoint_is_kept, 1001),
        (takes_goals_of_workers_that_live, 1003),
        (leaves_the_goals_of_the_lost, 1000),
        (gives_a_place_too_many, 1001),
        (leaves_places_to_the_lost, 1001),
        (believes_a_worker_that_does_not_know_a_goal, 1028),
    ],
)
def test_a_mistake_is_found(mistake: Any, known: int, monkeypatch: pytest.MonkeyPatch) -> None:
    mistake(monkeypatch)

    # The seed that has found it comes first: after a change of the product it may be another one.
    assert any(simulate(seed).violations for seed in (known, *MANY))


def test_the_program_tells_what_it_has_seen(capsys: pytest.CaptureFixture[str]) -> None:
    assert program.main("--seed", "1000", "--once") == 0
    assert "'seeds': 1" in capsys.readouterr().out


def test_the_program_tells_what_is_wrong(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stores_whatever_comes(monkeypatch)
    assert program.main("--seed", "2000") == 1
    assert "seed 2" in capsys.readouterr().out
